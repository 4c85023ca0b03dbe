//! An access of the CPU to a peripheral, the registers that it reaches, and their place on the buses.

use super::Problem;
use crate::Time;

/// The bus responds with an error, and the CPU takes a BusFault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BusFault;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Width {
    Byte = 1,
    Half = 2,
    Word = 4,
}

impl Width {
    /// The width of an access of this many bytes, if there is one.
    pub const fn of(bytes: usize) -> Option<Self> {
        match bytes {
            1 => Some(Self::Byte),
            2 => Some(Self::Half),
            4 => Some(Self::Word),
            _ => None,
        }
    }

    pub const fn bytes(self) -> u32 {
        self as u32
    }

    pub(super) const fn mask(self) -> u32 {
        u32::MAX >> (32 - 8 * self.bytes())
    }
}

/// A load or store by the CPU, naturally aligned.
#[derive(Clone, Copy, Debug)]
pub struct Access {
    pub address: u32,
    pub width: Width,
    /// The time of the access.
    pub now: Time,
    pub pc: u32,
}

/// The registers of a peripheral, by their offsets from its first one.
pub(super) trait Registers {
    /// Resets the peripheral as RCC does.
    fn reset(&mut self, now: Time);

    /// The value of a register, or `None` if it does not exist or is not modelled.
    fn read(&mut self, offset: u32, now: Time) -> Option<u32>;

    /// Writes a register. What a problem says of the write is in its description.
    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem>;
}

/// A peripheral bus: APB1, from 4000_0000h on, or APB2, from 4001_0000h on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Apb {
    One,
    Two,
}

/// The place of a peripheral: its bus, and the kilobyte there. That is also the number of its bits in the bus's RCC
/// registers, but for a few of the STM32G4.
pub(super) type Place = (Apb, u32);
