//! The CRC unit (RM0090 chapter 4): CRC-32 of whole words. The four cycles that it takes for a word are left out.

use super::{Problem, registers::Registers};
use crate::Time;

const DR: u32 = 0x00;
const IDR: u32 = 0x04;
const CR: u32 = 0x08;

const CR_RESET: u32 = 1;
const POLYNOMIAL: u32 = 0x04C1_1DB7;

/// The unit of an STM32F4, whose polynomial and first value are fixed.
#[derive(Debug)]
pub struct Crc {
    value: u32,
    independent: u8,
}

impl Crc {
    pub fn new() -> Self {
        Self { value: u32::MAX, independent: 0 }
    }
}

impl Registers for Crc {
    fn reset(&mut self, _: Time) {
        *self = Self::new();
    }

    fn read(&mut self, offset: u32, _: Time) -> Option<u32> {
        Some(match offset {
            DR => self.value,
            IDR => self.independent.into(),
            CR => 0,
            _ => return None,
        })
    }

    fn write(&mut self, offset: u32, value: u32, _: Time) -> Result<(), Problem> {
        match offset {
            DR => {
                self.value = (0..32).fold(self.value ^ value, |crc, _| {
                    crc << 1 ^ if crc >> 31 == 1 { POLYNOMIAL } else { 0 }
                });
            }
            IDR => self.independent = value as u8,
            // The reset leaves CRC_IDR as it is (RM0090 4.4.2).
            CR if value & CR_RESET != 0 => self.value = u32::MAX,
            CR => {}
            _ => return Err(Problem::Unmodelled),
        }
        Ok(())
    }
}
