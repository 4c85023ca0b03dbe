//! The part of `src/controller.rs` that the CAN driver uses, for CAN1 in plain memory.

use crate::{
    gpio::{Input, Output, Pin, PinPull, PinSpeed},
    pac::{self, RCC},
};

pub use pac::{CAN1 as Can, CAN1 as Filters};

pub const FIRST_BANK: usize = 0;

pub type Driver = bxcan::Can<Connected>;

/// The controller with its pins.
pub struct Connected;
pub struct Tx;
pub struct Rx;

impl Connected {
    pub fn rx(_: Can, _: Rx, _: &mut RCC) -> Self {
        Self
    }
}

// SAFETY: static memory, longer than the registers that `bxcan` knows.
unsafe impl bxcan::Instance for Connected {
    const REGISTERS: *mut bxcan::RegisterBlock = Can::ptr().cast_mut().cast();
}

/// The driver, made without its constructor: that waits for a mode to begin and then for it to end, and registers in
/// plain memory do not change meanwhile.
pub fn driver(can: Connected) -> Driver {
    // SAFETY: the driver is a structure of which the controller is the only field; neither has a size.
    unsafe { std::mem::transmute::<Connected, Driver>(can) }
}

impl PinSpeed for Tx {}
impl PinPull for Rx {}

impl<const PORT: char, const NUMBER: u8> From<Pin<PORT, NUMBER, Output>> for Tx {
    fn from(_: Pin<PORT, NUMBER, Output>) -> Self {
        Self
    }
}

impl<const PORT: char, const NUMBER: u8> From<Pin<PORT, NUMBER, Input>> for Rx {
    fn from(_: Pin<PORT, NUMBER, Input>) -> Self {
        Self
    }
}
