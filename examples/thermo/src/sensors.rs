//! The sensors at the converter.

use stm32f4xx_hal::{
    Listen,
    adc::{
        Adc,
        config::{AdcConfig, Clock, SampleTime},
    },
    pac::{ADC1, TIM5},
    rcc::Rcc,
    time::Hertz,
    timer::{CounterHz, Event, TimerExt},
};

use crate::pins::SensorPins;

/// The sensors, and the timer that asks for their voltages.
pub struct Sensors {
    pins: SensorPins,
    adc: Adc<ADC1>,
    timer: CounterHz<TIM5>,
}

impl Sensors {
    /// Starts the converter and the timer.
    pub fn new(pins: SensorPins, adc: ADC1, timer: TIM5, rcc: &mut Rcc) -> Self {
        let mut adc = Adc::new(adc, true, AdcConfig::default().clock(Clock::Pclk2_div_4), rcc);
        adc.calibrate();
        let mut timer = timer.counter_hz(rcc);
        timer.listen(Event::Update);
        // The period fits the timer.
        let _ = timer.start(Hertz::from_raw(10));
        Self { pins, adc, timer }
    }

    /// The voltages in mV.
    pub fn read(&mut self) -> [u16; 4] {
        let _ = self.timer.wait();
        let (a, b, c, d) = &self.pins;
        let samples = [
            self.adc.convert(a, SampleTime::Cycles_480),
            self.adc.convert(b, SampleTime::Cycles_480),
            self.adc.convert(c, SampleTime::Cycles_480),
            self.adc.convert(d, SampleTime::Cycles_480),
        ];
        samples.map(|sample| self.adc.sample_to_millivolts(sample))
    }
}
