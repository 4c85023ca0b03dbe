//! The random number generator (RM0090 chapter 24): every run gives the same numbers, without waiting.

use super::{Problem, registers::Registers};
use crate::Time;

const CR: u32 = 0x00;
const SR: u32 = 0x04;
const DR: u32 = 0x08;

const RNGEN: u32 = 1 << 2;
const IE: u32 = 1 << 3;

/// A generator that is always ready while it is on.
#[derive(Debug)]
pub struct Rng {
    cr: u32,
    state: u32,
}

impl Rng {
    pub fn new() -> Self {
        Self { cr: 0, state: 0x2545_F491 }
    }

    pub fn irq(&self) -> bool {
        self.cr == RNGEN | IE
    }
}

impl Registers for Rng {
    fn reset(&mut self, _: Time) {
        self.cr = 0;
    }

    fn read(&mut self, offset: u32, _: Time) -> Option<u32> {
        let is_on = self.cr & RNGEN != 0;
        Some(match offset {
            CR => self.cr,
            SR => is_on.into(),
            DR if is_on => {
                self.state ^= self.state << 13;
                self.state ^= self.state >> 17;
                self.state ^= self.state << 5;
                self.state
            }
            DR => 0,
            _ => return None,
        })
    }

    fn write(&mut self, offset: u32, value: u32, _: Time) -> Result<(), Problem> {
        match offset {
            CR => self.cr = value & (RNGEN | IE),
            SR | DR => {}
            _ => return Err(Problem::Unmodelled),
        }
        Ok(())
    }
}
