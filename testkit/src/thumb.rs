//! Thumb-2 instructions as far as the flow of a program and its stack matter (ARM DDI 0403, chapters A5 to A7).

use std::collections::BTreeMap;

/// An instruction in the flash.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Instruction {
    pub address: u32,
    /// In bytes: 2 or 4.
    pub length: u32,
    pub flow: Flow,
    /// The bytes by which it lets the stack grow, negative if it shrinks; `None` if it sets the stack pointer.
    pub stack: Option<i32>,
    /// Whether it is in an IT block.
    pub is_conditional: bool,
    /// The condition, if it is the first of an IT block, or one whose flags are newer than those of the one before.
    pub condition: Option<&'static str>,
}

/// Where the program continues after an instruction.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Flow {
    Next,
    /// `B`.
    Jump(u32),
    /// `B<cond>`, `CBZ` or `CBNZ`.
    Branch {
        mnemonic: &'static str,
        target: u32,
    },
    /// `BL`.
    Call(u32),
    /// `TBB` or `TBH`: each target once, with the indices of its entries.
    Table(BTreeMap<u32, Vec<usize>>),
    /// A jump or call to an address in a register or in memory.
    Computed,
    Return,
    /// `UDF` or `BKPT`: a fault.
    Fault,
}

/// Code in the flash, without the constants between the functions.
pub struct Code<'a> {
    /// The address of the first byte.
    pub base: u32,
    pub bytes: &'a [u8],
    /// The constants that follow, in which the entries of a table branch are.
    pub data: &'a [u8],
}

impl Instruction {
    /// The address after it.
    pub const fn end(&self) -> u32 {
        self.address + self.length
    }
}

/// The instructions of the code.
pub fn decode(code: &Code) -> Vec<Instruction> {
    let half = |at: usize| {
        let bytes = code.bytes.get(at..at + 2)?;
        Some(u16::from_le_bytes([bytes[0], bytes[1]]))
    };
    let mut instructions = Vec::new();
    let mut block = ItBlock::default();
    let mut at = 0;
    while let Some(first) = half(at) {
        let address = code.base + at as u32;
        let second = if first >> 11 >= 0b11101 { half(at + 2) } else { None };
        let (flow, stack) = match second {
            None => (narrow_flow(address, first), narrow_stack(first)),
            Some(second) => (wide_flow(address, first, second, code), wide_stack(first, second)),
        };
        let length = if second.is_some() { 4 } else { 2 };
        let (is_conditional, condition) = (block.left > 0, block.condition());
        instructions.push(Instruction { address, length, flow, stack, is_conditional, condition });
        block.advance(first, second);
        at += length as usize;
    }
    instructions
}

const CONDITIONS: [&str; 15] =
    ["eq", "ne", "hs", "lo", "mi", "pl", "vs", "vc", "hi", "ls", "ge", "lt", "gt", "le", "al"];
const B: [&str; 14] = [
    "beq", "bne", "bhs", "blo", "bmi", "bpl", "bvs", "bvc", "bhi", "bls", "bge", "blt", "bgt",
    "ble",
];

/// The IT block around the next instruction.
#[derive(Default)]
struct ItBlock {
    /// Instructions left.
    left: u32,
    condition: u16,
    /// Whether the flags are newer than those that the instruction before was judged by.
    is_new: bool,
}

impl ItBlock {
    /// The first condition of the block, if the next instruction decides by new flags.
    fn condition(&self) -> Option<&'static str> {
        (self.left > 0 && self.is_new).then(|| CONDITIONS[usize::from(self.condition)])
    }

    /// Takes over an instruction.
    fn advance(&mut self, first: u16, second: Option<u16>) {
        if self.left > 0 {
            self.left -= 1;
            self.is_new = sets_flags(first, second);
        } else if first & 0xFF00 == 0xBF00 && first & 0xF != 0 {
            *self = Self {
                left: 4 - (first & 0xF).trailing_zeros(),
                condition: (first >> 4 & 0xF).min(14),
                is_new: true,
            };
        }
    }
}

/// Whether an instruction in an IT block sets the flags; narrow arithmetic does not.
fn sets_flags(first: u16, second: Option<u16>) -> bool {
    match second {
        None => {
            let is_compare = first & 0xF800 == 0x2800 || first & 0xFF00 == 0x4500;
            is_compare || matches!(first & 0xFFC0, 0x4200 | 0x4280 | 0x42C0)
        }
        Some(second) => {
            let is_arithmetic =
                first & 0xFE00 == 0xEA00 || first & 0xFA00 == 0xF000 && second >> 15 == 0;
            is_arithmetic && first & 0x10 != 0
        }
    }
}

const fn target(address: u32, offset: i32) -> u32 {
    address.wrapping_add(4).wrapping_add_signed(offset)
}

fn narrow_flow(address: u32, half: u16) -> Flow {
    let bits = i32::from(half);
    let condition = usize::from(half >> 8 & 0xF);
    match half {
        0xD000..=0xDDFF => {
            let offset = i32::from(half as u8 as i8) * 2;
            Flow::Branch { mnemonic: B[condition], target: target(address, offset) }
        }
        _ if half & 0xF500 == 0xB100 => {
            let mnemonic = if half >> 11 & 1 == 1 { "cbnz" } else { "cbz" };
            let offset = (bits >> 9 & 1) << 6 | (bits >> 3 & 0x1F) << 1;
            Flow::Branch { mnemonic, target: target(address, offset) }
        }
        0xE000..=0xE7FF => Flow::Jump(target(address, bits << 21 >> 20)),
        // BX LR and POP with PC.
        0x4770 | 0xBD00..=0xBDFF => Flow::Return,
        0xBE00..=0xBEFF | 0xDE00..=0xDEFF => Flow::Fault,
        // BX and BLX, and MOV and ADD to PC.
        _ if matches!(half & 0xFF87, 0x4700 | 0x4780 | 0x4687 | 0x4487) => Flow::Computed,
        _ => Flow::Next,
    }
}

fn wide_flow(address: u32, first: u16, second: u16, code: &Code) -> Flow {
    let (high, low) = (i32::from(first), i32::from(second));
    let sign = high >> 10 & 1;
    let [j1, j2] = [low >> 13 & 1, low >> 11 & 1];
    let condition = usize::from(first >> 6 & 0xF);
    match (first & 0xF800, second & 0xD000) {
        (0xF000, 0x8000) if condition < 14 => {
            let offset =
                sign << 20 | j2 << 19 | j1 << 18 | (high & 0x3F) << 12 | (low & 0x7FF) << 1;
            let target = target(address, offset << 11 >> 11);
            return Flow::Branch { mnemonic: B[condition], target };
        }
        (0xF000, 0x8000) if first & 0xFFF0 == 0xF7F0 => return Flow::Fault,
        (0xF000, 0x9000 | 0xD000) => {
            let [i1, i2] = [j1, j2].map(|bit| bit ^ sign ^ 1);
            let offset =
                sign << 24 | i1 << 23 | i2 << 22 | (high & 0x3FF) << 12 | (low & 0x7FF) << 1;
            let target = target(address, offset << 7 >> 7);
            return if second & 0x4000 == 0 { Flow::Jump(target) } else { Flow::Call(target) };
        }
        _ => {}
    }
    let is_multiple_load = first & 0xFE50 == 0xE810 && second & 0x8000 != 0;
    match first {
        _ if first & 0xFFF0 == 0xE8D0 && second & 0xFFE0 == 0xF000 => {
            Flow::Table(table(address + 4, second & 0x10 != 0, code.data))
        }
        // LDMIA SP! and LDR PC, [SP], #4 are POP.
        0xE8BD if is_multiple_load => Flow::Return,
        0xF85D if second == 0xFB04 => Flow::Return,
        _ if is_multiple_load || first & 0xFF70 == 0xF850 && second >> 12 == 15 => Flow::Computed,
        _ => Flow::Next,
    }
}

fn narrow_stack(half: u16) -> Option<i32> {
    let bits = i32::from(half);
    let listed = 4 * (half & 0x1FF).count_ones() as i32;
    Some(match half {
        0xB000..=0xB07F => -(bits & 0x7F) * 4,
        0xB080..=0xB0FF => (bits & 0x7F) * 4,
        0xB400..=0xB5FF => listed,
        0xBC00..=0xBDFF => -listed,
        // ADD and MOV with SP as destination.
        _ if matches!(half & 0xFF87, 0x4485 | 0x4685) => return None,
        _ => 0,
    })
}

fn wide_stack(first: u16, second: u16) -> Option<i32> {
    const SP: u16 = 13;
    let down = |is_up: bool, bytes: i32| if is_up { -bytes } else { bytes };
    let byte = i32::from(second & 0xFF);
    let is_to_sp = second >> 8 & 0xF == SP;
    Some(match first {
        // LDMIA SP! and STMDB SP!.
        0xE8BD | 0xE92D => down(first == 0xE8BD, 4 * second.count_ones() as i32),
        // LDRD and STRD with write-back.
        _ if first & 0xFE6F == 0xE86D => down(first & 0x80 != 0, 4 * byte),
        // VPUSH and VPOP.
        0xED2D | 0xED6D => 4 * byte,
        0xECBD | 0xECFD => -4 * byte,
        // STMIA SP! and LDMDB SP!, and LDR to SP.
        0xE8AD | 0xE93D => return None,
        _ if first & 0xFF70 == 0xF850 && second >> 12 == SP => return None,
        // LDR and STR with write-back.
        _ if first & 0xFE8F == 0xF80D && second & 0x900 == 0x900 => down(second & 0x200 != 0, byte),
        // ADD and SUB of a constant.
        _ if matches!(first & 0xFBEF, 0xF10D | 0xF1AD) && is_to_sp && second & 0x8000 == 0 => {
            down(first & 0xA0 == 0, expand(first, second)?)
        }
        _ if matches!(first & 0xFBFF, 0xF20D | 0xF2AD) && is_to_sp && second & 0x8000 == 0 => {
            down(first & 0xA0 == 0, constant(first, second))
        }
        // Any other arithmetic with SP as destination; comparisons have 15 there.
        _ if (first & 0xFE00 == 0xEA00 || first & 0xF800 == 0xF000 && second & 0x8000 == 0)
            && is_to_sp =>
        {
            return None;
        }
        _ => 0,
    })
}

fn constant(first: u16, second: u16) -> i32 {
    let [first, second] = [first, second].map(i32::from);
    (first >> 10 & 1) << 11 | (second >> 12 & 7) << 8 | second & 0xFF
}

/// A modified immediate constant, but for repeated bytes (ARM DDI 0403, A5.3.2).
fn expand(first: u16, second: u16) -> Option<i32> {
    let constant = constant(first, second) as u32;
    match constant >> 8 {
        0 => Some(constant as i32),
        1..=3 => None,
        _ => Some((0x80 | constant & 0x7F).rotate_right(constant >> 7) as i32),
    }
}

/// The targets of the table at `base`, without the byte that pads it.
fn table(base: u32, is_wide: bool, data: &[u8]) -> BTreeMap<u32, Vec<usize>> {
    let entries: Vec<u32> = if is_wide {
        data.as_chunks().0.iter().map(|entry| u16::from_le_bytes(*entry).into()).collect()
    } else {
        data.iter().map(|entry| u32::from(*entry)).collect()
    };
    let mut targets: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
    for (index, entry) in entries.into_iter().enumerate() {
        targets.entry(base + 2 * entry).or_default().push(index);
    }
    targets.retain(|target, _| *target >= base + data.len() as u32);
    targets
}

#[cfg(test)]
mod tests {
    use super::*;

    const BASE: u32 = 0x0800_C000;

    fn instructions_with(halves: &[u16], data: &[u8]) -> Vec<Instruction> {
        let bytes: Vec<u8> = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
        decode(&Code { base: BASE, bytes: &bytes, data })
    }

    fn instructions(halves: &[u16]) -> Vec<Instruction> {
        instructions_with(halves, &[])
    }

    /// The flow of the only instruction, with its length.
    fn flow(halves: &[u16]) -> Flow {
        let [instruction] = &instructions(halves)[..] else { panic!("{halves:04X?}") };
        assert_eq!(instruction.length, 2 * halves.len() as u32);
        instruction.flow.clone()
    }

    fn branch(mnemonic: &'static str, target: u32) -> Flow {
        Flow::Branch { mnemonic, target }
    }

    /// The addresses of the instructions that decide by new flags in IT blocks, from the base on.
    fn conditions(halves: &[u16]) -> Vec<(u32, &'static str)> {
        let found = instructions(halves);
        found.iter().filter_map(|at| Some((at.address - BASE, at.condition?))).collect()
    }

    #[test]
    fn a_narrow_branch_has_each_condition_and_a_signed_offset() {
        for (condition, mnemonic) in (0..).zip(B) {
            for (offset, target) in [(0, BASE + 4), (0x7F, BASE + 4 + 254), (0x80, BASE + 4 - 256)]
            {
                let found = flow(&[0xD000 | condition << 8 | offset]);
                assert_eq!(found, branch(mnemonic, target));
            }
        }
    }

    #[test]
    fn a_wide_branch_has_each_condition_and_a_signed_offset() {
        for (condition, mnemonic) in (0..).zip(B) {
            for (first, second, target) in [
                (0xF000, 0x8000, BASE + 4),
                (0xF000, 0x87FF, BASE + 4 + 0xFFE),
                (0xF001, 0x8001, BASE + 4 + 0x1002),
                (0xF000, 0xA000, BASE + 4 + (1 << 18)),
                (0xF000, 0x8800, BASE + 4 + (1 << 19)),
                (0xF43F, 0xAFFE, BASE),
                (0xF400, 0x8000, BASE + 4 - (1 << 20)),
            ] {
                let found = flow(&[first | condition << 6, second]);
                assert_eq!(found, branch(mnemonic, target));
            }
        }
    }

    #[test]
    fn compare_and_branch_goes_forward_only() {
        for (half, mnemonic, target) in [
            (0xB100, "cbz", BASE + 4),
            (0xB900, "cbnz", BASE + 4),
            (0xB10F, "cbz", BASE + 6),
            (0xBBFF, "cbnz", BASE + 4 + 126),
        ] {
            assert_eq!(flow(&[half]), branch(mnemonic, target));
        }
    }

    #[test]
    fn jumps_calls_returns_and_faults_are_told_apart() {
        for (halves, expected) in [
            (&[0xE7FE][..], Flow::Jump(BASE)),
            (&[0xF7FF, 0xBFFE], Flow::Jump(BASE)),
            (&[0xF000, 0xF800], Flow::Call(BASE + 4)),
            (&[0xF7FF, 0xFFFE], Flow::Call(BASE)),
            (&[0x4770], Flow::Return),
            (&[0xBD10], Flow::Return),
            (&[0xE8BD, 0x87F0], Flow::Return),
            (&[0xF85D, 0xFB04], Flow::Return),
            (&[0xDE00], Flow::Fault),
            // BX R3, BLX R3, MOV PC, R3, ADD PC, R3, and two loads of PC.
            (&[0x4718], Flow::Computed),
            (&[0x4798], Flow::Computed),
            (&[0x469F], Flow::Computed),
            (&[0x449F], Flow::Computed),
            (&[0xF853, 0xF021], Flow::Computed),
            (&[0xE893, 0x8010], Flow::Computed),
            // SXTH, PUSH, REV, MOV R8, POP of R14, LDM, MSR, DSB, LDR of R14.
            (&[0xB200], Flow::Next),
            (&[0xB500], Flow::Next),
            (&[0xBA00], Flow::Next),
            (&[0x4698], Flow::Next),
            (&[0xE8BD, 0x4010], Flow::Next),
            (&[0xF380, 0x8800], Flow::Next),
            (&[0xF3BF, 0x8F4F], Flow::Next),
            (&[0xF8D3, 0xE000], Flow::Next),
        ] {
            assert_eq!(flow(halves), expected, "{halves:04X?}");
        }
    }

    #[test]
    fn the_stack_moves_by_pushes_sums_and_write_back() {
        for (halves, bytes) in [
            (&[0xB5F0][..], Some(20)),
            (&[0xBD10], Some(-8)),
            (&[0xB082], Some(8)),
            (&[0xB002], Some(-8)),
            // PUSH.W, POP.W, STR and STRD with write-back, LDR and LDRD behind.
            (&[0xE92D, 0x4FF0], Some(36)),
            (&[0xE8BD, 0x8FF0], Some(-36)),
            (&[0xF84D, 0x8D04], Some(4)),
            (&[0xF85D, 0xFB04], Some(-4)),
            (&[0xE96D, 0x2302], Some(8)),
            (&[0xE8FD, 0x2302], Some(-8)),
            // VPUSH and VPOP of D8 and D9.
            (&[0xED2D, 0x8B04], Some(16)),
            (&[0xECBD, 0x8B04], Some(-16)),
            // SUB.W and ADD.W of 0x100, SUBW of 0x404.
            (&[0xF5AD, 0x7D80], Some(0x100)),
            (&[0xF50D, 0x7D80], Some(-0x100)),
            (&[0xF2AD, 0x4D04], Some(0x404)),
            // STR and STRD without write-back, CMP.W with SP.
            (&[0xF8CD, 0x0004], Some(0)),
            (&[0xE9CD, 0x2302], Some(0)),
            (&[0xF1BD, 0x0F01], Some(0)),
            // MOV and ADD to SP, narrow and wide, a load of SP, STMIA SP!.
            (&[0x46BD], None),
            (&[0x449D], None),
            (&[0xEA4F, 0x0D07], None),
            (&[0xEBAD, 0x0D01], None),
            (&[0xF8D3, 0xD000], None),
            (&[0xE8AD, 0x0030], None),
        ] {
            assert_eq!(instructions(halves)[0].stack, bytes, "{halves:04X?}");
        }
    }

    #[test]
    fn an_it_block_is_one_branch_with_its_first_condition() {
        for (condition, name) in (0..15).zip(CONDITIONS) {
            // IT, ITT and ITTTT, each followed by a branch that is in none.
            for (mask, length) in [(0b1000, 1), (0b0100, 2), (0b0001, 4)] {
                let mut halves = vec![0xBF00 | condition << 4 | mask];
                halves.resize(1 + length, 0x2001);
                halves.push(0xD000);
                assert_eq!(conditions(&halves), [(2, name)]);
                let found = instructions(&halves);
                let inside: Vec<bool> = found.iter().map(|at| at.is_conditional).collect();
                let expected = [&[false][..], &vec![true; length], &[false]].concat();
                assert_eq!(inside, expected);
            }
        }
        // NOP, YIELD, WFE, WFI and SEV.
        assert_eq!(conditions(&[0xBF00, 0xBF10, 0xBF20, 0xBF30, 0xBF40]), []);
    }

    #[test]
    fn a_comparison_in_an_it_block_makes_another_branch() {
        // ITT EQ; CMPEQ R0, #1; MOVEQ R0, #0.
        for compare in [0x2801, 0x4508, 0x4288, 0x42C8, 0x4208] {
            assert_eq!(conditions(&[0xBF04, compare, 0x2000]), [(2, "eq"), (4, "eq")]);
        }
        // ITT EQ; a wide TST, CMP and SUBS, by a constant and a register.
        for first in [0xF010, 0xF1B0, 0xEA10, 0xEBB0] {
            assert_eq!(conditions(&[0xBF04, first, 0x0F01, 0x2000]).len(), 2);
        }
        // A wide AND and a narrow addition keep the flags there.
        assert_eq!(conditions(&[0xBF04, 0xF000, 0x0001, 0x2000]).len(), 1);
        assert_eq!(conditions(&[0xBF04, 0x3001, 0x2000]).len(), 1);
    }

    #[test]
    fn a_table_of_bytes_ends_before_its_padding() {
        let found = instructions_with(&[0xE8DF, 0xF001], &[2, 9, 2, 0]);
        let targets = BTreeMap::from([(BASE + 4 + 4, vec![0, 2]), (BASE + 4 + 18, vec![1])]);
        assert_eq!(found[0].flow, Flow::Table(targets));
    }

    #[test]
    fn a_table_of_halfwords_reaches_far() {
        let found = instructions_with(&[0xE8DF, 0xF011], &[2, 0, 0x34, 0x12]);
        let targets = BTreeMap::from([(BASE + 8, vec![0]), (BASE + 4 + 0x2468, vec![1])]);
        assert_eq!(found[0].flow, Flow::Table(targets));
    }

    #[test]
    fn a_wide_instruction_hides_its_second_half() {
        let found = instructions(&[0xF8D3, 0xD000, 0xD001]);
        let addresses: Vec<u32> = found.iter().map(|at| at.address).collect();
        assert_eq!(addresses, [BASE, BASE + 4]);
        assert_eq!(found[0].flow, Flow::Next);
    }
}
