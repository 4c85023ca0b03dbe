//! Small blocks: PWR, SYSCFG, EXTI, DBGMCU, and the factory data (unique id, flash size).

use std::fmt;

use super::{
    Part, Problem, Thresholds, adc,
    part::Family,
    registers::{Place, Registers},
};
use crate::Time;

/// What the chip needs of PWR, whatever its registers are.
pub trait Power: Registers + fmt::Debug + Send {
    /// Whether DBP lets the program write to the backup domain.
    fn backup_domain_is_writable(&self) -> bool;

    fn set_supply(&mut self, mv: u32);

    fn supply(&self) -> u32;

    /// The highest HCLK in Hz at the present voltage scale.
    fn max_hclk(&self) -> u32;

    /// Whether range 1 of an STM32G4 is boosted.
    fn is_boosted(&self) -> bool {
        false
    }
}

/// PWR (RM0090 chapter 5): the voltage detector, and the voltage scale and over-drive bits that clock set-up waits for,
/// which take effect at once.
#[derive(Debug)]
pub struct Pwr {
    part: Part,
    thresholds: Thresholds,
    supply_mv: u32,
    /// What the voltage detector shows while it is on.
    is_low: bool,
    cr: u32,
    csr: u32,
}

impl Pwr {
    const CR: u32 = 0x00;
    const CSR: u32 = 0x04;
    const PVDE: u32 = 1 << 4;
    const DBP: u32 = 1 << 8;
    const PVDO: u32 = 1 << 2;
    const VOSRDY: u32 = 1 << 14;
    /// ODEN and ODSWEN in CR, ODRDY and ODSWRDY in CSR.
    const OVERDRIVE: u32 = 1 << 16 | 1 << 17;

    /// The state after a reset, with 3.3 V.
    pub fn new(part: Part, thresholds: Thresholds) -> Self {
        let cr = part.power_after_reset();
        Self { part, thresholds, supply_mv: 3_300, is_low: true, cr, csr: 0 }
    }

    /// Lets the voltage detector compare the supply with its level.
    fn detect(&mut self) {
        self.is_low = self.thresholds.detects(self.cr >> 5 & 7, self.supply_mv, self.is_low);
    }

    fn pvdo(&self) -> u32 {
        if self.cr & Self::PVDE != 0 && self.is_low { Self::PVDO } else { 0 }
    }
}

impl Power for Pwr {
    fn backup_domain_is_writable(&self) -> bool {
        self.cr & Self::DBP != 0
    }

    fn set_supply(&mut self, mv: u32) {
        self.supply_mv = mv;
        self.detect();
    }

    fn supply(&self) -> u32 {
        self.supply_mv
    }

    fn max_hclk(&self) -> u32 {
        self.part.voltage_limit(self.cr >> 14 & 3, self.cr & Self::OVERDRIVE == Self::OVERDRIVE)
    }
}

impl Registers for Pwr {
    /// The supply remains the same.
    fn reset(&mut self, _: Time) {
        *self = Self { supply_mv: self.supply_mv, ..Self::new(self.part, self.thresholds) };
    }

    fn read(&mut self, offset: u32, _: Time) -> Option<u32> {
        match offset {
            Self::CR => Some(self.cr),
            Self::CSR => Some(self.csr | Self::VOSRDY | self.cr & Self::OVERDRIVE | self.pvdo()),
            _ => None,
        }
    }

    fn write(&mut self, offset: u32, value: u32, _: Time) -> Result<(), Problem> {
        match offset {
            Self::CR => {
                // A detector that is switched on finds a supply sufficient that is above the rising level.
                self.is_low |= self.cr & Self::PVDE == 0;
                self.cr = value & self.part.power_bits();
                self.detect();
            }
            Self::CSR => self.csr = value & (1 << 8 | 1 << 9),
            _ => return Err(Problem::Unmodelled),
        }
        Ok(())
    }
}

/// The memory that also lies at address 0 (RM0090 9.2.1), by its value in SYSCFG_MEMRMP.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum AtZero {
    /// The flash, as after a reset with BOOT0 low.
    #[default]
    Flash = 0,
    System = 1,
    Sram = 3,
}

/// SYSCFG (RM0090 chapter 9): memory remap, interrupt line selection, compensation cell.
#[derive(Debug, Default)]
pub struct Syscfg {
    /// The memory at address 0 after a reset.
    boot: AtZero,
    regs: [u32; 9],
}

impl Syscfg {
    /// A register of an STM32G4, and its flag that a 1 clears.
    const CFGR2: u32 = 0x18;
    const SPF: u32 = 1 << 8;

    /// The state after a reset: the memory at address 0 is that of the boot pins.
    pub fn new(boot: AtZero) -> Self {
        let mut regs = [0; 9];
        regs[0] = boot as u32;
        Self { boot, regs }
    }

    /// Sets SPF of an STM32G4, as an error of the parity of its SRAM does (RM0440 10.2.7).
    pub fn fail_parity(&mut self) {
        self.regs[Self::CFGR2 as usize / 4] |= Self::SPF;
    }

    /// The level of the non-maskable interrupt.
    pub fn nmi(&self) -> bool {
        self.regs[Self::CFGR2 as usize / 4] & Self::SPF != 0
    }

    pub fn at_zero(&self) -> AtZero {
        match self.regs[0] & 3 {
            1 => AtZero::System,
            3 => AtZero::Sram,
            _ => AtZero::Flash,
        }
    }
}

impl Registers for Syscfg {
    fn reset(&mut self, _: Time) {
        *self = Self::new(self.boot);
    }

    fn read(&mut self, offset: u32, _: Time) -> Option<u32> {
        let value = *self.regs.get(offset as usize / 4)?;
        // The compensation cell is ready as soon as it is on.
        Some(if offset == 0x20 { value | (value & 1) << 8 } else { value })
    }

    /// A remap other than those of [`AtZero`] is not modelled.
    fn write(&mut self, offset: u32, value: u32, _: Time) -> Result<(), Problem> {
        let register = self.regs.get_mut(offset as usize / 4).ok_or(Problem::Unmodelled)?;
        *register = match offset {
            Self::CFGR2 => value & !Self::SPF | *register & !value & Self::SPF,
            _ => value,
        };
        let is_modelled = offset != 0 || matches!(value, 0 | 1 | 3);
        if is_modelled { Ok(()) } else { Err(Problem::Unmodelled) }
    }
}

const EXTI_PR: u32 = 0x14;

/// EXTI (RM0090 chapter 12): masks, without effect: no pin is connected to it, and software events are not modelled.
#[derive(Debug, Default)]
pub struct Exti {
    /// IMR, EMR, RTSR and FTSR.
    masks: [u32; 4],
}

impl Registers for Exti {
    fn reset(&mut self, _: Time) {
        *self = Self::default();
    }

    fn read(&mut self, offset: u32, _: Time) -> Option<u32> {
        match offset {
            EXTI_PR => Some(0),
            _ => self.masks.get(offset as usize / 4).copied(),
        }
    }

    fn write(&mut self, offset: u32, value: u32, _: Time) -> Result<(), Problem> {
        if offset != EXTI_PR {
            let mask = self.masks.get_mut(offset as usize / 4).ok_or(Problem::Unmodelled)?;
            *mask = value & 0x007F_FFFF;
        }
        Ok(())
    }
}

/// DBGMCU (RM0090 38.16, RM0440 47.17): identification, and what stops while a debugger has halted the core.
#[derive(Debug)]
pub struct Dbgmcu {
    family: Family,
    regs: [u32; 5],
}

impl Dbgmcu {
    /// The state after power-on.
    pub fn new(part: Part) -> Self {
        Self { family: part.family(), regs: [part.id_code(), 0, 0, 0, 0] }
    }

    /// The place of APB2_FZ, the last register.
    fn last(&self) -> usize {
        if self.family == Family::G4 { 4 } else { 3 }
    }

    /// APB1_FZ and APB2_FZ.
    fn freezes(&self) -> [u32; 2] {
        [self.regs[2], self.regs[self.last()]]
    }

    pub fn freezes_watchdog(&self) -> bool {
        self.freezes()[0] >> 12 & 1 == 1
    }

    /// Each timer has the bit of its place.
    pub fn freezes_timer(&self, (bus, place): Place) -> bool {
        self.freezes()[bus as usize] >> place & 1 == 1
    }

    /// Whether it freezes something else, as CAN.
    pub fn freezes_others(&self) -> bool {
        self.freezes()[0] & !0x11FF != 0
    }
}

impl Registers for Dbgmcu {
    /// Only power-on resets it.
    fn reset(&mut self, _: Time) {}

    fn read(&mut self, offset: u32, _: Time) -> Option<u32> {
        self.regs.get(offset as usize / 4).copied()
    }

    fn write(&mut self, offset: u32, value: u32, _: Time) -> Result<(), Problem> {
        match offset as usize / 4 {
            index if index > 0 && index <= self.last() => self.regs[index] = value,
            _ => return Err(Problem::Unmodelled),
        }
        Ok(())
    }
}

/// The factory data in system memory (RM0090 chapter 39), read only, and in place of the boot loader a vector table
/// whose handlers return at once.
#[derive(Debug)]
pub struct Factory {
    family: Family,
    unique_id: [u8; 12],
    flash_kb: u16,
}

impl Factory {
    /// The vector table of the boot loader.
    const VECTORS: u32 = 0x1FFF_0000;
    /// Its handler: `bx lr`.
    const HANDLER: u32 = 0x1FFF_0400;
    /// The first address of the one-time programmable bytes, which are all blank.
    const OTP: u32 = 0x1FFF_7800;
    const UNIQUE_ID: u32 = 0x1FFF_7A10;
    const FLASH_SIZE: u32 = 0x1FFF_7A22;
    /// The same of an STM32G4 (RM0440 chapter 48).
    const UNIQUE_ID_G4: u32 = 0x1FFF_7590;
    const FLASH_SIZE_G4: u32 = 0x1FFF_75E0;
    /// The calibration of the voltage reference, then of the temperature sensor (data sheet).
    const CALIBRATION: u32 = 0x1FFF_7A2A;

    /// The data of one chip.
    pub fn new(part: Part, unique_id: [u8; 12]) -> Self {
        let flash_kb = (part.flash_size() / 1024) as u16;
        Self { family: part.family(), unique_id, flash_kb }
    }

    /// One byte, or `None` if its content is unknown.
    pub fn byte(&self, address: u32) -> Option<u8> {
        match self.family {
            Family::F4 => self.byte_f4(address),
            Family::G4 => {
                let id = address.wrapping_sub(Self::UNIQUE_ID_G4) as usize;
                let size = address.wrapping_sub(Self::FLASH_SIZE_G4) as usize;
                let bytes = self.flash_kb.to_le_bytes();
                self.unique_id.get(id).or(bytes.get(size)).copied()
            }
        }
    }

    fn byte_f4(&self, address: u32) -> Option<u8> {
        let id = address.wrapping_sub(Self::UNIQUE_ID) as usize;
        match address {
            Self::VECTORS..Self::HANDLER => {
                Some((Self::HANDLER | 1).to_le_bytes()[address as usize % 4])
            }
            Self::HANDLER => Some(0x70),
            0x1FFF_0401 => Some(0x47),
            Self::OTP..Self::UNIQUE_ID => Some(0xFF),
            _ if id < 12 => Some(self.unique_id[id]),
            Self::FLASH_SIZE => Some(self.flash_kb.to_le_bytes()[0]),
            0x1FFF_7A23 => Some(self.flash_kb.to_le_bytes()[1]),
            Self::CALIBRATION..0x1FFF_7A30 => {
                let at = (address - Self::CALIBRATION) as usize;
                Some(adc::calibration()[at / 2].to_le_bytes()[at % 2])
            }
            _ => None,
        }
    }
}
