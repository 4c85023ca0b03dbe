//! The pins of the commissioner, on an STM32F407 Discovery.

use core::hint::black_box;

use canopen_stm32f4::{Indicators, Led, can::CanPins};
use stm32f4xx_hal::{
    gpio::{ErasedPin, GpioExt, Input},
    pac::{self, GPIOA, GPIOB, GPIOD},
    rcc::Rcc,
};

/// The CAN controller.
pub type Can = pac::CAN1;

/// The pins of the board.
pub struct Pins {
    /// To the CAN transceiver.
    pub can: CanPins<Can>,
    /// The RUN (green) and ERR (red) indicators.
    pub indicators: Indicators,
    /// High while it is pressed.
    pub button: ErasedPin<Input>,
    /// Shows the state of the network (orange).
    pub led: Led,
}

impl Pins {
    /// Assigns the pins.
    pub fn new(a: GPIOA, b: GPIOB, d: GPIOD, rcc: &mut Rcc) -> Self {
        let (a, b, d) = (a.split(rcc), b.split(rcc), d.split(rcc));
        Self {
            can: CanPins::new(b.pb9, b.pb8, rcc),
            indicators: Indicators {
                run: Led::active_high(d.pd12),
                error: Led::active_high(d.pd14),
            },
            // Not a constant, as docs/product.md explains.
            button: black_box(a.pa0.into_pull_down_input().erase()),
            led: Led::active_high(d.pd13),
        }
    }
}
