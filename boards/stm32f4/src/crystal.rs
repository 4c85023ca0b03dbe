//! The crystal: its frequency, its start, and the reset if it does not start, is another, is not in use, or fails later.

use core::ops::RangeInclusive;

use canopen_node::emergency::RestartCause;
use stm32f4xx_hal::pac::{RCC, TIM11};

use crate::{chip::SYSCLK_HZ, reset, start};

/// The internal oscillator, HSI. By the data sheet it is 1 % off at 25 °C, and 8 % too slow to 4.5 % too fast elsewhere.
const HSI_KHZ: u32 = 16_000;
/// The percentages of its frequency that a right crystal seems to have at any temperature, and those at 25 °C.
const POSSIBLE: RangeInclusive<u32> = 95..=109;
const LIKELY: RangeInclusive<u32> = 98..=102;

/// The crystal of a board, or the external clock in its place.
#[derive(Clone, Copy, Debug)]
pub struct Crystal {
    /// Its frequency in Hz.
    pub hz: u32,
    /// Whether it is an external clock. A start tries the other one too.
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
    if !comes_on(crystal.is_external_clock, rcc) {
        if !comes_on(!crystal.is_external_clock, rcc) {
            defmt::error!("the crystal does not start, resetting: check it");
            start::give_up(RestartCause::NoCrystal, 0);
        }
        defmt::warn!(
            "CRYSTAL_IS_EXTERNAL_CLOCK in device.rs is wrong, which delays each start by 100 ms: set it to {=bool}",
            !crystal.is_external_clock
        );
    }
    rcc.cr().modify(|_, w| w.csson().set_bit());
}

/// Compares the frequency of the crystal, which is on, with the expected one. Resets the chip if it is another.
pub fn compare(crystal: Crystal, rcc: &RCC) {
    let Some(khz) = measured_khz(rcc) else {
        defmt::warn!("the crystal cannot be measured: CRYSTAL_HZ in device.rs is believed");
        return;
    };
    let percent = khz / (crystal.hz / 100_000);
    if !POSSIBLE.contains(&percent) {
        defmt::error!("the crystal has {=u32} kHz, not CRYSTAL_HZ of device.rs, resetting", khz);
        start::give_up(RestartCause::WrongCrystal, khz);
    }
    if !LIKELY.contains(&percent) {
        defmt::warn!("the crystal seems to have {=u32} kHz: check CRYSTAL_HZ in device.rs", khz);
    }
}

/// Whether it starts within 100 ms as a crystal or as an external clock.
fn comes_on(is_external_clock: bool, rcc: &RCC) -> bool {
    let is_on = || rcc.cr().read().hserdy().bit_is_set();
    rcc.cr().modify(|_, w| w.hseon().clear_bit());
    start::comes_in_100_ms(|| !is_on());
    rcc.cr().modify(|_, w| w.hsebyp().bit(is_external_clock));
    rcc.cr().modify(|_, w| w.hseon().set_bit());
    start::comes_in_100_ms(is_on)
}

/// The frequency of the crystal, which is on, as counted by HSI: TIM11 captures each eighth period of HSE/RTC, the crystal
/// divided by 31 (RM0090, 7.2.11). `None` if a capture is missed, or there are no periods.
fn measured_khz(rcc: &RCC) -> Option<u32> {
    const PERIODS: u32 = 31 * 8 * CAPTURES;
    const CAPTURES: u32 = 4;
    const HSE_RTC: u32 = 0b10;
    // SAFETY: nobody has the timer yet, and it is reset behind the measurement.
    let timer = unsafe { TIM11::steal() };
    rcc.apb2enr().modify(|_, w| w.tim11en().set_bit());
    // SAFETY: the values that the comment above says, all of which exist.
    unsafe {
        rcc.cfgr().modify(|_, w| w.rtcpre().bits(31));
        timer.or().write(|w| w.bits(HSE_RTC));
        timer.ccmr1_input().write(|w| w.bits(0b11 << 2 | 0b01));
    }
    timer.ccer().write(|w| w.cc1e().set_bit());
    timer.cr1().write(|w| w.cen().set_bit());
    let capture = || {
        start::comes_in_100_ms(|| timer.sr().read().cc1if().bit_is_set());
        timer.ccr1().read().bits() as u16
    };
    let begin = capture();
    let end = (0..CAPTURES).fold(begin, |_, _| capture());
    let has_missed = timer.sr().read().cc1of().bit_is_set();
    rcc.apb2rstr().modify(|_, w| w.tim11rst().set_bit());
    rcc.apb2rstr().reset();
    rcc.apb2enr().reset();
    rcc.cfgr().reset();
    let ticks = u32::from(end.wrapping_sub(begin));
    (HSI_KHZ * PERIODS).checked_div(ticks).filter(|_| !has_missed)
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
        reset::end(RestartCause::OtherClock, settings);
    }
}

/// Handles the failure of the crystal: the core continues at 16 MHz, and at a tenth of its bit rate the controller
/// would disturb the bus. The next start logs the failure.
// SAFETY: the handler that cortex-m-rt declares under this name.
#[cfg_attr(feature = "handlers", unsafe(no_mangle))]
#[allow(non_snake_case, reason = "the name of cortex-m-rt")]
pub extern "C" fn NonMaskableInt() -> ! {
    reset::end(RestartCause::CrystalStopped, 0);
}
