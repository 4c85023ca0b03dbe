//! Offsets, bits, fields and reset values of the control and status registers (RM0090 32.9.2 and 32.9.5).

use crate::can::BitSegments;

pub const MCR: u32 = 0x000;
pub const MSR: u32 = 0x004;
pub const TSR: u32 = 0x008;
pub const RF0R: u32 = 0x00C;
pub const RF1R: u32 = 0x010;
pub const IER: u32 = 0x014;
pub const ESR: u32 = 0x018;
pub const BTR: u32 = 0x01C;
pub const TRANSMIT_MAILBOXES: u32 = 0x180;
pub const RECEIVE_MAILBOXES: u32 = 0x1B0;
pub const FILTERS: u32 = 0x200;

pub const MCR_RESET_VALUE: u32 = 0x0001_0002;
pub const MCR_INRQ: u32 = 1 << 0;
pub const MCR_SLEEP: u32 = 1 << 1;
pub const MCR_TXFP: u32 = 1 << 2;
pub const MCR_RFLM: u32 = 1 << 3;
pub const MCR_NART: u32 = 1 << 4;
pub const MCR_AWUM: u32 = 1 << 5;
pub const MCR_ABOM: u32 = 1 << 6;
pub const MCR_TTCM: u32 = 1 << 7;
pub const MCR_RESET: u32 = 1 << 15;
pub const MCR_WRITABLE: u32 = 0x0001_00FF;

pub const MSR_ERRI: u32 = 1 << 2;
pub const MSR_WKUI: u32 = 1 << 3;
pub const MSR_SLAKI: u32 = 1 << 4;

pub const IER_TMEIE: u32 = 1 << 0;
pub const IER_FIFO_0: u32 = 1;
pub const IER_FIFO_1: u32 = 4;
pub const IER_EWGIE: u32 = 1 << 8;
pub const IER_EPVIE: u32 = 1 << 9;
pub const IER_BOFIE: u32 = 1 << 10;
pub const IER_LECIE: u32 = 1 << 11;
pub const IER_ERRIE: u32 = 1 << 15;
pub const IER_WKUIE: u32 = 1 << 16;
pub const IER_SLKIE: u32 = 1 << 17;
pub const IER_WRITABLE: u32 = 0x0003_8F7F;

pub const ESR_EWGF: u32 = 1 << 0;
pub const ESR_EPVF: u32 = 1 << 1;
pub const ESR_BOFF: u32 = 1 << 2;
pub const ESR_LEC: u32 = 0b111 << 4;

/// The value of TEC in ESR during bus-off.
pub const BUS_OFF_TEC: u16 = 0xF8;

pub const TDTR_TGT: u32 = 1 << 8;

pub const BTR_RESET_VALUE: u32 = 0x0123_0000;
pub const BTR_WRITABLE: u32 = 0xC37F_03FF;

/// The mailbox, and the word in it, at a distance from the first mailbox's first register.
pub fn place(distance: u32) -> (usize, usize) {
    ((distance / 16) as usize, (distance % 16 / 4) as usize)
}

/// The bit segments of a BTR value (RM0090 32.9.2); each field is one less than its quantity.
pub fn bit_timing(btr: u32) -> BitSegments {
    let field = |shift: u32, width: u32| (btr >> shift & ((1 << width) - 1)) + 1;
    BitSegments {
        prescaler: field(0, 10) as u16,
        segment_1: field(16, 4) as u16,
        segment_2: field(20, 3) as u8,
        jump_width: field(24, 2) as u8,
    }
}
