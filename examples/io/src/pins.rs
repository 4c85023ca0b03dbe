//! The pins of the two boards: the Discovery board of the STM32F407 and the Nucleo board of the STM32F446.

use canopen_stm32f4::{Indicators, Led, can::CanPins};
use stm32f4xx_hal::{
    gpio::{ErasedPin, GpioExt, Input, Output},
    pac::{self, GPIOA, GPIOB, GPIOC, GPIOD},
    rcc::Rcc,
};

/// The CAN controller.
pub type Can = pac::CAN1;

/// The ports of the chip that the boards use.
pub struct Ports {
    pub a: GPIOA,
    pub b: GPIOB,
    pub c: GPIOC,
    pub d: GPIOD,
}

/// A button, pressed or not.
pub struct Button {
    pub pin: ErasedPin<Input>,
    /// Whether the pressed button connects its pin to ground.
    pub is_active_low: bool,
}

/// The pins of the board.
pub struct Pins {
    /// To the CAN transceiver.
    pub can: CanPins<Can>,
    /// The RUN (green) and ERR (red) indicators.
    pub indicators: Indicators,
    pub button: Button,
    /// The LEDs for the bits of 6200h.
    pub leds: [ErasedPin<Output>; 2],
}

impl Pins {
    /// Assigns the pins.
    pub fn new(ports: Ports, rcc: &mut Rcc) -> Self {
        let (a, b, d) = (ports.a.split(rcc), ports.b.split(rcc), ports.d.split(rcc));
        let c = ports.c.split(rcc);
        let (button, led) = if cfg!(feature = "stm32f446") {
            let pin = c.pc13.into_pull_up_input().erase();
            (Button { pin, is_active_low: true }, a.pa5.into_push_pull_output().erase())
        } else {
            let pin = a.pa0.into_pull_down_input().erase();
            (Button { pin, is_active_low: false }, d.pd13.into_push_pull_output().erase())
        };
        Self {
            can: CanPins::new(b.pb9, b.pb8, rcc),
            indicators: Indicators {
                run: Led::active_high(d.pd12),
                error: Led::active_high(d.pd14),
            },
            button,
            leds: [led, d.pd15.into_push_pull_output().erase()],
        }
    }
}
