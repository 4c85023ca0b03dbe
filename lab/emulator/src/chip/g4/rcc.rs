//! RCC (RM0440 chapter 7): oscillators, PLL, prescalers, the clock of FDCAN, peripheral clocks and resets, reset flags.

use crate::{
    Time,
    can::Clock,
    chip::{
        ChipVariant, Problem, StartUp,
        rcc::{Clocks, HSI, Rcc as _, ResetCause, apb_shift, hclk_shift},
    },
};

const CR: u32 = 0x00;
const CFGR: u32 = 0x08;
const PLLCFGR: u32 = 0x0C;
const AHB1ENR: u32 = 0x48;
pub const AHB2ENR: u32 = 0x4C;
pub const APB1ENR1: u32 = 0x58;
pub const APB2ENR: u32 = 0x60;
const CCIPR: u32 = 0x88;
const BDCR: u32 = 0x90;
const CSR: u32 = 0x94;
const LAST: u32 = 0x9C;

const HSION: u32 = 1 << 8;
const HSIRDY: u32 = 1 << 10;
const HSEON: u32 = 1 << 16;
const HSEBYP: u32 = 1 << 18;
const CSSON: u32 = 1 << 19;
const PLLON: u32 = 1 << 24;
const PLLQEN: u32 = 1 << 20;
const PLLREN: u32 = 1 << 24;
/// The values of SW.
const ON_HSI: u32 = 1;
const ON_HSE: u32 = 2;
const ON_PLL: u32 = 3;
const LSION: u32 = 1 << 0;
const RMVF: u32 = 1 << 23;
const LSEON: u32 = 1 << 0;
const BDRST: u32 = 1 << 16;
/// The highest legal SYSCLK, APB1 and APB2.
const MAX_HZ: u32 = 170_000_000;

impl ResetCause {
    /// The RCC_CSR flags that the reset sets: every internal source also pulls NRST.
    const fn flags_g4(self) -> u32 {
        match self {
            Self::PowerOn | Self::BrownOut => 1 << 27 | 1 << 26,
            Self::Pin => 1 << 26,
            Self::Software => 1 << 28 | 1 << 26,
            Self::Watchdog => 1 << 29 | 1 << 26,
        }
    }
}

#[derive(Debug)]
pub struct Rcc {
    crystal: Clock,
    /// The crystal oscillates when switched on.
    crystal_works: bool,
    hse_start: Time,
    is_external: bool,
    start_up: StartUp,
    regs: [u32; LAST as usize / 4 + 1],
    hse_ready: Time,
    pll_ready: Time,
    lsi_ready: Time,
}

impl Rcc {
    /// The state after power-on, with `crystal` as HSE.
    pub fn new(crystal: Clock, variant: &ChipVariant) -> Self {
        let mut rcc = Self {
            crystal,
            crystal_works: crystal.hz > 0,
            hse_start: variant.hse_start,
            is_external: variant.external_clock,
            start_up: variant.start_up,
            regs: [0; _],
            hse_ready: Time::MAX,
            pll_ready: Time::MAX,
            lsi_ready: Time::MAX,
        };
        rcc.reset(ResetCause::PowerOn);
        rcc
    }

    fn reg_mut(&mut self, offset: u32) -> &mut u32 {
        &mut self.regs[offset as usize / 4]
    }

    fn write_cr(&mut self, old: u32, value: u32, now: Time) -> Result<(), Problem> {
        let on_pll = self.reg(CFGR) & 3 == ON_PLL;
        if (on_pll && value & PLLON == 0) || (self.sysclk_needs_hse() && value & HSEON == 0) {
            return Err(Problem::Misuse("a clock that SYSCLK depends on was switched off"));
        }
        let starts = |bit: u32| value & bit != 0 && old & bit == 0;
        *self.reg_mut(CR) = value;
        if starts(HSEON) {
            self.start_hse(now);
        }
        if value & HSEON == 0 {
            self.hse_ready = Time::MAX;
        }
        if value & PLLON == 0 {
            self.pll_ready = Time::MAX;
        } else if starts(PLLON) {
            self.pll_ready = now + self.start_up.pll();
            return self.check_pll();
        }
        // The clock security system is not modelled.
        if value & CSSON == 0 { Ok(()) } else { Err(Problem::Unmodelled) }
    }

    fn start_hse(&mut self, now: Time) {
        let ready = now.as_ps().saturating_add(self.hse_start.as_ps());
        let works = self.crystal_works && (self.reg(CR) & HSEBYP != 0) == self.is_external;
        self.hse_ready = if works { Time::from_ps(ready) } else { Time::MAX };
    }

    fn pll_is_on_hse(&self) -> bool {
        self.reg(PLLCFGR) & 3 == 3
    }

    fn sysclk_needs_hse(&self) -> bool {
        match self.reg(CFGR) & 3 {
            ON_HSE => true,
            ON_PLL => self.pll_is_on_hse(),
            _ => false,
        }
    }

    /// The nominal frequencies of the PLL's input and its VCO.
    fn pll(&self) -> (u64, u64) {
        let pllcfgr = self.reg(PLLCFGR);
        let source = if self.pll_is_on_hse() { self.crystal } else { HSI };
        let source = u64::from(source.hz);
        let m = u64::from(pllcfgr >> 4 & 0xF) + 1;
        let n = u64::from(pllcfgr >> 8 & 0x7F);
        (source / m, source * n / m)
    }

    /// The PLL's output Q or R, whose divider is at this bit of PLLCFGR.
    fn pll_output(&self, divider: u32) -> Clock {
        let divider = 2 * (u64::from(self.reg(PLLCFGR) >> divider & 3) + 1);
        let source = if self.pll_is_on_hse() { self.crystal } else { HSI };
        Clock { hz: (self.pll().1 / divider) as u32, ..source }
    }

    fn check_pll(&self) -> Result<(), Problem> {
        let (input, vco) = self.pll();
        if !(2_660_000..=16_000_000).contains(&input) {
            return Err(Problem::Misuse("PLL input outside 2.66..16 MHz"));
        }
        if !(96_000_000..=344_000_000).contains(&vco) {
            return Err(Problem::Misuse("PLL VCO outside 96..344 MHz"));
        }
        Ok(())
    }

    fn check_limits(&self) -> Result<(), Problem> {
        if self.clocks().sysclk.hz > MAX_HZ {
            return Err(Problem::Misuse("SYSCLK above the part's limit"));
        }
        if self.reg(CFGR) & 3 == ON_PLL && self.reg(PLLCFGR) & PLLREN == 0 {
            return Err(Problem::Misuse("SYSCLK is on the PLL, whose output R is off"));
        }
        Ok(())
    }
}

impl crate::chip::rcc::Rcc for Rcc {
    fn reset(&mut self, cause: ResetCause) {
        let is_power_on = cause == ResetCause::PowerOn;
        let flags = if is_power_on { 0 } else { self.reg(CSR) & 0xFE00_0000 };
        let backup_domain = if is_power_on { 0 } else { self.reg(BDCR) };
        self.regs = [0; _];
        for (offset, value) in [
            (CR, HSION),
            (CFGR, ON_HSI),
            (PLLCFGR, 0x1000),
            (AHB1ENR, 1 << 8),
            (APB1ENR1, 1 << 10),
            (BDCR, backup_domain),
            (CSR, flags | cause.flags_g4()),
        ] {
            *self.reg_mut(offset) = value;
        }
        self.hse_ready = Time::MAX;
        self.pll_ready = Time::MAX;
        self.lsi_ready = Time::MAX;
    }

    fn reg(&self, offset: u32) -> u32 {
        self.regs[offset as usize / 4]
    }

    fn read(&self, offset: u32, now: Time) -> Option<u32> {
        let value = *self.regs.get(offset as usize / 4)?;
        let ready = |on: u32, from: Time, bit: u32| {
            if value & on != 0 && now >= from { bit } else { 0 }
        };
        Some(match offset {
            CR => {
                let flags = HSIRDY | HSEON << 1 | PLLON << 1;
                value & !flags
                    | ready(HSION, Time::ZERO, HSIRDY)
                    | ready(HSEON, self.hse_ready, HSEON << 1)
                    | ready(PLLON, self.pll_ready, PLLON << 1)
            }
            CFGR => value & !0xC | (value & 3) << 2,
            CSR => value | ready(LSION, self.lsi_ready, LSION << 1),
            _ => value,
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
        if offset > LAST {
            return Err(Problem::Unmodelled);
        }
        let old = self.reg(offset);
        let mut value = value;
        match offset {
            CR => return self.write_cr(old, value, now),
            PLLCFGR if self.reg(CR) & PLLON != 0 && (value ^ old) & !(PLLQEN | PLLREN) != 0 => {
                return Err(Problem::Misuse("PLLCFGR written while the PLL is on"));
            }
            CFGR => {
                let is_ready = match value & 3 {
                    ON_HSI => true,
                    ON_HSE => now >= self.hse_ready,
                    ON_PLL => now >= self.pll_ready,
                    _ => false,
                };
                if !is_ready {
                    return Err(Problem::Misuse("SYSCLK switched to a source that is not ready"));
                }
                value &= !0xC;
            }
            BDCR if value & LSEON != 0 => {
                let why = "LSE is switched on, but the board has no crystal for it";
                return Err(Problem::Misuse(why));
            }
            BDCR if value & BDRST != 0 => value = BDRST,
            CSR => {
                if value & LSION != 0 && old & LSION == 0 {
                    self.lsi_ready = now + self.start_up.lsi();
                }
                let flags = if value & RMVF != 0 { 0 } else { old & 0xFE00_0000 };
                value = value & LSION | flags;
            }
            _ => {}
        }
        *self.reg_mut(offset) = value;
        match offset {
            CFGR => self.check_limits(),
            CCIPR if value >> 24 & 3 == 3 => Err(Problem::Misuse("FDCANSEL is reserved")),
            _ => Ok(()),
        }
    }

    fn is_backup_domain(&self, offset: u32) -> bool {
        offset == BDCR
    }

    /// FDCAN is clocked by HSE, by the PLL's output Q, or by APB1 (CCIPR, FDCANSEL).
    fn clocks(&self) -> Clocks {
        let cfgr = self.reg(CFGR);
        let sysclk = match cfgr & 3 {
            ON_HSE => self.crystal,
            ON_PLL => self.pll_output(25),
            _ => HSI,
        };
        let clocks = Clocks::divided(
            sysclk,
            hclk_shift(cfgr >> 4),
            apb_shift(cfgr >> 8),
            apb_shift(cfgr >> 11),
        );
        let can = match self.reg(CCIPR) >> 24 & 3 {
            0 if self.crystal.hz > 0 => self.crystal,
            1 => self.pll_output(21),
            _ => clocks.pclk1,
        };
        Clocks { can, ..clocks }
    }

    fn stop_crystal(&mut self, _: Time) {
        self.crystal_works = false;
        self.hse_ready = Time::MAX;
    }

    fn start_crystal(&mut self, now: Time) {
        self.crystal_works = self.crystal.hz > 0;
        if self.reg(CR) & HSEON != 0 {
            self.start_hse(now);
        }
    }

    fn is_stopped(&self) -> bool {
        !self.crystal_works && self.sysclk_needs_hse()
    }

    fn force_lsi(&mut self, now: Time) {
        if self.reg(CSR) & LSION == 0 {
            *self.reg_mut(CSR) |= LSION;
            self.lsi_ready = now + self.start_up.lsi();
        }
    }
}
