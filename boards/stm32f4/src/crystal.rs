//! The crystal: its frequency, its start, and the reset if it does not start, is not in use, or fails later.

use cortex_m::peripheral::SCB;
use stm32f4xx_hal::pac::RCC;

use crate::{chip::SYSCLK_HZ, start};

/// Survives a reset and shows whether a failure of the crystal caused it. Its initial value is never written.
// SAFETY: the section of cortex-m-rt for variables that nothing initialises.
#[unsafe(link_section = ".uninit.CRYSTAL_NOTE")]
static mut NOTE: u32 = 0;

const HAS_FAILED: u32 = 0xC0FF_5709;

/// The crystal of a board, or the external clock in its place.
#[derive(Clone, Copy, Debug)]
pub struct Crystal {
    /// Its frequency in Hz.
    pub hz: u32,
    /// Whether it is an external clock.
    pub is_external_clock: bool,
}

impl Crystal {
    /// A crystal of this frequency, or an external clock (another chip's, an oscillator).
    ///
    /// # Panics
    /// The frequency is not a whole number of MHz from 4 to 26. In a constant this is an error at compile time.
    pub const fn new(hz: u32, is_external_clock: bool) -> Self {
        assert!(
            hz > 0,
            "a crystal or an external clock is needed: the chip's own oscillator is too inaccurate for CAN"
        );
        assert!(hz.is_multiple_of(1_000_000), "CRYSTAL_HZ must be a whole number of MHz");
        assert!(4_000_000 <= hz && hz <= 26_000_000, "CRYSTAL_HZ must be 4 to 26 MHz");
        Self { hz, is_external_clock }
    }
}

/// Starts the crystal and enables the interrupt for its failure (RM0090, 7.2.7); the core runs at 16 MHz. Resets the
/// chip if the crystal does not start.
pub fn start(crystal: Crystal, rcc: &RCC) {
    rcc.cr().modify(|_, w| w.hsebyp().bit(crystal.is_external_clock).hseon().set_bit());
    if !start::comes_in_100_ms(|| rcc.cr().read().hserdy().bit_is_set()) {
        defmt::error!(
            "the crystal does not start, resetting: check it and CRYSTAL_IS_EXTERNAL_CLOCK in device.rs"
        );
        SCB::sys_reset();
    }
    rcc.cr().modify(|_, w| w.csson().set_bit());
}

/// Resets the chip unless the PLL makes the system clock from the crystal: at any other clock the bit rates are wrong.
pub fn check(crystal: Crystal, rcc: &RCC) {
    let settings = rcc.pllcfgr().read().bits();
    let (divider, factor) = (settings & 0x3F, settings >> 6 & 0x1FF);
    let (post_divider, is_from_crystal) = (2 * ((settings >> 16 & 3) + 1), settings >> 22 & 1 == 1);
    let made = u64::from(crystal.hz) * u64::from(factor);
    let needed = u64::from(SYSCLK_HZ) * u64::from(divider * post_divider);
    let is_in_use = start::comes_in_100_ms(|| rcc.cfgr().read().sws().is_pll());
    if !(is_in_use && is_from_crystal && made == needed) {
        defmt::error!(
            "the clock is not that of the crystal, resetting: RCC_PLLCFGR {=u32:#x}",
            settings
        );
        SCB::sys_reset();
    }
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
