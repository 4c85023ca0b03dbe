//! The crystal: its start, and the reset if it does not start or fails later.

use cortex_m::peripheral::SCB;
use stm32f4xx_hal::pac::RCC;

use crate::{board, product::device::CRYSTAL_IS_EXTERNAL_CLOCK};

/// Survives a reset and shows whether a failure of the crystal caused it. Its initial value is never written.
// SAFETY: the section of cortex-m-rt for variables that nothing initialises.
#[unsafe(link_section = ".uninit.CRYSTAL_NOTE")]
static mut NOTE: u32 = 0;

const HAS_FAILED: u32 = 0xC0FF_5709;

/// Starts the crystal and enables the interrupt for its failure (RM0090, 7.2.7); the core runs at 16 MHz. Resets the
/// chip if the crystal does not start.
pub fn start(rcc: &RCC) {
    rcc.cr().modify(|_, w| w.hsebyp().bit(CRYSTAL_IS_EXTERNAL_CLOCK).hseon().set_bit());
    if !board::comes_in_100_ms(|| rcc.cr().read().hserdy().bit_is_set()) {
        defmt::error!(
            "the crystal does not start, resetting: check it and CRYSTAL_IS_EXTERNAL_CLOCK in device.rs"
        );
        SCB::sys_reset();
    }
    rcc.cr().modify(|_, w| w.csson().set_bit());
}

/// Whether a failure of the crystal caused the last reset. True only once per failure.
pub fn has_failed() -> bool {
    let note = &raw mut NOTE;
    // SAFETY: the word is private and any value is valid; only the non-maskable interrupt also writes it.
    unsafe {
        let has_failed = note.read_volatile() == HAS_FAILED;
        note.write_volatile(0);
        has_failed
    }
}

/// Handles the failure of the crystal: the core continues at 16 MHz, and at a tenth of its bit rate the controller
/// would disturb the bus. The next start logs the failure, since a log line takes time and this interrupt may have come
/// during another one.
// SAFETY: the handler that cortex-m-rt declares under this name.
#[unsafe(no_mangle)]
extern "C" fn NonMaskableInt() -> ! {
    // SAFETY: the word is private, and no other code runs any more.
    unsafe { (&raw mut NOTE).write_volatile(HAS_FAILED) };
    SCB::sys_reset();
}
