//! PWR (RM0090 chapter 5): the voltage scale and over-drive bits that clock set-up waits for.

use super::Part;

const CR: u32 = 0x00;
const CSR: u32 = 0x04;
const ODEN: u32 = 1 << 16;
const ODSWEN: u32 = 1 << 17;
const VOSRDY: u32 = 1 << 14;

/// The power controller: voltages settle at once.
#[derive(Debug)]
pub struct Pwr {
    part: Part,
    cr: u32,
    csr: u32,
}

impl Pwr {
    /// After a reset.
    pub fn new(part: Part) -> Self {
        let cr = if part.has_overdrive() { 0xC000 } else { 0x4000 };
        Self { part, cr, csr: 0 }
    }

    /// A register's value, or `None` where there is none.
    pub fn read(&self, offset: u32) -> Option<u32> {
        match offset {
            CR => Some(self.cr),
            CSR => Some(self.csr | VOSRDY | self.cr & (ODEN | ODSWEN)),
            _ => None,
        }
    }

    /// Writes a register; false where there is none.
    pub fn write(&mut self, offset: u32, value: u32) -> bool {
        match offset {
            CR => self.cr = value & if self.part.has_overdrive() { 0x000F_EFF3 } else { 0x43F3 },
            CSR => self.csr = value & (1 << 8 | 1 << 9),
            _ => return false,
        }
        true
    }
}
