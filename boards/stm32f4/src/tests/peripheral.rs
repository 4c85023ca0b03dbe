//! What the CAN driver uses of `can::peripheral`, for CAN1 in plain memory.

use core::ops::Deref;

use stm32f4xx_hal::{
    gpio::{Input, Output, Pin, PinPull, PinSpeed},
    pac::{CAN1, can1::RegisterBlock},
    rcc::{Rcc, Reset},
};

pub trait Peripheral: Reset + Sized + Deref<Target = RegisterBlock> {
    type Tx: PinSpeed;
    type Rx: PinPull;
    type Connected: bxcan::Instance;
    type Filters: Deref<Target = RegisterBlock>;
    const FIRST_BANK: usize;

    fn connect(self, receive: Self::Rx, rcc: &mut Rcc) -> Self::Connected;

    fn driver(can: Self::Connected) -> bxcan::Can<Self::Connected>;

    /// # Safety
    /// As of the original.
    // SAFETY: there is nothing to rely on.
    unsafe fn steal() -> (Self, Self::Filters);

    fn enable_clock(_: &mut Rcc) {}
}

impl Peripheral for CAN1 {
    type Tx = Tx;
    type Rx = Rx;
    type Connected = Connected;
    type Filters = CAN1;
    const FIRST_BANK: usize = 0;

    fn connect(self, _: Rx, _: &mut Rcc) -> Connected {
        Connected
    }

    /// Made without the constructor: that waits for a mode to begin and then for it to end, and registers in plain
    /// memory do not change meanwhile.
    fn driver(can: Connected) -> bxcan::Can<Connected> {
        // SAFETY: the driver is a structure of which the controller is the only field; neither has a size.
        unsafe { core::mem::transmute::<Connected, bxcan::Can<Connected>>(can) }
    }

    // SAFETY: as of the trait.
    unsafe fn steal() -> (Self, CAN1) {
        (CAN1, CAN1)
    }
}

/// The controller with its pins.
pub struct Connected;
pub struct Tx;
pub struct Rx;

// SAFETY: static memory, longer than the registers that `bxcan` knows.
unsafe impl bxcan::Instance for Connected {
    const REGISTERS: *mut bxcan::RegisterBlock = CAN1::ptr().cast_mut().cast();
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
