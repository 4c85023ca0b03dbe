//! RCC (RM0090 chapter 7): oscillators, PLL, prescalers, peripheral clocks and resets, reset flags.

use std::fmt;

use super::{ChipVariant, Part, Problem, StartUp};
use crate::{Time, can::Clock};

const CR: u32 = 0x00;
const PLLCFGR: u32 = 0x04;
const CFGR: u32 = 0x08;
const CIR: u32 = 0x0C;
pub const AHB1ENR: u32 = 0x30;
pub const AHB2ENR: u32 = 0x34;
pub const APB1ENR: u32 = 0x40;
pub const APB2ENR: u32 = 0x44;
const CSR: u32 = 0x74;

const HSION: u32 = 1 << 0;
const HSEON: u32 = 1 << 16;
const HSEBYP: u32 = 1 << 18;
const CSSON: u32 = 1 << 19;
const PLLON: u32 = 1 << 24;
const PLLI2SON: u32 = 1 << 26;
const PLLSAION: u32 = 1 << 28;
const LSION: u32 = 1 << 0;
const RMVF: u32 = 1 << 24;
const LSEON: u32 = 1 << 0;
const RTCSEL: u32 = 0b11 << 8;
const BDRST: u32 = 1 << 16;
/// BDRST, RTCEN, RTCSEL, LSEBYP and LSEON.
const BDCR_WRITABLE: u32 = 0x0001_8305;
const CSSF: u32 = 1 << 7;
/// The time that HSI takes to start (F405 data sheet, table 34).
const HSI_START: Time = Time::from_us(4);
/// The time until SWS follows SW, and a ready flag the end of its oscillator: some cycles of both clocks.
const SWITCH: Time = Time::from_ns(500);

/// The internal oscillator, if it is exact.
pub(super) const HSI: Clock = Clock { hz: 16_000_000, ppm: 0 };

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ResetCause {
    PowerOn,
    /// The supply fell below the brown-out level that the option bytes select, and rose again.
    BrownOut,
    /// The NRST pin was pulled low.
    Pin,
    /// `AIRCR.SYSRESETREQ`.
    Software,
    Watchdog,
}

impl ResetCause {
    /// The RCC_CSR flags that the reset sets: every internal source also pulls NRST.
    const fn flags(self) -> u32 {
        match self {
            Self::PowerOn => 0x0E00_0000,
            Self::BrownOut => 1 << 26 | 1 << 25,
            Self::Pin => 1 << 26,
            Self::Software => 1 << 28 | 1 << 26,
            Self::Watchdog => 1 << 29 | 1 << 26,
        }
    }
}

/// The clocks of the current RCC settings, each with the error of its oscillator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Clocks {
    pub sysclk: Clock,
    /// CPU, AHB and SysTick.
    pub hclk: Clock,
    /// APB1: IWDG's registers, PWR.
    pub pclk1: Clock,
    /// The time quanta of CAN: APB1, or what an STM32G4 has selected for FDCAN.
    pub can: Clock,
    /// The timers of APB1: its clock, or twice that if APB1 is slower than AHB.
    pub timclk1: Clock,
    /// APB2: ADC, SYSCFG, EXTI.
    pub pclk2: Clock,
    /// The timers of APB2, in the same way.
    pub timclk2: Clock,
}

impl Clocks {
    /// The clocks from SYSCLK, the divider of AHB and those of APB1 and APB2 after it, as powers of two. CAN is on APB1.
    pub(super) fn divided(sysclk: Clock, ahb: u32, apb1: u32, apb2: u32) -> Self {
        let divided = |shift: u32| Clock { hz: sysclk.hz >> shift, ..sysclk };
        Self {
            sysclk,
            hclk: divided(ahb),
            pclk1: divided(ahb + apb1),
            can: divided(ahb + apb1),
            timclk1: divided(ahb + apb1.saturating_sub(1)),
            pclk2: divided(ahb + apb2),
            timclk2: divided(ahb + apb2.saturating_sub(1)),
        }
    }
}

/// The divider that HPRE selects, as a power of two.
pub(super) fn hclk_shift(hpre: u32) -> u32 {
    match hpre & 0xF {
        0..8 => 0,
        code @ 8..12 => code - 7,
        code => code - 6,
    }
}

/// The divider that PPRE1 or PPRE2 selects, as a power of two.
pub(super) fn apb_shift(ppre: u32) -> u32 {
    if ppre & 4 == 0 { 0 } else { (ppre & 3) + 1 }
}

/// RCC's register with the bit that enables a peripheral, and the number of the bit, which is that of its reset, too.
pub type Gate = (u32, u32);

/// What the chip needs of RCC, whatever its registers are.
pub trait Rcc: fmt::Debug + Send {
    /// Resets every register; reset flags accumulate until RMVF or a power-on.
    fn reset(&mut self, cause: ResetCause);

    /// A register as it was written.
    fn reg(&self, offset: u32) -> u32;

    fn enabled(&self, gate: Option<Gate>) -> bool {
        gate.is_none_or(|(register, bit)| self.reg(register) >> bit & 1 == 1)
    }

    fn held_in_reset(&self, gate: Option<Gate>) -> bool {
        gate.is_some_and(|(register, bit)| self.reg(register - 0x20) >> bit & 1 == 1)
    }

    /// The value of a register, or `None` if the part does not have it.
    fn read(&self, offset: u32, now: Time) -> Option<u32>;

    /// Writes a register. A write that a real chip would not accept is ignored, as there, and returned as a problem.
    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem>;

    /// Whether the register belongs to the backup domain.
    fn is_backup_domain(&self, offset: u32) -> bool;

    fn clocks(&self) -> Clocks;

    /// Stops the crystal at `now`. The clock security system, if it is on, switches to HSI and interrupts (RM0090
    /// 7.2.7).
    fn stop_crystal(&mut self, now: Time);

    /// Allows the crystal to oscillate again from `now` on.
    fn start_crystal(&mut self, now: Time);

    /// Whether SYSCLK has stopped because its crystal has.
    fn is_stopped(&self) -> bool;

    /// Starts LSI on behalf of the watchdog, which keeps it on.
    fn force_lsi(&mut self, now: Time);

    /// Sets the clocks of the boot loader: 60 MHz by crystal and PLL, and CSS; USB and GPIOA have clocks.
    fn leave_loader(&mut self, _: Time) {
        unimplemented!("only the boot loader of an STM32F4 is modelled")
    }

    /// The clock HSE_RTC as the crystal and its divider, if there is one.
    fn hse_rtc(&self) -> Option<(Clock, u32)> {
        None
    }

    /// The level of the non-maskable interrupt: the clock security system has detected a failure of the crystal.
    fn nmi(&self) -> bool {
        false
    }
}

/// The RCC of an STM32F4.
#[derive(Debug)]
pub struct RccF4 {
    part: Part,
    crystal: Clock,
    /// The crystal oscillates when switched on.
    crystal_works: bool,
    hse_start: Time,
    is_external: bool,
    hsi: Clock,
    start_up: StartUp,
    regs: [u32; 38],
    hsi_ready: Time,
    hse_ready: Time,
    pll_ready: [Time; 3],
    lsi_ready: Time,
    /// CR and CFGR as they were before the latest write, and until when the flags show that.
    before: (u32, u32, Time),
}

impl RccF4 {
    /// The offset of the backup domain's register.
    const BDCR: u32 = 0x70;

    /// The state after power-on, with `crystal` as HSE.
    pub fn new(part: Part, crystal: Clock, variant: &ChipVariant) -> Self {
        let mut rcc = Self {
            part,
            crystal,
            crystal_works: crystal.hz > 0,
            hse_start: variant.hse_start,
            is_external: variant.external_clock,
            hsi: Clock { ppm: variant.hsi_ppm, ..HSI },
            start_up: variant.start_up,
            regs: [0; 38],
            before: (0, 0, Time::ZERO),
            hsi_ready: Time::ZERO,
            hse_ready: Time::MAX,
            pll_ready: [Time::MAX; 3],
            lsi_ready: Time::MAX,
        };
        rcc.reset(ResetCause::PowerOn);
        rcc
    }

    fn write_cr(&mut self, old: u32, value: u32, now: Time) -> Result<(), Problem> {
        let on_pll = self.reg(CFGR) & 3 == 2;
        if (on_pll && value & PLLON == 0) || (self.sysclk_needs_hse() && value & HSEON == 0) {
            return Err(Problem::Misuse("a clock that SYSCLK depends on was switched off"));
        }
        let starts = |bit: u32| value & bit != 0 && old & bit == 0;
        // HSEBYP changes only while HSE is off (RM0090 7.3.1).
        self.note_before(now);
        let is_on = self.before.0 & (HSEON | HSEON << 1) != 0;
        let value = if is_on { value & !HSEBYP | old & HSEBYP } else { value };
        self.regs[CR as usize / 4] = value;
        if starts(HSEON) {
            self.start_hse(now);
        }
        if starts(HSION) {
            self.hsi_ready = now + HSI_START;
        }
        if value & HSEON == 0 {
            self.hse_ready = Time::MAX;
        }
        for (ready, bit) in self.pll_ready.iter_mut().zip([PLLON, PLLI2SON, PLLSAION]) {
            if value & bit == 0 {
                *ready = Time::MAX;
            } else if starts(bit) {
                *ready = now + self.start_up.pll();
            }
        }
        if starts(PLLON) { self.check_pll() } else { Ok(()) }
    }

    fn start_hse(&mut self, now: Time) {
        let ready = now.as_ps().saturating_add(self.hse_start.as_ps());
        let works = self.crystal_works && (self.reg(CR) & HSEBYP != 0) == self.is_external;
        self.hse_ready = if works { Time::from_ps(ready) } else { Time::MAX };
    }

    /// Keeps what the flags show until the clocks have followed a write.
    fn note_before(&mut self, now: Time) {
        let shown = |offset| self.read(offset, now).unwrap_or(0);
        self.before = (shown(CR), shown(CFGR), now + SWITCH);
    }

    fn sysclk_needs_hse(&self) -> bool {
        match self.reg(CFGR) & 3 {
            1 => true,
            2 => self.reg(PLLCFGR) >> 22 & 1 == 1,
            _ => false,
        }
    }

    fn exists(&self, offset: u32) -> bool {
        match offset {
            0x00..=0x18 | 0x20 | 0x24 | 0x30..=0x38 | 0x40 | 0x44 | 0x50..=0x58 | 0x60 | 0x64 => {
                true
            }
            Self::BDCR | CSR | 0x80 | 0x84 => true,
            0x88 => self.part.has_overdrive(),
            0x8C => self.part.has_dedicated_clocks(),
            0x90 | 0x94 => self.part.has_clock_gating(),
            _ => false,
        }
    }

    fn pll_source(&self) -> Clock {
        if self.reg(PLLCFGR) >> 22 & 1 == 1 { self.crystal } else { self.hsi }
    }

    /// The nominal frequencies of the PLL's input and its VCO.
    fn pll(&self) -> (u64, u64) {
        let pllcfgr = self.reg(PLLCFGR);
        let source = u64::from(self.pll_source().hz);
        let m = u64::from(pllcfgr & 0x3F).max(2);
        let n = u64::from(pllcfgr >> 6 & 0x1FF);
        (source / m, source * n / m)
    }

    fn check_pll(&self) -> Result<(), Problem> {
        let (input, vco) = self.pll();
        if !(950_000..=2_100_000).contains(&input) {
            return Err(Problem::Misuse("PLL input outside 0.95..2.1 MHz"));
        }
        if !(100_000_000..=432_000_000).contains(&vco) {
            return Err(Problem::Misuse("PLL VCO outside 100..432 MHz"));
        }
        Ok(())
    }

    fn check_limits(&self) -> Result<(), Problem> {
        let clocks = self.clocks();
        let (sysclk, pclk1, pclk2) = self.part.clock_limits();
        if clocks.sysclk.hz > sysclk || clocks.pclk1.hz > pclk1 || clocks.pclk2.hz > pclk2 {
            return Err(Problem::Misuse("SYSCLK, APB1 or APB2 above the part's limit"));
        }
        Ok(())
    }
}

impl Rcc for RccF4 {
    fn reset(&mut self, cause: ResetCause) {
        let flags = match cause {
            ResetCause::PowerOn => 0,
            _ => self.reg(CSR) & 0xFE00_0000,
        };
        let backup_domain = if cause == ResetCause::PowerOn { 0 } else { self.reg(Self::BDCR) };
        self.regs = [0; 38];
        let ccm = if self.part.ccm_size() > 0 { 1 << 20 } else { 0 };
        for (offset, value) in [
            (CR, 0x83),
            (PLLCFGR, 0x2400_3010),
            (AHB1ENR, ccm),
            (0x50, 0x7E67_91FF),
            (0x54, 0x0000_00F1),
            (0x58, 0x0000_0001),
            (0x60, 0x36FE_C9FF),
            (0x64, 0x0007_5F33),
            (Self::BDCR, backup_domain),
            (CSR, flags | cause.flags()),
            (0x84, 0x2000_3000),
            (0x88, 0x2400_3000),
        ] {
            self.regs[offset as usize / 4] = value;
        }
        self.hsi_ready = Time::ZERO;
        self.hse_ready = Time::MAX;
        self.pll_ready = [Time::MAX; 3];
        self.lsi_ready = Time::MAX;
        self.before.2 = Time::ZERO;
    }

    fn reg(&self, offset: u32) -> u32 {
        self.regs[offset as usize / 4]
    }

    fn read(&self, offset: u32, now: Time) -> Option<u32> {
        if !self.exists(offset) {
            return None;
        }
        let value = self.reg(offset);
        Some(match offset {
            CR => {
                let [pll, i2s, sai] = self.pll_ready;
                let oscillators = [
                    (HSION, self.hsi_ready),
                    (HSEON, self.hse_ready),
                    (PLLON, pll),
                    (PLLI2SON, i2s),
                    (PLLSAION, sai),
                ];
                let was = if now < self.before.2 { self.before.0 } else { 0 };
                oscillators.into_iter().fold(value, |cr, (on, ready)| {
                    let is_ready = if value & on != 0 { now >= ready } else { was & on << 1 != 0 };
                    cr & !(on << 1) | if is_ready { on << 1 } else { 0 }
                })
            }
            CFGR if now < self.before.2 => value & !0xC | self.before.1 & 0xC,
            CFGR => value & !0xC | (value & 3) << 2,
            CSR if value & LSION != 0 && now >= self.lsi_ready => value | LSION << 1,
            _ => value,
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
        if !self.exists(offset) {
            return Err(Problem::Unmodelled);
        }
        let old = self.reg(offset);
        let mut value = value;
        match offset {
            CR => return self.write_cr(old, value, now),
            PLLCFGR if self.reg(CR) & PLLON != 0 && value != old => {
                return Err(Problem::Misuse("PLLCFGR written while the PLL is on"));
            }
            CFGR => {
                let ready = match value & 3 {
                    0 => now >= self.hsi_ready,
                    1 => now >= self.hse_ready,
                    2 => now >= self.pll_ready[0],
                    _ => false,
                };
                if !ready {
                    return Err(Problem::Misuse("SYSCLK switched to a source that is not ready"));
                }
                value &= !0xC;
                self.note_before(now);
            }
            // The upper bits, which read as 0, clear flags.
            CIR => value = value & 0x7F00 | old & 0xFF & !(value >> 16),
            Self::BDCR => {
                // A clock of the RTC stays selected until BDRST.
                let selected =
                    if old & RTCSEL != 0 { value & !RTCSEL | old & RTCSEL } else { value };
                value = if value & BDRST != 0 { BDRST } else { selected & BDCR_WRITABLE };
                if value & LSEON != 0 && old & LSEON == 0 {
                    self.regs[Self::BDCR as usize / 4] = value;
                    return Err(Problem::Misuse(
                        "LSE is switched on, but the board has no crystal for it",
                    ));
                }
            }
            CSR => {
                if value & LSION != 0 && old & LSION == 0 {
                    self.lsi_ready = now + self.start_up.lsi();
                }
                let flags = if value & RMVF != 0 { 0 } else { old & 0xFE00_0000 };
                value = value & LSION | flags;
            }
            _ => {}
        }
        self.regs[offset as usize / 4] = value;
        if offset == CFGR { self.check_limits() } else { Ok(()) }
    }

    fn is_backup_domain(&self, offset: u32) -> bool {
        offset == Self::BDCR
    }

    fn clocks(&self) -> Clocks {
        let cfgr = self.reg(CFGR);
        let sysclk = match cfgr & 3 {
            0 => self.hsi,
            1 => self.crystal,
            _ => {
                let divider = 2 * (u64::from(self.reg(PLLCFGR) >> 16 & 3) + 1);
                Clock { hz: (self.pll().1 / divider) as u32, ..self.pll_source() }
            }
        };
        Clocks::divided(sysclk, hclk_shift(cfgr >> 4), apb_shift(cfgr >> 10), apb_shift(cfgr >> 13))
    }

    fn stop_crystal(&mut self, now: Time) {
        self.crystal_works = false;
        let was_ready = now >= self.hse_ready;
        self.hse_ready = Time::MAX;
        self.before.2 = Time::ZERO;
        let cr = self.reg(CR);
        if !was_ready || cr & CSSON == 0 {
            return;
        }
        let mut off = HSEON;
        if self.sysclk_needs_hse() {
            if self.reg(CFGR) & 3 == 2 {
                off |= PLLON | PLLI2SON;
                self.pll_ready = [Time::MAX; 3];
            }
            self.regs[CFGR as usize / 4] &= !3;
        }
        self.regs[CR as usize / 4] = cr & !off | HSION;
        self.regs[CIR as usize / 4] |= CSSF;
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
            self.regs[CSR as usize / 4] |= LSION;
            self.lsi_ready = now + self.start_up.lsi();
        }
    }

    fn leave_loader(&mut self, now: Time) {
        let input_divider = self.crystal.hz / 1_000_000;
        for (offset, value) in [
            (PLLCFGR, 5 << 24 | 1 << 22 | 1 << 16 | 240 << 6 | input_divider),
            (CR, 0x83 | HSEON | CSSON | PLLON | if self.is_external { HSEBYP } else { 0 }),
            (CFGR, 4 << 10 | 2),
            (AHB1ENR, self.reg(AHB1ENR) | 1),
            (AHB2ENR, 1 << 7),
            (APB2ENR, 1 << 14),
        ] {
            self.regs[offset as usize / 4] = value;
        }
        self.hse_ready = now;
        self.pll_ready[0] = now;
    }

    fn hse_rtc(&self) -> Option<(Clock, u32)> {
        let divider = self.reg(CFGR) >> 16 & 0x1F;
        let runs = self.hse_ready != Time::MAX && divider > 1;
        runs.then_some((self.crystal, divider))
    }

    fn nmi(&self) -> bool {
        self.reg(CIR) & CSSF != 0
    }
}
