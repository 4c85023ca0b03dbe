//! USART1 to USART6 as outputs (RM0090 chapter 30): a byte is sent at once, and nothing is received.

use super::{
    Problem,
    registers::{Apb, Place, Registers},
};
use crate::Time;

const SR: u32 = 0x00;
const DR: u32 = 0x04;
const CR1: u32 = 0x0C;

/// TXE and TC, which lie at the same places in SR and as TXEIE and TCIE in CR1.
const SENT: u32 = 1 << 7 | 1 << 6;
/// UE and TE.
const TRANSMITTER_ON: u32 = 1 << 13 | 1 << 3;

/// The properties in which the USARTs differ.
#[derive(Debug)]
pub struct Kind {
    pub place: Place,
    irq: u32,
}

/// USART1 to USART6 (RM0090 2.3, 7.3 and table 61).
pub static KINDS: [Kind; 6] = [
    Kind { place: (Apb::Two, 4), irq: 37 },
    Kind { place: (Apb::One, 17), irq: 38 },
    Kind { place: (Apb::One, 18), irq: 39 },
    Kind { place: (Apb::One, 19), irq: 52 },
    Kind { place: (Apb::One, 20), irq: 53 },
    Kind { place: (Apb::Two, 5), irq: 71 },
];

/// A transmitter whose bytes are collected.
#[derive(Debug)]
pub struct Usart {
    kind: &'static Kind,
    regs: [u32; 7],
    sent: Vec<u8>,
}

impl Usart {
    /// The state after a reset.
    pub fn new(kind: &'static Kind) -> Self {
        Self { kind, regs: [0; 7], sent: Vec::new() }
    }

    pub fn take_sent(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.sent)
    }

    /// The level of its interrupt, bit n for interrupt n.
    pub fn irqs(&self) -> u128 {
        if self.regs[CR1 as usize / 4] & SENT == 0 { 0 } else { 1 << self.kind.irq }
    }
}

impl Registers for Usart {
    /// What was sent is kept.
    fn reset(&mut self, _: Time) {
        self.regs = [0; 7];
    }

    fn read(&mut self, offset: u32, _: Time) -> Option<u32> {
        let value = *self.regs.get(offset as usize / 4)?;
        Some(if offset == SR { SENT } else { value })
    }

    fn write(&mut self, offset: u32, value: u32, _: Time) -> Result<(), Problem> {
        let is_on = self.regs[CR1 as usize / 4] & TRANSMITTER_ON == TRANSMITTER_ON;
        let register = self.regs.get_mut(offset as usize / 4).ok_or(Problem::Unmodelled)?;
        match offset {
            SR => {}
            DR => self.sent.extend(is_on.then_some(value as u8)),
            _ => *register = value,
        }
        Ok(())
    }
}
