//! The board NUCLEO-H743ZI with the 8 MHz of its ST-LINK: clocks, pins, and the place of the settings. It is only built.

use core::arch::asm;

use cortex_m::peripheral::SCB;
use embassy_stm32::{
    Config, Peripherals,
    flash::{self, Bank2Region, Blocking, Flash},
    gpio::{Level, Output, Speed},
    pac::{DBGMCU, RCC},
    peripherals::{PB8, PB9},
    rcc::{
        self, AHBPrescaler, APBPrescaler, Hse, HseMode, Pll, PllDiv, PllMul, PllPreDiv, PllSource,
        Sysclk, mux,
    },
    time::Hertz,
};

use embedded_storage::nor_flash::{ErrorType, NorFlash, ReadNorFlash};

pub use embassy_stm32::peripherals::IWDG1 as Watchdog;

use crate::{Parts, clock::Clock, fdcan::Fdcan};

type Region = Bank2Region<'static, Blocking>;

/// The pins of the CAN controller.
pub type Receive = PB8;
pub type Transmit = PB9;

/// The clock of the CAN controller: 80 MHz makes all rates exactly.
pub const CAN_HZ: u32 = 80_000_000;

/// The last two sectors of 128 KB of bank 2: the program, in bank 1, runs while they are written.
pub const SETTINGS_OFFSET: u32 = 0xC_0000;
pub const SETTINGS_LEN: u32 = 0x4_0000;

/// 400 MHz from the 8 MHz of the ST-LINK, and 80 MHz for FDCAN.
pub fn clocks() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Bypass });
    config.rcc.pll1 = Some(Pll {
        source: PllSource::HSE,
        prediv: PllPreDiv::DIV1,
        mul: PllMul::MUL100,
        fracn: None,
        divp: Some(PllDiv::DIV2),
        divq: Some(PllDiv::DIV10),
        divr: None,
    });
    config.rcc.sys = Sysclk::PLL1_P;
    config.rcc.ahb_pre = AHBPrescaler::DIV2;
    config.rcc.apb1_pre = APBPrescaler::DIV2;
    config.rcc.apb2_pre = APBPrescaler::DIV2;
    config.rcc.apb3_pre = APBPrescaler::DIV2;
    config.rcc.apb4_pre = APBPrescaler::DIV2;
    config.rcc.mux.fdcansel = mux::Fdcansel::PLL1_Q;
    config
}

/// Whether the PLL makes the clocks from the crystal as configured.
pub fn is_in_use(config: &rcc::Config) -> bool {
    let (source, set) = (RCC.pllckselr().read(), RCC.plldivr(0).read());
    RCC.cfgr().read().sws() == config.sys
        && config.pll1.is_some_and(|pll| {
            (source.pllsrc(), source.divm(0), set.plln()) == (pll.source, pll.prediv, pll.mul)
                && (Some(set.pllp()), Some(set.pllq())) == (pll.divp, pll.divq)
        })
}

/// Lets the watchdog and the timer of embassy's clock stand still while a debugger halts the core.
pub fn freeze_in_a_halt() {
    DBGMCU.apb4fzr1().modify(|w| w.set_iwdg1(true));
    DBGMCU.apb1lfzr1().modify(|w| w.set_tim12(true));
}

/// It would be a bus fault: see [`SettingsFlash`].
pub fn clear_double_error() -> bool {
    false
}

/// The peripherals that the node uses.
pub fn parts(p: Peripherals) -> Parts<Fdcan, SettingsFlash> {
    Parts {
        can: Fdcan::new(p.FDCAN1, p.PB8, p.PB9),
        flash: SettingsFlash(Flash::new_blocking(p.FLASH).into_blocking_regions().bank2_region),
        run: Output::new(p.PB0, Level::Low, Speed::Low),
        error: Output::new(p.PB14, Level::Low, Speed::Low),
        clock: Clock::new(p.TIM2),
    }
}

/// A unit whose programming a power cut has interrupted has a double error, and a read of it is a bus fault. Here the read
/// goes on, and the log finds that the unit is not valid.
pub struct SettingsFlash(Region);

impl ErrorType for SettingsFlash {
    type Error = flash::Error;
}

impl ReadNorFlash for SettingsFlash {
    const READ_SIZE: usize = Region::READ_SIZE;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), flash::Error> {
        // While FAULTMASK is set, BFHFNMIGN makes loads ignore bus faults (Armv7-M, B3.2.8).
        const BFHFNMIGN: u32 = 1 << 8;
        // SAFETY: no interrupt runs between the two changes, and nothing else changes the register.
        unsafe {
            asm!("cpsid f");
            (*SCB::PTR).ccr.modify(|ccr| ccr | BFHFNMIGN);
        }
        let result = self.0.read(offset, bytes);
        // SAFETY: as above.
        unsafe {
            (*SCB::PTR).ccr.modify(|ccr| ccr & !BFHFNMIGN);
            asm!("dsb", "cpsie f");
        }
        result
    }

    fn capacity(&self) -> usize {
        self.0.capacity()
    }
}

impl NorFlash for SettingsFlash {
    const WRITE_SIZE: usize = Region::WRITE_SIZE;
    const ERASE_SIZE: usize = Region::ERASE_SIZE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), flash::Error> {
        self.0.erase(from, to)
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), flash::Error> {
        self.0.write(offset, bytes)
    }
}
