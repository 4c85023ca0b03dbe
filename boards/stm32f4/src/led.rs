//! The LEDs of a board, and the indicators that they make.

use core::hint::black_box;

use canopen_node::indicator::Lit;
use stm32f4xx_hal::gpio::{ErasedPin, Output, Pin, PinMode, PinState};

/// An LED, dark at first. The compiler does not see which pin: it makes a resource of RTIC that is constant the initial
/// value of a variable, and RTIC's variables have none.
pub enum Led {
    /// Lit while the pin is high.
    ActiveHigh(ErasedPin<Output>),
    /// Lit while the pin is low.
    ActiveLow(ErasedPin<Output>),
    /// The board has no such LED.
    None,
}

impl Led {
    /// An LED between the pin and ground.
    pub fn active_high<const P: char, const N: u8>(pin: Pin<P, N, impl PinMode>) -> Self {
        Self::ActiveHigh(black_box(pin.into_push_pull_output_in_state(PinState::Low).erase()))
    }

    /// An LED between the supply and the pin.
    pub fn active_low<const P: char, const N: u8>(pin: Pin<P, N, impl PinMode>) -> Self {
        Self::ActiveLow(black_box(pin.into_push_pull_output_in_state(PinState::High).erase()))
    }

    /// Lights the LED, or puts it out.
    pub fn light(&mut self, is_lit: bool) {
        match self {
            Self::ActiveHigh(pin) => pin.set_state(is_lit.into()),
            Self::ActiveLow(pin) => pin.set_state((!is_lit).into()),
            Self::None => {}
        }
    }
}

/// The indicators of CiA 303-3.
pub struct Indicators {
    /// RUN, green.
    pub run: Led,
    /// ERR, red.
    pub error: Led,
}

impl Indicators {
    /// Lights the indicators, or puts them out.
    pub fn light(&mut self, lit: Lit) {
        self.run.light(lit.run);
        self.error.light(lit.error);
    }
}
