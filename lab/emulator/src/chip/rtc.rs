//! The real-time clock (RM0090 chapter 26): its sub-second counter and the backup registers. Time and date stand still,
//! and there are no alarms and no wake-up timer.

use super::{Problem, registers::Registers};
use crate::Time;

const TR: u32 = 0x00;
const DR: u32 = 0x04;
const CR: u32 = 0x08;
const ISR: u32 = 0x0C;
const PRER: u32 = 0x10;
const WUTR: u32 = 0x14;
const WPR: u32 = 0x24;
const SSR: u32 = 0x28;
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
    /// When the sub-second counter was last at its beginning.
    since: Time,
    /// The frequency of its clock in Hz; 0 if it has none.
    hz: u32,
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
        Self { regs, since: Time::ZERO, hz: 0, keys: 0 }
    }

    /// Sets the frequency of its clock in Hz, 0 for none.
    pub fn set_clock(&mut self, hz: u32, now: Time) {
        if self.hz != hz {
            (self.hz, self.since) = (hz, now);
        }
    }

    fn reg(&self, offset: u32) -> u32 {
        self.regs[offset as usize / 4]
    }

    /// The whole seconds since the counter was last at its beginning, and its value.
    fn passed(&self, now: Time) -> (u64, u32) {
        let (asynchronous, synchronous) = (self.reg(PRER) >> 16 & 0x7F, self.reg(PRER) & 0x7FFF);
        if self.reg(ISR) & INIT != 0 {
            return (0, synchronous);
        }
        let ps = u128::from(now.saturating_sub(self.since).as_ps());
        let period = u128::from(asynchronous + 1) * 1_000_000_000_000;
        let ticks = (ps * u128::from(self.hz) / period) as u64;
        let in_second = u64::from(synchronous) + 1;
        (ticks / in_second, synchronous - (ticks % in_second) as u32)
    }
}

impl Registers for Rtc {
    fn reset(&mut self, _: Time) {
        *self = Self::new();
    }

    fn read(&mut self, offset: u32, now: Time) -> Option<u32> {
        let value = *self.regs.get(offset as usize / 4)?;
        let flag = |bit, is_set: bool| if is_set { bit } else { 0 };
        let (seconds, subseconds) = self.passed(now);
        Some(match offset {
            TR | DR if seconds > 0 => return None,
            SSR => subseconds,
            ISR => {
                let initializing = value & INIT != 0;
                // The shadow registers follow at once.
                value & INIT
                    | ISR_WRITE_FLAGS
                    | flag(INITS, self.reg(DR) & YEAR != 0)
                    | flag(RSF, !initializing)
                    | flag(INITF, initializing)
            }
            WPR => 0,
            _ => value,
        })
    }

    /// The backup registers need no key.
    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
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
            TR | DR if self.reg(ISR) & INIT == 0 => {
                return Err(Problem::Misuse("the calendar is written outside of initialisation"));
            }
            TR..END => {
                if offset < BACKUP {
                    self.since = now;
                }
                self.regs[offset as usize / 4] = value;
            }
            _ => return Err(Problem::Unmodelled),
        }
        Ok(())
    }
}
