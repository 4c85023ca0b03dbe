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
impl Reset for pac::CAN1 {
    // SAFETY: it only reads.
    unsafe fn reset_unchecked() {
        // SAFETY: the registers of port B, the next after those of port A.
        let port = unsafe { &*pac::GPIOA::ptr().byte_add(0x400) };
        let mode = port.moder().read().bits() >> 18 & 0b11;
        assert!(mode == 0b01, "CAN1 is reset while it has its transmit pin, PB9");
    }
}
