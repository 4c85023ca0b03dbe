//! A Thumb-2 instruction as far as its time, its flow and its use of the stack matter (ARM DDI 0403, chapter A5).

/// An instruction of the image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Instruction {
    pub address: u32,
    /// In bytes: 2 or 4.
    pub length: u32,
    /// The most core cycles (ARM DDI 0439, 3.3), without the refill of the pipeline by a jump and without any waits.
    pub cycles: u64,
    pub memory: Memory,
    pub flow: Flow,
    pub stack: Stack,
    /// Whether it is in an IT block.
    pub is_conditional: bool,
    /// The register that it sets to a constant.
    pub constant: Option<(u32, u32)>,
    /// The register with the address of a load or store, and that of the offset.
    pub base: (u32, Option<u32>),
    /// A bit for each register that it may change, and perhaps others.
    pub may_change: u32,
}

/// The memory that an instruction accesses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Memory {
    None,
    /// The stack.
    Stack,
    /// A constant beside the code.
    Constant,
    /// Words at an address in a register.
    Other {
        words: u32,
        is_load: bool,
    },
    /// A barrier, which waits for the stores before it.
    Barrier,
}

/// Where the program continues.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Flow {
    Next,
    Jump(u32),
    /// To the target or to the next instruction.
    Branch(u32),
    Table(Vec<u32>),
    Call(u32),
    Return,
    /// `UDF` or `BKPT`: a fault.
    Fault,
    /// This analysis cannot follow it.
    Unknown(&'static str),
}

/// The effect on the stack pointer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stack {
    /// Bytes by which the stack grows; negative if it shrinks.
    Grows(i32),
    /// The new stack pointer is not known.
    Unknown,
}

/// The special uses of a system register or the interrupt mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mask {
    /// `MSR BASEPRI_MAX`: begins a critical section.
    Raise,
    /// `MSR BASEPRI`: ends it.
    Restore,
    /// `CPSID i`.
    Disable,
    /// `CPSIE i`, or `MSR PRIMASK`.
    Enable,
}

/// Cycles to refill the pipeline after a jump: P is 1 to 3.
pub const REFILL: u64 = 3;

impl Instruction {
    /// The address after it.
    pub const fn end(&self) -> u32 {
        self.address + self.length
    }

    /// Decodes an instruction; a table branch gets no targets.
    pub fn decode(address: u32, first: u16, second: Option<u16>, is_conditional: bool) -> Self {
        let mut instruction = Self {
            address,
            length: if second.is_some() { 4 } else { 2 },
            cycles: 1,
            memory: Memory::None,
            flow: Flow::Next,
            stack: Stack::Grows(0),
            is_conditional,
            base: base(first, second),
            constant: constant(first, second),
            may_change: may_change(first, second),
        };
        match second {
            None => instruction.narrow(first),
            Some(second) => instruction.wide(first, second),
        }
        instruction
    }

    fn target(&self, offset: i32) -> u32 {
        self.address.wrapping_add(4).wrapping_add_signed(offset)
    }

    fn access(&mut self, words: u32, is_load: bool) {
        self.cycles = 1 + u64::from(words);
        self.memory = Memory::Other { words, is_load };
    }

    fn narrow(&mut self, half: u16) {
        let bits = i32::from(half);
        let count = (half & 0xFF).count_ones();
        match half >> 12 {
            4 if half & 0xFC00 == 0x4400 => self.special(half),
            4 if half & 0xF800 == 0x4800 => {
                self.access(1, true);
                self.memory = Memory::Constant;
            }
            5 => self.access(1, half >> 9 & 7 >= 3),
            6..=8 => self.access(1, half & 0x800 != 0),
            9 => {
                self.access(1, half & 0x800 != 0);
                self.memory = Memory::Stack;
            }
            0xB => match half >> 8 & 0xF {
                0 => {
                    let bytes = (bits & 0x7F) * 4;
                    self.stack = Stack::Grows(if half & 0x80 == 0 { -bytes } else { bytes });
                }
                1 | 3 | 9 | 0xB => {
                    let offset = (bits >> 9 & 1) << 6 | (bits >> 3 & 0x1F) << 1;
                    self.flow = Flow::Branch(self.target(offset));
                }
                4 | 5 | 0xC | 0xD => {
                    let is_load = half & 0x800 != 0;
                    let count = count + u32::from(half >> 8 & 1);
                    self.access(count, is_load);
                    self.memory = Memory::Stack;
                    let bytes = 4 * count as i32;
                    self.stack = Stack::Grows(if is_load { -bytes } else { bytes });
                    if half & 0xFF00 == 0xBD00 {
                        self.flow = Flow::Return;
                    }
                }
                0xE => self.flow = Flow::Fault,
                _ => {}
            },
            0xC => self.access(count, half & 0x800 != 0),
            0xD => match half >> 8 & 0xF {
                0xE => self.flow = Flow::Fault,
                0xF => self.flow = Flow::Unknown("a supervisor call"),
                _ => self.flow = Flow::Branch(self.target(i32::from(half as u8 as i8) * 2)),
            },
            0xE => self.flow = Flow::Jump(self.target(bits << 21 >> 20)),
            _ => {}
        }
    }

    /// `ADD`, `CMP`, `MOV`, `BX` and `BLX` with any register.
    fn special(&mut self, half: u16) {
        const SP: u16 = 13;
        const PC: u16 = 15;
        let operation = half >> 8 & 3;
        let destination = half >> 4 & 8 | half & 7;
        match (operation, destination) {
            (3, _) if half == 0x4770 => self.flow = Flow::Return,
            (3, _) if half & 0x80 == 0 => self.flow = Flow::Unknown("a computed jump"),
            (3, _) => self.flow = Flow::Unknown("a call by a pointer"),
            (0 | 2, PC) => self.flow = Flow::Unknown("a computed jump"),
            (0 | 2, SP) => self.stack = Stack::Unknown,
            _ => {}
        }
    }

    fn wide(&mut self, first: u16, second: u16) {
        const SP: u16 = 13;
        let register = first & 0xF;
        let destination = second >> 8 & 0xF;
        match first >> 9 & 0xF {
            // 1110100: several registers, two registers, exclusive access and table branches.
            0b0100 if first & 0x40 == 0 => self.several(first, second),
            0b0100 if first & 0xFFF0 == 0xE8D0 && second & 0xFFE0 == 0xF000 => {
                self.cycles = 2;
                self.memory = Memory::Constant;
                self.flow = Flow::Table(Vec::new());
            }
            0b0100 => {
                let is_pair = first & 0x120 != 0;
                self.access(if is_pair { 2 } else { 1 }, first & 0x10 != 0);
                self.base(register);
                if is_pair && register == SP {
                    let (before, up, back) =
                        (first & 0x100 != 0, first & 0x80 != 0, first & 0x20 != 0);
                    self.write_back(back || !before, up, i32::from(second & 0xFF) * 4);
                }
            }
            // 1110101: with a shifted register. 1111000 and 1111001: with a constant.
            0b0101 if destination == SP => self.stack = Stack::Unknown,
            0b1000..=0b1011 if second & 0x8000 != 0 => self.branch_or_system(first, second),
            0b1000..=0b1011 if destination == SP => self.move_stack(first, second),
            // 1111100: one register.
            0b1100 => {
                self.access(1, first & 0x10 != 0);
                self.base(register);
                if register == SP && first & 0x80 == 0 && second & 0x800 != 0 {
                    let (before, up, back) =
                        (second & 0x400 != 0, second & 0x200 != 0, second & 0x100 != 0);
                    self.write_back(back || !before, up, i32::from(second & 0xFF));
                }
                if first & 0x70 == 0x50 && second >> 12 == 15 {
                    let is_pop = (first, second) == (0xF85D, 0xFB04);
                    self.flow =
                        if is_pop { Flow::Return } else { Flow::Unknown("a computed jump") };
                }
            }
            // 1111101: registers, multiplication and division.
            0b1101 if first & 0xFFD0 == 0xFB90 => self.cycles = 12,
            0b1101 if first & 0xFF00 == 0xFB00 => self.cycles = 2,
            0b0110 | 0b0111 | 0b1110 | 0b1111 => {
                self.flow = Flow::Unknown("an instruction of the floating-point unit");
            }
            _ => {}
        }
    }

    fn base(&mut self, register: u16) {
        match register {
            13 => self.memory = Memory::Stack,
            15 => self.memory = Memory::Constant,
            _ => {}
        }
    }

    fn write_back(&mut self, does: bool, up: bool, bytes: i32) {
        if does {
            self.stack = Stack::Grows(if up { -bytes } else { bytes });
        }
    }

    /// `LDM` and `STM`.
    fn several(&mut self, first: u16, second: u16) {
        let is_load = first & 0x10 != 0;
        let count = second.count_ones();
        self.access(count, is_load);
        self.base(first & 0xF);
        if first & 0x2F == 0x2D {
            let bytes = 4 * count as i32;
            self.stack = Stack::Grows(if is_load { -bytes } else { bytes });
        }
        if is_load && second & 0x8000 != 0 {
            self.flow =
                if first == 0xE8BD { Flow::Return } else { Flow::Unknown("a computed jump") };
        }
    }

    fn branch_or_system(&mut self, first: u16, second: u16) {
        let (high, low) = (i32::from(first), i32::from(second));
        let sign = high >> 10 & 1;
        let [j1, j2] = [low >> 13 & 1, low >> 11 & 1];
        if second & 0x5000 == 0 {
            if first >> 6 & 0xE != 0xE {
                let offset =
                    sign << 20 | j2 << 19 | j1 << 18 | (high & 0x3F) << 12 | (low & 0x7FF) << 1;
                self.flow = Flow::Branch(self.target(offset << 11 >> 11));
            } else if first & 0xFFF0 == 0xF3B0 {
                // ISB refills the pipeline, DSB and DMB wait for stores.
                self.cycles = 1 + REFILL;
                self.memory = Memory::Barrier;
            } else if first & 0xFFF0 == 0xF7F0 {
                self.flow = Flow::Fault;
            } else {
                self.cycles = 2;
            }
            return;
        }
        let [i1, i2] = [j1, j2].map(|bit| bit ^ sign ^ 1);
        let offset = sign << 24 | i1 << 23 | i2 << 22 | (high & 0x3FF) << 12 | (low & 0x7FF) << 1;
        let target = self.target(offset << 7 >> 7);
        self.flow = match second & 0x5000 {
            0x1000 => Flow::Jump(target),
            0x5000 => Flow::Call(target),
            _ => Flow::Unknown("a switch of the instruction set"),
        };
    }

    /// `ADD` and `SUB` of a constant, with the stack pointer as destination.
    fn move_stack(&mut self, first: u16, second: u16) {
        let constant = wide_constant(first, second);
        let grows = match (first & !0x400, expand(constant)) {
            (0xF10D, Some(bytes)) => -(bytes as i32),
            (0xF1AD, Some(bytes)) => bytes as i32,
            (0xF20D, _) => -(constant as i32),
            (0xF2AD, _) => constant as i32,
            // A comparison with a destination of 13 does not exist, so this is something else.
            _ => {
                self.stack = Stack::Unknown;
                return;
            }
        };
        self.stack = Stack::Grows(grows);
    }
}

/// The registers of an address, if the instruction has one.
fn base(first: u16, second: Option<u16>) -> (u32, Option<u32>) {
    let bits = u32::from(first);
    match second {
        None if first >> 12 == 5 => (bits >> 3 & 7, Some(bits >> 6 & 7)),
        None if first >> 12 == 0xC => (bits >> 8 & 7, None),
        None => (bits >> 3 & 7, None),
        Some(second) if first & 0xFE80 == 0xF800 && second & 0xFC0 == 0 => {
            (bits & 0xF, Some(u32::from(second & 0xF)))
        }
        Some(_) => (bits & 0xF, None),
    }
}

/// `MOV` of a constant.
fn constant(first: u16, second: Option<u16>) -> Option<(u32, u32)> {
    match (first, second) {
        (0x2000..=0x27FF, None) => Some((u32::from(first >> 8 & 7), u32::from(first & 0xFF))),
        // MOVW, and MOV of a constant of which only a byte is rotated into place.
        (_, Some(second)) if first & 0xFBF0 == 0xF240 && second & 0x8000 == 0 => {
            let value = u32::from(first & 0xF) << 12 | wide_constant(first, second);
            Some((u32::from(second >> 8), value))
        }
        (_, Some(second)) if first & 0xFBEF == 0xF04F && second & 0x8000 == 0 => {
            expand(wide_constant(first, second)).map(|value| (u32::from(second >> 8 & 0xF), value))
        }
        _ => None,
    }
    .map(|(register, value)| (register & 0xF, value))
}

const fn wide_constant(first: u16, second: u16) -> u32 {
    (first as u32 >> 10 & 1) << 11 | (second as u32 >> 12 & 7) << 8 | second as u32 & 0xFF
}

/// A modified immediate constant, but for repeated bytes (ARM DDI 0403, A5.3.2).
const fn expand(constant: u32) -> Option<u32> {
    match constant >> 8 {
        0 => Some(constant),
        1..=3 => None,
        _ => Some((0x80 | constant & 0x7F).rotate_right(constant >> 7)),
    }
}

/// All fields of an instruction that may name a destination.
fn may_change(first: u16, second: Option<u16>) -> u32 {
    let bit = |register: u16| 1_u32 << (register & 0xF);
    match second {
        None => {
            let list = if first >> 13 == 6 || first >> 12 == 0xB { first & 0xFF } else { 0 };
            bit(first & 7) | bit(first & 7 | first >> 4 & 8) | bit(first >> 8 & 7) | u32::from(list)
        }
        Some(second) => {
            let list = if first & 0xFE40 == 0xE800 { second } else { 0 };
            bit(first) | bit(second >> 8) | bit(second >> 12) | bit(second) | u32::from(list)
        }
    }
}

/// The effect of an instruction on the interrupt masks.
pub fn mask(first: u16, second: Option<u16>) -> Option<Mask> {
    const PRIMASK: u16 = 0x8810;
    const BASEPRI: u16 = 0x8811;
    const BASEPRI_MAX: u16 = 0x8812;
    match (first, second) {
        (0xB672, None) => Some(Mask::Disable),
        (0xB662, None) => Some(Mask::Enable),
        (0xF380..=0xF38F, Some(BASEPRI_MAX)) => Some(Mask::Raise),
        (0xF380..=0xF38F, Some(BASEPRI)) => Some(Mask::Restore),
        (0xF380..=0xF38F, Some(PRIMASK)) => Some(Mask::Enable),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AT: u32 = 0x0800_C000;

    fn decode(first: u16, second: Option<u16>) -> Instruction {
        Instruction::decode(AT, first, second, false)
    }

    #[test]
    fn jumps_and_calls_have_their_targets() {
        for (first, second, flow) in [
            (0xE7FE, None, Flow::Jump(AT)),
            (0xD0FE, None, Flow::Branch(AT)),
            (0xB910, None, Flow::Branch(AT + 8)),
            (0xF000, Some(0xF800), Flow::Call(AT + 4)),
            (0xF7FF, Some(0xFFFE), Flow::Call(AT)),
            (0xF7FF, Some(0xBFFE), Flow::Jump(AT)),
            (0xF43F, Some(0xAFFE), Flow::Branch(AT)),
            (0x4770, None, Flow::Return),
            (0xBD10, None, Flow::Return),
            (0xE8BD, Some(0x87F0), Flow::Return),
            (0xF85D, Some(0xFB04), Flow::Return),
            (0xDE00, None, Flow::Fault),
            (0xF8D0, Some(0xE000), Flow::Next),
        ] {
            assert_eq!(decode(first, second).flow, flow, "{first:04X} {second:04X?}");
        }
    }

    #[test]
    fn the_stack_moves_by_pushes_sums_and_write_back() {
        for (first, second, bytes) in [
            (0xB5F0, None, 20),
            (0xBC70, None, -12),
            (0xB082, None, 8),
            (0xB002, None, -8),
            (0xE92D, Some(0x41F0), 24),
            (0xE8BD, Some(0x81F0), -24),
            (0xF84D, Some(0xBD04), 4),
            (0xF85D, Some(0xBB04), -4),
            (0xF2AD, Some(0x7D04), 0x704),
            (0xF5AD, Some(0x6D80), 1024),
            (0xE96D, Some(0x0102), 8),
            (0x9000, None, 0),
        ] {
            assert_eq!(
                decode(first, second).stack,
                Stack::Grows(bytes),
                "{first:04X} {second:04X?}"
            );
        }
    }

    #[test]
    fn several_words_take_a_cycle_each() {
        for (first, second, cycles) in [
            (0x6808, None, 2),
            (0xC107, None, 4),
            (0xE9D0, Some(0x1200), 3),
            (0xFBB0, Some(0xF0F1), 12),
        ] {
            assert_eq!(decode(first, second).cycles, cycles, "{first:04X}");
        }
    }

    #[test]
    fn constants_of_all_forms_are_known() {
        assert_eq!(decode(0x2220, None).constant, Some((2, 0x20)));
        assert_eq!(decode(0xF44F, Some(0x72A4)).constant, Some((2, 0x148)));
        assert_eq!(decode(0xF240, Some(0x22B3)).constant, Some((2, 0x2B3)));
        assert_eq!(decode(0x4632, None).constant, None);
        assert_eq!(decode(0x4632, None).may_change >> 2 & 1, 1);
    }
}
