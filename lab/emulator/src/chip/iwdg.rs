//! IWDG (RM0090 chapter 21): the independent watchdog, clocked by LSI through sleep and flash stalls.

use super::{Problem, registers::Registers};
use crate::Time;

const KR: u32 = 0x00;
const PR: u32 = 0x04;
const RLR: u32 = 0x08;
const SR: u32 = 0x0C;

#[derive(Debug)]
pub struct Iwdg {
    lsi: u32,
    unlocked: bool,
    prescaler: u32,
    reload: u32,
    prescaler_busy: Time,
    reload_busy: Time,
    deadline: Option<Time>,
    /// The begin of the freeze, while a debugger has halted the core.
    frozen_since: Option<Time>,
}

impl Iwdg {
    /// The state after a reset: off, 4 x 4096 periods of an LSI of `lsi` Hz (32 kHz typical, 17..47 kHz).
    pub fn new(lsi: u32) -> Self {
        Self {
            lsi,
            unlocked: false,
            prescaler: 0,
            reload: 0xFFF,
            prescaler_busy: Time::ZERO,
            reload_busy: Time::ZERO,
            deadline: None,
            frozen_since: None,
        }
    }

    /// The time of the watchdog reset, if the watchdog runs.
    pub fn deadline(&self) -> Option<Time> {
        self.deadline.filter(|_| self.frozen_since.is_none())
    }

    /// Stops the count until [`thaw`](Self::thaw).
    pub fn freeze(&mut self, now: Time) {
        self.frozen_since = Some(now);
    }

    pub fn thaw(&mut self, now: Time) {
        if let (Some(since), Some(deadline)) = (self.frozen_since.take(), &mut self.deadline) {
            *deadline += now - since;
        }
    }

    fn lsi_periods(&self, count: u64) -> Time {
        Time::from_ps(count * 1_000_000_000_000 / u64::from(self.lsi))
    }

    fn count_down(&mut self, from: u32, now: Time) {
        let divider = 4u64 << self.prescaler.min(6);
        self.deadline = Some(now + self.lsi_periods(divider * u64::from(from + 1)));
    }

    /// Whether `KR = 0xCCCC` was written since the reset.
    pub fn running(&self) -> bool {
        self.deadline.is_some()
    }
}

impl Registers for Iwdg {
    /// LSI remains the same.
    fn reset(&mut self, _: Time) {
        *self = Self::new(self.lsi);
    }

    fn read(&mut self, offset: u32, now: Time) -> Option<u32> {
        let is_busy = |until| u32::from(now < until);
        Some(match offset {
            KR => 0,
            PR => self.prescaler,
            RLR => self.reload,
            SR => is_busy(self.prescaler_busy) | is_busy(self.reload_busy) << 1,
            _ => return None,
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
        match offset {
            KR => {
                let key = value & 0xFFFF;
                self.unlocked = key == 0x5555;
                match key {
                    // RM0090 21.3: the first count starts from the reset value, whatever RLR holds.
                    0xCCCC if !self.running() => self.count_down(0xFFF, now),
                    0xAAAA if self.running() => self.count_down(self.reload, now),
                    _ => {}
                }
            }
            PR if self.unlocked && now >= self.prescaler_busy => {
                self.prescaler = value & 7;
                self.prescaler_busy = now + self.lsi_periods(5);
            }
            RLR if self.unlocked && now >= self.reload_busy => {
                self.reload = value & 0xFFF;
                self.reload_busy = now + self.lsi_periods(5);
            }
            _ => {
                let why = "IWDG register written while protected or being updated";
                return Err(Problem::Misuse(why));
            }
        }
        Ok(())
    }
}
