//! Offsets, bits and reset values of the registers (RM0440 44.4).

use crate::can::BitSegments;

pub const CREL: u32 = 0x00;
pub const ENDN: u32 = 0x04;
pub const DBTP: u32 = 0x0C;
pub const TEST: u32 = 0x10;
pub const RWD: u32 = 0x14;
pub const CCCR: u32 = 0x18;
pub const NBTP: u32 = 0x1C;
pub const TSCC: u32 = 0x20;
pub const TSCV: u32 = 0x24;
pub const TOCC: u32 = 0x28;
pub const TOCV: u32 = 0x2C;
pub const ECR: u32 = 0x40;
pub const PSR: u32 = 0x44;
pub const TDCR: u32 = 0x48;
pub const IR: u32 = 0x50;
pub const IE: u32 = 0x54;
pub const ILS: u32 = 0x58;
pub const ILE: u32 = 0x5C;
pub const RXGFC: u32 = 0x80;
pub const XIDAM: u32 = 0x84;
pub const HPMS: u32 = 0x88;
pub const RXF0S: u32 = 0x90;
pub const RXF0A: u32 = 0x94;
pub const RXF1S: u32 = 0x98;
pub const RXF1A: u32 = 0x9C;
pub const TXBC: u32 = 0xC0;
pub const TXFQS: u32 = 0xC4;
pub const TXBRP: u32 = 0xC8;
pub const TXBAR: u32 = 0xCC;
pub const TXBCR: u32 = 0xD0;
pub const TXBTO: u32 = 0xD4;
pub const TXBCF: u32 = 0xD8;
pub const TXBTIE: u32 = 0xDC;
pub const TXBCIE: u32 = 0xE0;
pub const TXEFS: u32 = 0xE4;
pub const TXEFA: u32 = 0xE8;
pub const CKDIV: u32 = 0x100;
/// The message RAM follows, although it has an address range of its own.
pub const RAM: u32 = 0x400;

/// The registers that are stored as written, and their values after a reset.
pub const RESET_VALUES: [(u32, u32); 9] = [
    (CREL, 0x3214_1218),
    (ENDN, 0x8765_4321),
    (DBTP, 0x0000_0A33),
    (CCCR, CCCR_INIT),
    (NBTP, 0x0600_0A03),
    (TOCC, 0xFFFF_0000),
    (TOCV, 0x0000_FFFF),
    (XIDAM, 0x1FFF_FFFF),
    (TEST, 0),
];

pub const TEST_LBCK: u32 = 1 << 4;
/// The level of the receive pin.
pub const TEST_RX: u32 = 1 << 7;

pub const CCCR_INIT: u32 = 1 << 0;
pub const CCCR_CCE: u32 = 1 << 1;
pub const CCCR_ASM: u32 = 1 << 2;
pub const CCCR_CSR: u32 = 1 << 4;
pub const CCCR_MON: u32 = 1 << 5;
pub const CCCR_DAR: u32 = 1 << 6;
pub const CCCR_TEST: u32 = 1 << 7;
pub const CCCR_FDOE: u32 = 1 << 8;
/// All but INIT, CCE and the clock stop: they can be set only in configuration.
pub const CCCR_PROTECTED: u32 = 0xF3E4;

pub const PSR_EP: u32 = 1 << 5;
pub const PSR_EW: u32 = 1 << 6;
pub const PSR_BO: u32 = 1 << 7;
/// LEC and DLEC since the program read them last.
pub const NO_CHANGE: u32 = 7;
/// DLEC, which never changes without CAN FD.
pub const DLEC_NO_CHANGE: u32 = NO_CHANGE << 8;

pub const ECR_RP: u32 = 1 << 15;
pub const REC_SHIFT: u32 = 8;
pub const CEL_SHIFT: u32 = 16;

/// New message, full and lost, of FIFO 0 in IR; those of FIFO 1 are three bits higher.
pub const RFN: u32 = 1 << 0;
pub const RFF: u32 = 1 << 1;
pub const RFL: u32 = 1 << 2;
pub const IR_FIFO_1: usize = 3;
pub const IR_HPM: u32 = 1 << 6;
pub const IR_TC: u32 = 1 << 7;
pub const IR_TCF: u32 = 1 << 8;
pub const IR_TFE: u32 = 1 << 9;
pub const IR_TEFN: u32 = 1 << 10;
pub const IR_TEFF: u32 = 1 << 11;
pub const IR_TEFL: u32 = 1 << 12;
pub const IR_ELO: u32 = 1 << 16;
pub const IR_EP: u32 = 1 << 17;
pub const IR_EW: u32 = 1 << 18;
pub const IR_BO: u32 = 1 << 19;
pub const IR_PEA: u32 = 1 << 21;

/// The interrupts whose line each bit of ILS selects.
pub const ILS_GROUPS: [u32; 7] =
    [0x00_0007, 0x00_0038, 0x00_01C0, 0x00_1E00, 0x00_E000, 0x03_0000, 0xFC_0000];

pub const RXGFC_RRFE: u32 = 1 << 0;
pub const RXGFC_RRFS: u32 = 1 << 1;
pub const RXGFC_ANFE: u32 = 2;
pub const RXGFC_ANFS: u32 = 4;
/// Overwrite mode of FIFO 0; that of FIFO 1 is one bit lower.
pub const RXGFC_F0OM: u32 = 1 << 9;

pub const TXBC_TFQM: u32 = 1 << 24;
pub const TXFQS_TFQF: u32 = 1 << 21;

/// The bit segments of an NBTP value; each field is one less than its quantity.
pub fn bit_timing(nbtp: u32) -> BitSegments {
    let field = |shift: u32, width: u32| (nbtp >> shift & ((1 << width) - 1)) as u16 + 1;
    BitSegments {
        prescaler: field(16, 9),
        segment_1: field(8, 8),
        segment_2: field(0, 7) as u8,
        jump_width: field(25, 7) as u8,
    }
}

/// Whether a register can be written only in configuration, with INIT and CCE.
pub fn is_protected(offset: u32) -> bool {
    matches!(offset, DBTP | TEST | RWD | NBTP | TSCC | TOCC | TDCR | RXGFC | XIDAM | TXBC | CKDIV)
}
