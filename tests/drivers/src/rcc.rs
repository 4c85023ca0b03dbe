//! The clocks and resets of the peripherals: registers in plain memory need none.

use crate::pac;

pub struct Rcc;

pub trait Enable {
    fn enable(_: &mut Rcc) {}

    /// # Safety
    /// None is needed here.
    // SAFETY: it does nothing.
    unsafe fn enable_unchecked() {}
}

pub trait Reset {
    /// # Safety
    /// None is needed here.
    // SAFETY: it does nothing.
    unsafe fn reset_unchecked() {}
}

impl Enable for pac::PWR {}
impl Enable for pac::TIM2 {}
impl Reset for pac::CAN1 {}
