//! The filter banks: 28 that CAN1 shares with CAN2 (RM0090 32.7.4, 32.9.4), or 14 of CAN3 alone (RM0430 Rev 8, 32.2).

use std::ops::Range;

use super::{Frame, Role};
use crate::can::Id;

const BANKS: usize = 28;
const BANKS_OF_CAN3: usize = 14;

const FMR: u32 = 0x000;
const FM1R: u32 = 0x004;
const FS1R: u32 = 0x00C;
const FFA1R: u32 = 0x014;
const FA1R: u32 = 0x01C;
const BANK_REGISTERS: u32 = 0x040;

const FMR_RESET_VALUE: u32 = 0x2A1C_0E01;
const FMR_FINIT: u32 = 1 << 0;
const FMR_WRITABLE: u32 = 0x3F01;
const CAN2SB_SHIFT: u32 = 8;

/// The filter banks and their registers, at offsets from FMR.
#[derive(Clone, Copy, Debug)]
pub struct Filters {
    role: Role,
    fmr: u32,
    fm1r: u32,
    fs1r: u32,
    ffa1r: u32,
    fa1r: u32,
    banks: [[u32; 2]; BANKS],
}

/// The identifier as it appears in RIR and in a 32-bit filter: STID or EXID, IDE, RTR.
pub fn identifier_word(frame: &Frame) -> u32 {
    let remote = u32::from(frame.remote) << 1;
    match frame.id {
        Id::Standard(id) => u32::from(id) << 21 | remote,
        Id::Extended(id) => id << 3 | 1 << 2 | remote,
    }
}

/// The identifier as it appears in a 16-bit filter: STID, RTR, IDE and the top three bits of EXID.
fn identifier_half(frame: &Frame) -> u32 {
    let word = identifier_word(frame);
    word >> 21 << 5 | (word >> 1 & 1) << 4 | (word >> 2 & 1) << 3 | word >> 18 & 0b111
}

impl Filters {
    /// The banks after a reset, as the controller of this role uses them.
    pub const fn new(role: Role) -> Self {
        Self {
            role,
            fmr: FMR_RESET_VALUE,
            fm1r: 0,
            fs1r: 0,
            ffa1r: 0,
            fa1r: 0,
            banks: [[0; 2]; BANKS],
        }
    }

    /// The same banks, as the controller of another role uses them.
    pub const fn used_as(self, role: Role) -> Self {
        Self { role, ..self }
    }

    const fn len(&self) -> usize {
        match self.role {
            Role::Master | Role::Slave => BANKS,
            Role::Single => BANKS_OF_CAN3,
        }
    }

    /// The bits of registers with one bit a bank.
    const fn bank_bits(&self) -> u32 {
        (1 << self.len()) - 1
    }

    /// The first offset behind the banks.
    const fn end(&self) -> u32 {
        BANK_REGISTERS + 8 * self.len() as u32
    }

    /// The banks that filter for the controller: CAN2SB is the first of CAN2. The field is assumed to be without effect
    /// on CAN3.
    fn own(&self) -> Range<usize> {
        let of_can2 = ((self.fmr >> CAN2SB_SHIFT & 0x3F) as usize).min(BANKS);
        match self.role {
            Role::Master => 0..of_can2,
            Role::Slave => of_can2..BANKS,
            Role::Single => 0..BANKS_OF_CAN3,
        }
    }

    pub fn read(&self, offset: u32) -> Option<u32> {
        Some(match offset {
            FMR => self.fmr,
            FM1R => self.fm1r,
            FS1R => self.fs1r,
            FFA1R => self.ffa1r,
            FA1R => self.fa1r,
            _ if (BANK_REGISTERS..self.end()).contains(&offset) => {
                let (bank, half) = place(offset);
                self.banks[bank][half]
            }
            _ => return None,
        })
    }

    /// Writes the register at `offset` from FMR. Mode, scale and assignment change only while FINIT is set, a bank only
    /// while FINIT is set or the bank is inactive. Returns whether the register and the bits exist.
    pub fn write(&mut self, offset: u32, value: u32) -> bool {
        let initializing = self.fmr & FMR_FINIT != 0;
        let (bank_bits, end) = (self.bank_bits(), self.end());
        let register = match offset {
            FMR => {
                self.fmr = FMR_RESET_VALUE & !FMR_WRITABLE | value & FMR_WRITABLE;
                return true;
            }
            FM1R => &mut self.fm1r,
            FS1R => &mut self.fs1r,
            FFA1R => &mut self.ffa1r,
            FA1R => {
                self.fa1r = value & bank_bits;
                return value & !bank_bits == 0;
            }
            _ if (BANK_REGISTERS..end).contains(&offset) => {
                let (bank, half) = place(offset);
                if initializing || self.fa1r >> bank & 1 == 0 {
                    self.banks[bank][half] = value;
                }
                return true;
            }
            _ => return false,
        };
        if initializing {
            *register = value & bank_bits;
        }
        value & !bank_bits == 0
    }

    /// For each FIFO, the filter match index if it accepts `frame`; FINIT drops the frame.
    ///
    /// Of several matches the wider scale wins, then list over mask mode, then the lower number. With `both` this holds
    /// for each FIFO separately. The index is assumed to count from the first bank of the controller.
    pub fn accept(&self, frame: &Frame, both: bool) -> [Option<u8>; 2] {
        if self.fmr & FMR_FINIT != 0 {
            return [None; 2];
        }
        let mut next_index = [0; 2];
        let mut best = [None; 2];
        for bank in self.own() {
            let bit = |register: u32| register >> bank & 1 == 1;
            let (wide, list, fifo) = (bit(self.fs1r), bit(self.fm1r), usize::from(bit(self.ffa1r)));
            let (filters, found) = self.matches(bank, wide, list, frame);
            if let (true, Some(number)) = (bit(self.fa1r), found) {
                let rank = (!wide, !list, bank);
                if best[fifo].is_none_or(|(best, _)| rank < best) {
                    best[fifo] = Some((rank, next_index[fifo] + number));
                }
            }
            next_index[fifo] += filters;
        }
        let winner = best.iter().flatten().map(|&(rank, _)| rank).min();
        best.map(|best| {
            best.filter(|&(rank, _)| both || Some(rank) == winner).map(|(_, index)| index)
        })
    }

    /// The number of filters in the bank, and the first that matches.
    fn matches(&self, bank: usize, wide: bool, list: bool, frame: &Frame) -> (u8, Option<u8>) {
        let [first, second] = self.banks[bank];
        let halves = |word: u32| [word & 0xFFFF, word >> 16];
        let [a, b] = halves(first);
        let [c, d] = halves(second);
        let id = if wide { identifier_word(frame) } else { identifier_half(frame) };
        let masked = |(filter, mask): (u32, u32)| (filter ^ id) & mask == 0;
        let position = |mut filters: std::slice::Iter<'_, (u32, u32)>| {
            filters.position(|&filter| masked(filter))
        };
        // Bit 0 of a 32-bit filter has no meaning; all other bits of a list entry must agree.
        const ALL: u32 = !1;
        const HALF: u32 = 0xFFFF;
        let (filters, found) = match (wide, list) {
            (true, false) => (1, position([(first, second & ALL)].iter())),
            (true, true) => (2, position([(first, ALL), (second, ALL)].iter())),
            (false, false) => (2, position([(a, b), (c, d)].iter())),
            (false, true) => (4, position([(a, HALF), (b, HALF), (c, HALF), (d, HALF)].iter())),
        };
        (filters, found.map(|number| number as u8))
    }
}

fn place(offset: u32) -> (usize, usize) {
    let register = ((offset - BANK_REGISTERS) / 4) as usize;
    (register / 2, register % 2)
}
