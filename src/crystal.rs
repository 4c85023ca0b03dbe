//! The crystal: how it starts, and what ends in a reset when it does not, or stops.

use core::mem::MaybeUninit;

use cortex_m::peripheral::SCB;
use stm32f4xx_hal::pac::RCC;

use crate::{board, device::CRYSTAL_IS_EXTERNAL_CLOCK};

/// Survives a reset: whether the crystal's failure was the reason for it.
#[unsafe(link_section = ".uninit.CRYSTAL_NOTE")]
static mut NOTE: MaybeUninit<u32> = MaybeUninit::uninit();

const HAS_FAILED: u32 = 0xC0FF_5709;

/// Starts the crystal, and has its failure from now on interrupt (RM0090, 7.2.7); the core runs at 16 MHz. Where it does not
/// start, the chip is reset.
pub fn start(rcc: &RCC) {
    rcc.cr().modify(|_, w| w.hsebyp().bit(CRYSTAL_IS_EXTERNAL_CLOCK).hseon().set_bit());
    if !board::comes_in_100_ms(|| rcc.cr().read().hserdy().bit_is_set()) {
        defmt::error!("the crystal does not start, resetting");
        SCB::sys_reset();
    }
    rcc.cr().modify(|_, w| w.csson().set_bit());
}

/// Whether the last reset is due to the failure of the crystal. True only once after each.
pub fn has_failed() -> bool {
    let note = (&raw mut NOTE).cast::<u32>();
    // SAFETY: a word of ours, which any value is valid for; only the non-maskable interrupt writes it too.
    unsafe {
        let has_failed = note.read_volatile() == HAS_FAILED;
        note.write_volatile(0);
        has_failed
    }
}

/// The crystal has failed, and the core runs on at 16 MHz. At a tenth of its bit rate the controller would disturb the bus: the
/// next start logs it, since a log line takes time, and this interrupt may have come while another was written.
#[unsafe(no_mangle)]
extern "C" fn NonMaskableInt() -> ! {
    // SAFETY: as above; nothing else runs any more.
    unsafe { (&raw mut NOTE).cast::<u32>().write_volatile(HAS_FAILED) };
    SCB::sys_reset();
}
