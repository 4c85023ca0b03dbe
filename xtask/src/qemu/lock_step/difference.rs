//! A difference between the cores, for a reader.

use std::fmt;

use emulator::{
    engine::{Engine, Registers, Transfer},
    image::Image,
};

use super::pair::PC;

const NAMES: [&str; 17] = [
    "r0", "r1", "r2", "r3", "r4", "r5", "r6", "r7", "r8", "r9", "r10", "r11", "r12", "sp", "lr",
    "pc", "xpsr",
];

/// Registers that differ.
pub struct Difference<'a> {
    /// The last instruction that was executed.
    pub instruction: u64,
    /// How many instructions, an exception entry apart, lie between `before` and now.
    pub executed: usize,
    pub before: &'a Registers,
    pub ours: &'a Registers,
    pub theirs: &'a Registers,
    pub image: &'a Image,
    pub core: &'a dyn Engine,
}

impl fmt::Display for Difference<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { instruction, executed, .. } = self;
        let pc = self.before.r[PC];
        let from = place(self.image, pc);
        write!(f, "the first difference is ")?;
        match executed {
            0 => write!(f, "after an exception entry or reset before {from}, ")?,
            1 => write!(f, "after {from}: {}, ", Opcode(self.core, pc))?,
            _ => write!(f, "within {executed} instructions from {from} on, ")?,
        }
        writeln!(f, "at instruction {instruction}")?;
        if *executed > 1 {
            writeln!(f, "To see which it is, run it without --stride.")?;
        }
        write!(f, "{:>10} {:>8} {:>8} {:>8}", "", "before", "emulator", "QEMU")?;
        for (number, name) in NAMES.iter().enumerate() {
            let value = |registers: &Registers| *registers.r.get(number).unwrap_or(&registers.xpsr);
            let (before, ours, theirs) = (value(self.before), value(self.ours), value(self.theirs));
            let mark = if ours == theirs { "" } else { "  <- differs" };
            write!(f, "\n{name:>10} {before:08x} {ours:08x} {theirs:08x}{mark}")?;
        }
        Ok(())
    }
}

/// One or two halfwords, as a disassembler shows them.
struct Opcode<'a>(&'a dyn Engine, u32);

impl fmt::Display for Opcode<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(core, pc) = *self;
        let first = halfword(core, pc);
        write!(f, "{first:04x}")?;
        // ARM DDI 0403, A5.1: how a 32-bit instruction begins.
        if first >> 11 >= 0b11101 {
            write!(f, " {:04x}", halfword(core, pc + 2))?;
        }
        Ok(())
    }
}

/// `0800c1f2 (CAN1_RX0+12)`.
pub fn place(image: &Image, pc: u32) -> String {
    match image.symbol_at(pc) {
        Some((name, 0)) => format!("{pc:08x} ({name})"),
        Some((name, offset)) => format!("{pc:08x} ({name}+{offset})"),
        None => format!("{pc:08x}"),
    }
}

/// What is at an address of RAM or flash.
pub fn halfword(core: &dyn Engine, address: u32) -> u16 {
    let mut bytes = [0; 2];
    core.read_memory(address, &mut bytes);
    u16::from_le_bytes(bytes)
}

/// An access to a peripheral.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Access {
    /// Bytes, and [`Self::STORE`].
    pub kind: u32,
    pub address: u32,
    pub value: u32,
}

impl Access {
    pub const STORE: u32 = 0x100;
}

impl From<&Transfer> for Access {
    fn from(transfer: &Transfer) -> Self {
        let store = if transfer.is_store { Self::STORE } else { 0 };
        let kind = store | transfer.access.width.bytes();
        Self { kind, address: transfer.access.address, value: transfer.value }
    }
}

/// `load of 4 bytes at 40023800: 83`.
impl fmt::Display for Access {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, address, value } = self;
        let verb = if kind & Self::STORE == 0 { "load" } else { "store" };
        write!(f, "{verb} of {} bytes at {address:08x}: {value:x}", kind & !Self::STORE)
    }
}

/// Accesses in a row.
pub fn list(accesses: &[Access]) -> String {
    let text: Vec<String> = accesses.iter().map(Access::to_string).collect();
    if text.is_empty() { "none".to_owned() } else { text.join(", ") }
}
