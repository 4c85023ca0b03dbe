//! The board NUCLEO-F767ZI with the 8 MHz of its ST-LINK: clocks, pins, and the place of the settings. It is only built.

use embassy_stm32::{
    Config, Peripherals, bind_interrupts,
    can::{Can, Rx0InterruptHandler, Rx1InterruptHandler, SceInterruptHandler, TxInterruptHandler},
    flash::{Bank1Region1, Blocking, Flash},
    gpio::{Level, Output, Speed},
    pac::{DBGMCU, RCC},
    peripherals::CAN1,
    rcc::{
        self, AHBPrescaler, APBPrescaler, Hse, HseMode, Pll, PllMul, PllPDiv, PllPreDiv, PllSource,
        Sysclk,
    },
    time::Hertz,
};

pub use embassy_stm32::peripherals::IWDG as Watchdog;

use crate::{Parts, bxcan::Bxcan, clock::Clock};

bind_interrupts!(pub struct Interrupts {
    CAN1_TX => TxInterruptHandler<CAN1>;
    CAN1_RX0 => Rx0InterruptHandler<CAN1>;
    CAN1_RX1 => Rx1InterruptHandler<CAN1>;
    CAN1_SCE => SceInterruptHandler<CAN1>;
});

/// The clock of the CAN controller: 40 MHz makes all rates exactly.
pub const CAN_HZ: u32 = 40_000_000;

/// Sectors 1 and 2.
pub const SETTINGS_OFFSET: u32 = 0x8000;
pub const SETTINGS_LEN: u32 = 0x1_0000;

/// 160 MHz from a clock of 8 MHz, and 40 MHz for the peripherals.
pub fn clocks() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Bypass });
    config.rcc.pll_src = PllSource::HSE;
    config.rcc.pll = Some(Pll {
        prediv: PllPreDiv::DIV4,
        mul: PllMul::MUL160,
        divp: Some(PllPDiv::DIV2),
        divq: None,
        divr: None,
    });
    config.rcc.sys = Sysclk::PLL1_P;
    config.rcc.ahb_pre = AHBPrescaler::DIV1;
    config.rcc.apb1_pre = APBPrescaler::DIV4;
    config.rcc.apb2_pre = APBPrescaler::DIV2;
    config
}

/// Whether the PLL makes the clocks from the crystal as configured.
pub fn is_in_use(config: &rcc::Config) -> bool {
    let set = RCC.pllcfgr().read();
    RCC.cfgr().read().sws() == config.sys
        && set.pllsrc() == config.pll_src
        && config.pll.is_some_and(|pll| {
            (set.pllm(), set.plln(), Some(set.pllp())) == (pll.prediv, pll.mul, pll.divp)
        })
}

/// Lets the watchdog and the timer of embassy's clock stand still while a debugger halts the core.
pub fn freeze_in_a_halt() {
    DBGMCU.apb1fzr().modify(|w| {
        w.set_iwdg(true);
        w.set_tim12(true);
    });
}

/// The flash has no error-correcting code.
pub fn clear_double_error() -> bool {
    false
}

/// The peripherals that the node uses.
pub fn parts(p: Peripherals) -> Parts<Bxcan, Bank1Region1<'static, Blocking>> {
    Parts {
        can: Bxcan::new(Can::new(p.CAN1, p.PD0, p.PD1, Interrupts)),
        flash: Flash::new_blocking(p.FLASH).into_blocking_regions().bank1_region1,
        run: Output::new(p.PB0, Level::Low, Speed::Low),
        error: Output::new(p.PB14, Level::Low, Speed::Low),
        clock: Clock::new(p.TIM2),
    }
}
