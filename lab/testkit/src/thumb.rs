//! Thumb-2 instructions as far as the flow of a program and its stack matter, decoded by `yaxpeax-arm`.

use std::collections::BTreeMap;

use yaxpeax_arch::{Decoder, U8Reader};
use yaxpeax_arm::armv7::{
    ConditionCode, InstDecoder, Instruction as Decoded, Opcode, Operand, Reg,
};

use crate::elf::Code;

/// An instruction in the flash.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Instruction {
    pub address: u32,
    /// In bytes: 2 or 4.
    pub length: u32,
    /// Such as `bne`.
    pub mnemonic: String,
    pub flow: Flow,
    /// The bytes by which it lets the stack grow, negative if it shrinks; `None` if it sets the stack pointer.
    pub stack: Option<i32>,
    /// Whether it is in an IT block.
    pub is_conditional: bool,
    /// The condition, if it is the first of an IT block, or one whose flags are newer than those of the one before.
    pub condition: Option<String>,
}

/// Where the program continues after an instruction.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Flow {
    Next,
    /// `B`.
    Jump(u32),
    /// `B<cond>`, `CBZ` or `CBNZ`.
    Branch(u32),
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

impl Instruction {
    /// The address after it.
    pub const fn end(&self) -> u32 {
        self.address + self.length
    }
}

/// The instructions of the code.
pub fn decode(code: &Code) -> Vec<Instruction> {
    let mut instructions = Vec::new();
    let mut block = ItBlock::default();
    let mut at = 0;
    while let Some(bytes @ [_, high, ..]) = code.bytes.get(at..) {
        let address = code.base + at as u32;
        let length = if high >> 3 >= 0b11101 { 4 } else { 2 };
        let is_conditional = block.left > 0;
        let condition = (is_conditional && block.is_new).then(|| block.condition.clone());
        let decoded = InstDecoder::default_thumb().decode(&mut U8Reader::new(bytes)).ok();
        let (mnemonic, flow, stack) = match &decoded {
            Some(decoded) => (mnemonic(decoded), flow(address, decoded, code), stack(decoded)),
            None => undecoded(bytes),
        };
        block.advance(decoded.as_ref());
        instructions.push(Instruction {
            address,
            length,
            mnemonic,
            flow,
            stack,
            is_conditional,
            condition,
        });
        at += length as usize;
    }
    instructions
}

/// The IT block around the next instruction.
#[derive(Default)]
struct ItBlock {
    /// Instructions left.
    left: u32,
    condition: String,
    /// Whether the flags are newer than those that the instruction before was judged by.
    is_new: bool,
}

impl ItBlock {
    /// Takes over an instruction.
    fn advance(&mut self, instruction: Option<&Decoded>) {
        if self.left > 0 {
            self.left -= 1;
            self.is_new = instruction.is_some_and(sets_flags);
        } else if let Some(it @ Decoded { opcode: Opcode::IT, operands, .. }) = instruction
            && let [_, Operand::Imm32(mask), ..] = operands
        {
            let condition = it.to_string().split(' ').next_back().unwrap_or_default().to_owned();
            *self = Self { left: 4 - mask.trailing_zeros(), condition, is_new: true };
        }
    }
}

/// Whether an instruction in an IT block sets the flags; narrow arithmetic does not.
fn sets_flags(instruction: &Decoded) -> bool {
    let is_comparison =
        matches!(instruction.opcode, Opcode::CMP | Opcode::CMN | Opcode::TST | Opcode::TEQ);
    is_comparison || instruction.wide && instruction.s
}

fn mnemonic(instruction: &Decoded) -> String {
    instruction.to_string().split(' ').next().unwrap_or_default().to_owned()
}

const SP: u8 = 13;
const LR: u8 = 14;
const PC: u8 = 15;

fn is(operand: Operand, register: u8) -> bool {
    operand == Operand::Reg(Reg::from_u8(register))
}

fn flow(address: u32, instruction: &Decoded, code: &Code) -> Flow {
    let Decoded { opcode, operands, wide, .. } = *instruction;
    let is_always = instruction.condition == ConditionCode::AL;
    let is_to_pc = is(operands[0], PC);
    let target = |from: u32, halves: i32| (address + from).wrapping_add_signed(2 * halves);
    match (opcode, operands) {
        (Opcode::B, [Operand::BranchThumbOffset(to), ..]) if is_always => Flow::Jump(target(4, to)),
        // The decoder counts from the next instruction here.
        (Opcode::B, [Operand::BranchThumbOffset(to), ..])
        | (Opcode::CBZ | Opcode::CBNZ, [_, Operand::BranchThumbOffset(to), ..]) => {
            Flow::Branch(target(if wide { 4 } else { 2 }, to))
        }
        (Opcode::BL, [Operand::BranchThumbOffset(to), ..]) => Flow::Call(target(4, to)),
        (Opcode::TBB | Opcode::TBH, _) => {
            Flow::Table(table(address + 4, opcode == Opcode::TBH, code.data))
        }
        (Opcode::BX, [to, ..]) if is(to, LR) => Flow::Return,
        (Opcode::POP, [Operand::RegList(list), ..]) if list >> PC & 1 == 1 => Flow::Return,
        // LDR PC, [SP], #4 is POP.
        (Opcode::LDR, [_, Operand::RegDerefPostindexOffset(base, 4, true, _), ..])
            if is_to_pc && base.number() == SP =>
        {
            Flow::Return
        }
        (Opcode::LDM(..), [_, Operand::RegList(list), ..]) if list >> PC & 1 == 1 => Flow::Computed,
        (Opcode::BX | Opcode::BLX, _) => Flow::Computed,
        (Opcode::LDR | Opcode::MOV | Opcode::ADD, _) if is_to_pc => Flow::Computed,
        (Opcode::UDF | Opcode::BKPT, _) => Flow::Fault,
        _ => Flow::Next,
    }
}

fn stack(instruction: &Decoded) -> Option<i32> {
    let Decoded { opcode, operands, .. } = *instruction;
    let listed = |list: u16| 4 * list.count_ones() as i32;
    let down = |is_up: bool, bytes: u16| if is_up { -i32::from(bytes) } else { bytes.into() };
    match (opcode, operands) {
        (Opcode::PUSH, [Operand::RegList(list), ..]) => return Some(listed(list)),
        (Opcode::POP, [Operand::RegList(list), ..]) => return Some(-listed(list)),
        (Opcode::SUB, [to, from, Operand::Imm32(bytes), _]) if is(to, SP) && is(from, SP) => {
            return Some(bytes as i32);
        }
        (Opcode::ADD, [to, from, Operand::Imm32(bytes), _]) if is(to, SP) && is(from, SP) => {
            return Some(-(bytes as i32));
        }
        (Opcode::CMP | Opcode::CMN | Opcode::TST | Opcode::TEQ, _) => return Some(0),
        (Opcode::STR | Opcode::STRB | Opcode::STRH, _) => {}
        // Any other that names the stack pointer first sets it.
        _ if is(operands[0], SP) => return None,
        _ => {}
    }
    for operand in operands {
        match operand {
            Operand::RegDerefPreindexOffset(base, bytes, is_up, true)
            | Operand::RegDerefPostindexOffset(base, bytes, is_up, _)
                if base.number() == SP =>
            {
                return Some(down(is_up, bytes));
            }
            Operand::RegWBack(base, true) if base.number() == SP => return None,
            _ => {}
        }
    }
    Some(0)
}

/// What `yaxpeax-arm` does not know: `UDF.W`, the floating-point unit, special registers of a Cortex-M.
fn undecoded(bytes: &[u8]) -> (String, Flow, Option<i32>) {
    let half = |at: usize| bytes.get(at..at + 2).map_or(0, |b| u16::from_le_bytes([b[0], b[1]]));
    let bytes = 4 * i32::from(half(2) & 0xFF);
    let (mnemonic, flow, stack) = match half(0) {
        0xF7F0..=0xF7FF => ("udf.w", Flow::Fault, 0),
        0xED2D | 0xED6D => ("vpush", Flow::Next, bytes),
        0xECBD | 0xECFD => ("vpop", Flow::Next, -bytes),
        _ => ("?", Flow::Next, 0),
    };
    (mnemonic.to_owned(), flow, Some(stack))
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

    /// The only instruction, which has this length.
    fn only(halves: &[u16]) -> Instruction {
        let [instruction] = &instructions(halves)[..] else { panic!("{halves:04X?}") };
        assert_eq!(instruction.length, 2 * halves.len() as u32);
        instruction.clone()
    }

    /// The addresses of the instructions that decide by new flags in IT blocks, from the base on.
    fn conditions(halves: &[u16]) -> Vec<(u32, String)> {
        let found = instructions(halves);
        found.into_iter().filter_map(|at| Some((at.address - BASE, at.condition?))).collect()
    }

    #[test]
    fn a_branch_has_its_mnemonic_and_a_signed_offset() {
        for (halves, mnemonic, target) in [
            (&[0xD000][..], "beq", BASE + 4),
            (&[0xD17F], "bne", BASE + 4 + 254),
            (&[0xDD80], "ble", BASE + 4 - 256),
            (&[0xF000, 0x8000], "beq.w", BASE + 4),
            (&[0xF340, 0x87FF], "ble.w", BASE + 4 + 0xFFE),
            (&[0xF001, 0x8001], "beq.w", BASE + 4 + 0x1002),
            (&[0xF000, 0xA000], "beq.w", BASE + 4 + (1 << 18)),
            (&[0xF000, 0x8800], "beq.w", BASE + 4 + (1 << 19)),
            (&[0xF43F, 0xAFFE], "beq.w", BASE),
            (&[0xF400, 0x8000], "beq.w", BASE + 4 - (1 << 20)),
            (&[0xB100], "cbz", BASE + 4),
            (&[0xB900], "cbnz", BASE + 4),
            (&[0xB10F], "cbz", BASE + 6),
            (&[0xBBFF], "cbnz", BASE + 4 + 126),
        ] {
            let found = only(halves);
            assert_eq!((&*found.mnemonic, found.flow), (mnemonic, Flow::Branch(target)));
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
            (&[0xF7F0, 0xA000], Flow::Fault),
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
            assert_eq!(only(halves).flow, expected, "{halves:04X?}");
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
        for (condition, name) in [(0, "eq"), (1, "ne"), (13, "le")] {
            // IT, ITT and ITTTT, each followed by a branch that is in none.
            for (mask, length) in [(0b1000, 1), (0b0100, 2), (0b0001, 4)] {
                let mut halves = vec![0xBF00 | condition << 4 | mask];
                halves.resize(1 + length, 0x2001);
                halves.push(0xD000);
                assert_eq!(conditions(&halves), [(2, name.to_owned())]);
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
            let eq = "eq".to_owned();
            assert_eq!(conditions(&[0xBF04, compare, 0x2000]), [(2, eq.clone()), (4, eq)]);
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
