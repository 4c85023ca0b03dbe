//! The registers of the real-time clock (RM0090 chapter 26), as start-up code uses them: the calendar stands still.

use super::Problem;

const TR: u32 = 0x00;
const DR: u32 = 0x04;
const CR: u32 = 0x08;
const ISR: u32 = 0x0C;
const PRER: u32 = 0x10;
const WUTR: u32 = 0x14;
const WPR: u32 = 0x24;
const BACKUP: u32 = 0x50;
const END: u32 = 0xA0;

/// WUTE, ALRBE and ALRAE.
const CR_TIMERS: u32 = 0b111 << 8;
/// WUTWF, ALRBWF and ALRAWF: those registers may be written.
const ISR_WRITE_FLAGS: u32 = 0b111;
const INITS: u32 = 1 << 4;
const RSF: u32 = 1 << 5;
const INITF: u32 = 1 << 6;
const INIT: u32 = 1 << 7;
/// The years in DR.
const YEAR: u32 = 0xFF << 16;

/// The real-time clock and its backup registers.
#[derive(Debug)]
pub struct Rtc {
    regs: [u32; END as usize / 4],
    /// The number of keys that WPR has received: registers are writable with two.
    keys: u8,
}

impl Rtc {
    /// The state after a reset of the backup domain.
    pub fn new() -> Self {
        let mut regs = [0; END as usize / 4];
        for (offset, value) in [(DR, 0x2101), (PRER, 0x007F_00FF), (WUTR, 0xFFFF)] {
            regs[offset as usize / 4] = value;
        }
        Self { regs, keys: 0 }
    }

    /// The value of a register, or `None` if it does not exist.
    pub fn read(&self, offset: u32) -> Option<u32> {
        let value = *self.regs.get(offset as usize / 4)?;
        let flag = |bit, is_set: bool| if is_set { bit } else { 0 };
        Some(match offset {
            ISR => {
                let is_set = self.regs[DR as usize / 4] & YEAR != 0;
                let initializing = value & INIT != 0;
                // The shadow registers follow at once.
                value & INIT
                    | ISR_WRITE_FLAGS
                    | flag(INITS, is_set)
                    | flag(RSF, !initializing)
                    | flag(INITF, initializing)
            }
            WPR => 0,
            _ => value,
        })
    }

    /// Writes a register. The backup registers need no key.
    ///
    /// # Errors
    /// The register does not exist, or is protected, or the write switches on an alarm or the wake-up timer.
    pub fn write(&mut self, offset: u32, value: u32) -> Result<(), Problem> {
        match offset {
            WPR => {
                self.keys = match (value & 0xFF, self.keys) {
                    (0xCA, _) => 1,
                    (0x53, 1) => 2,
                    _ => 0,
                };
                return Ok(());
            }
            TR..BACKUP if self.keys < 2 => {
                return Err(Problem::Misuse("RTC register written without the keys"));
            }
            CR if value & CR_TIMERS != 0 => return Err(Problem::Unmodelled),
            TR..END => self.regs[offset as usize / 4] = value,
            _ => return Err(Problem::Unmodelled),
        }
        Ok(())
    }
}
