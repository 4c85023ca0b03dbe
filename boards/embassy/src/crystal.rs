//! The crystal: its start, and the reset if it does not start or is not in use.

use cortex_m::peripheral::SCB;
#[cfg(feature = "stm32f105")]
use embassy_stm32::pac::rcc::vals::Pllsrc;
use embassy_stm32::{
    pac::RCC,
    rcc::{Config, HseMode},
};

/// The clock of the core after a reset.
const RESET_HZ: u32 = if cfg!(feature = "stm32f105") {
    8_000_000
} else if cfg!(feature = "stm32l476") {
    4_000_000
} else if cfg!(feature = "stm32h743") {
    64_000_000
} else {
    16_000_000
};

/// The register reads of at least 100 ms, at five cycles each.
const READS: u32 = RESET_HZ / 50;

/// Starts the crystal, and resets the chip if it does not start: embassy-stm32 would wait for it without a limit.
pub fn start(config: &Config) {
    let is_external_clock = config.hse.is_some_and(|hse| hse.mode == HseMode::Bypass);
    RCC.cr().modify(|w| w.set_hsebyp(is_external_clock));
    RCC.cr().modify(|w| w.set_hseon(true));
    if !(0..READS).any(|_| RCC.cr().read().hserdy()) {
        defmt::error!(
            "the crystal does not start, resetting: is it that of the board in src/chip/?"
        );
        SCB::sys_reset();
    }
}

/// Resets the chip unless the PLL makes the clocks from the crystal as configured: at any other clock the bit rates are
/// wrong.
pub fn check(config: &Config) {
    if !is_in_use(config) {
        defmt::error!("the clock is not that of the crystal, resetting");
        SCB::sys_reset();
    }
}

#[cfg(feature = "stm32f105")]
fn is_in_use(config: &Config) -> bool {
    let (set, dividers) = (RCC.cfgr().read(), RCC.cfgr2().read());
    set.sws() == config.sys
        && set.pllsrc() == Pllsrc::HSE_DIV_PREDIV
        && config.pll.is_some_and(|pll| (set.pllmul(), dividers.prediv1()) == (pll.mul, pll.prediv))
}

#[cfg(any(feature = "stm32f407", feature = "stm32f767"))]
fn is_in_use(config: &Config) -> bool {
    let set = RCC.pllcfgr().read();
    RCC.cfgr().read().sws() == config.sys
        && set.pllsrc() == config.pll_src
        && config.pll.is_some_and(|pll| {
            (set.pllm(), set.plln(), Some(set.pllp())) == (pll.prediv, pll.mul, pll.divp)
        })
}

#[cfg(any(feature = "stm32g431", feature = "stm32g474"))]
fn is_in_use(config: &Config) -> bool {
    let set = RCC.pllcfgr().read();
    RCC.cfgr().read().sws() == config.sys
        && RCC.ccipr().read().fdcansel() == config.mux.fdcansel
        && config.pll.is_some_and(|pll| {
            (set.pllsrc(), set.pllm(), set.plln()) == (pll.source, pll.prediv, pll.mul)
                && (Some(set.pllq()), Some(set.pllr())) == (pll.divq, pll.divr)
        })
}

#[cfg(feature = "stm32h743")]
fn is_in_use(config: &Config) -> bool {
    let (source, set) = (RCC.pllckselr().read(), RCC.plldivr(0).read());
    RCC.cfgr().read().sws() == config.sys
        && config.pll1.is_some_and(|pll| {
            (source.pllsrc(), source.divm(0), set.plln()) == (pll.source, pll.prediv, pll.mul)
                && (Some(set.pllp()), Some(set.pllq())) == (pll.divp, pll.divq)
        })
}

#[cfg(feature = "stm32l476")]
fn is_in_use(config: &Config) -> bool {
    let set = RCC.pllcfgr().read();
    RCC.cfgr().read().sws() == config.sys
        && config.pll.is_some_and(|pll| {
            (set.pllsrc(), set.pllm(), set.plln()) == (pll.source, pll.prediv, pll.mul)
                && Some(set.pllr()) == pll.divr
        })
}
