//! The pins of your board. Edit this file.

use canopen_stm32f4::{Indicators, Led, can::CanPins};
use stm32f4xx_hal::{
    gpio::GpioExt,
    pac::{self, GPIOA, GPIOB, GPIOC, GPIOD},
    rcc::Rcc,
};

/// The CAN controller. Another one also has other interrupts in `main.rs`.
pub type Can = pac::CAN1;

/// The pins of the board.
pub struct Pins {
    /// To the CAN transceiver. The compiler refuses pins that the chip does not connect to the controller.
    pub can: CanPins<Can>,
    /// The RUN (green) and ERR (red) indicators.
    pub indicators: Indicators,
}

impl Pins {
    /// Assigns the pins.
    pub fn new(a: GPIOA, b: GPIOB, c: GPIOC, d: GPIOD, rcc: &mut Rcc) -> Self {
        let (b, d) = (b.split(rcc), d.split(rcc));
        Self {
            can: CanPins::new(b.pb9, b.pb8, rcc),
            indicators: if cfg!(feature = "nucleo-f446re") {
                Indicators { run: Led::active_high(a.split(rcc).pa5), error: Led::None }
            } else if cfg!(feature = "stm32-h405") {
                Indicators { run: Led::active_low(c.split(rcc).pc12), error: Led::None }
            } else {
                // Two LEDs of an STM32F407 Discovery; on a board without them the pins toggle unseen.
                Indicators { run: Led::active_high(d.pd12), error: Led::active_high(d.pd14) }
            },
        }
    }
}
