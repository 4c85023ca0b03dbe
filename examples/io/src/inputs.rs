//! The inputs and outputs of the example `io`: a button, two LEDs and the temperature sensor of the chip.

use example_io::application::{Filter, Sample};
use stm32f4xx_hal::{
    Listen,
    adc::{
        Adc, Temperature,
        config::{AdcConfig, Clock, SampleTime},
    },
    gpio::{ErasedPin, Output},
    pac::{ADC1, TIM5},
    rcc::Rcc,
    signature::{VtempCal30, VtempCal110},
    timer::{CounterHz, Event, TimerExt},
};

use crate::pins::Button;

/// The inputs and outputs, sampled 100 times a second.
pub struct Inputs {
    button: Button,
    leds: [ErasedPin<Output>; 2],
    adc: Adc<ADC1>,
    timer: CounterHz<TIM5>,
    pub filter: Filter,
}

/// The supply at which the factory has calibrated the sensor (data sheet).
const CALIBRATION_MV: i32 = 3_300;

impl Inputs {
    /// Starts the timer, whose interrupt asks for the samples, and the converter.
    pub fn new(
        button: Button,
        leds: [ErasedPin<Output>; 2],
        adc: ADC1,
        timer: TIM5,
        rcc: &mut Rcc,
    ) -> Self {
        // 20 MHz; with a half of APB2's clock it would be above 36 MHz, its limit (data sheet: fADC).
        let config = AdcConfig::default().clock(Clock::Pclk2_div_4);
        let mut adc = Adc::new(adc, true, config, rcc);
        adc.enable_temperature_and_vref();
        let mut timer = timer.counter_hz(rcc);
        timer.listen(Event::Update);
        // The period fits the timer.
        let _ = timer.start(stm32f4xx_hal::time::Hertz::from_raw(100));
        Self { button, leds, adc, timer, filter: Filter::default() }
    }

    /// Reads the inputs, which takes 25 us.
    pub fn sample(&mut self) -> Sample {
        let _ = self.timer.wait();
        let is_pressed = self.button.pin.is_low() == self.button.is_active_low;
        Sample { is_pressed, temperature: self.temperature() }
    }

    /// The temperature in 0.1 degrees Celsius, on the line through the factory's values at 30 and 110 degrees.
    fn temperature(&mut self) -> i16 {
        let sample = self.adc.convert(&Temperature, SampleTime::Cycles_480);
        let at_3300_mv = i32::from(sample) * self.adc.reference_voltage() as i32 / CALIBRATION_MV;
        let (at_30, at_110) = (VtempCal30::get().read(), VtempCal110::get().read());
        let slope = (i32::from(at_110) - i32::from(at_30)).max(1);
        (300 + 800 * (at_3300_mv - i32::from(at_30)) / slope) as i16
    }

    /// Lights the LEDs for the set bits.
    pub fn light(&mut self, outputs: u8) {
        for (number, led) in self.leds.iter_mut().enumerate() {
            led.set_state((outputs >> number & 1 == 1).into());
        }
    }
}
