//! Finds the branches in Thumb-2 code (ARM DDI 0403, chapter A7).

use std::collections::BTreeMap;

use emulator::coverage::Record;

/// An instruction after which the program may continue at more than one place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Branch {
    /// The address of the instruction.
    pub address: u32,
    /// Its length in bytes.
    pub length: u32,
    /// The places at which the program may continue.
    pub kind: Kind,
}

/// The kind of a branch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Kind {
    /// `B<cond>`, `CBZ` or `CBNZ`.
    Conditional { mnemonic: &'static str, target: u32 },
    /// An instruction of an IT block: the first, or one whose flags are newer than those of the one before.
    It { condition: &'static str },
    /// `TBB` or `TBH`: each target once, with the indices of its entries.
    Table { targets: BTreeMap<u32, Vec<usize>> },
    /// A jump or call to an address in a register or in memory.
    Computed,
}

/// A way in which the program may continue after a branch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// A verb phrase, such as "jumps".
    pub name: String,
    /// The next instruction, if the outcome decides it.
    pub target: Option<u32>,
    /// Whether the program has continued so.
    pub was_seen: bool,
}

impl Branch {
    /// The name of the instruction, as in the manual.
    pub fn mnemonic(&self) -> String {
        match &self.kind {
            Kind::Conditional { mnemonic, .. } => (*mnemonic).to_owned(),
            Kind::It { condition } => format!("it {condition}"),
            Kind::Table { .. } => "table branch".to_owned(),
            Kind::Computed => "computed jump".to_owned(),
        }
    }

    /// The outcomes, with those of the record.
    pub fn outcomes(&self, record: &Record) -> Vec<Outcome> {
        let outcome =
            |name: &str, target, was_seen| Outcome { name: name.to_owned(), target, was_seen };
        match &self.kind {
            Kind::Conditional { target, .. } => {
                let [next, jump] = record.branch(self.address, self.length);
                vec![
                    outcome("falls through", Some(self.address + self.length), next),
                    outcome("jumps", Some(*target), jump),
                ]
            }
            Kind::It { .. } => {
                let [no, yes] = record.condition(self.address);
                vec![outcome("is false", None, no), outcome("is true", None, yes)]
            }
            Kind::Table { targets } => targets
                .iter()
                .map(|(&to, indices)| {
                    let indices: Vec<String> = indices.iter().map(usize::to_string).collect();
                    let name = format!("jumps by index {}", indices.join(", "));
                    outcome(&name, Some(to), record.has_jumped(self.address, to))
                })
                .collect(),
            Kind::Computed => vec![outcome("runs", None, record.was_executed(self.address))],
        }
    }
}

/// Code in the flash, without the constants between the functions.
pub struct Code<'a> {
    /// The address of the first byte.
    pub base: u32,
    pub bytes: &'a [u8],
    /// The constants that follow, in which the entries of a table branch are.
    pub data: &'a [u8],
}

/// The instructions of the code, as addresses, and the branches among them.
pub fn decode(code: &Code) -> (Vec<u32>, Vec<Branch>) {
    let half = |at: usize| {
        let bytes = code.bytes.get(at..at + 2)?;
        Some(u16::from_le_bytes([bytes[0], bytes[1]]))
    };
    let mut instructions = Vec::new();
    let mut branches = Vec::new();
    let mut block = ItBlock::default();
    let mut at = 0;
    while let Some(first) = half(at) {
        let address = code.base + at as u32;
        let second = if first >> 11 >= 0b11101 { half(at + 2) } else { None };
        let length = if second.is_some() { 4 } else { 2 };
        instructions.push(address);
        let kind = block.condition().map_or_else(
            || kind(address, first, second, code),
            |condition| Some(Kind::It { condition }),
        );
        block.advance(first, second);
        branches.extend(kind.map(|kind| Branch { address, length, kind }));
        at += length as usize;
    }
    (instructions, branches)
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

/// The kind of an instruction outside of IT blocks, if it is a branch.
fn kind(address: u32, first: u16, second: Option<u16>, code: &Code) -> Option<Kind> {
    let after = |offset: i32| address.wrapping_add(4).wrapping_add_signed(offset);
    let bits = u32::from(first);
    let Some(second) = second else {
        return match first {
            _ if first & 0xF000 == 0xD000 && first >> 8 & 0xF < 14 => {
                let offset = i32::from(first as u8 as i8) * 2;
                Some(Kind::Conditional {
                    mnemonic: B[usize::from(first >> 8 & 0xF)],
                    target: after(offset),
                })
            }
            _ if first & 0xF500 == 0xB100 => {
                let offset = (bits >> 9 & 1) << 6 | (bits >> 3 & 0x1F) << 1;
                let mnemonic = if bits >> 11 & 1 == 1 { "cbnz" } else { "cbz" };
                Some(Kind::Conditional { mnemonic, target: after(offset as i32) })
            }
            // BX to another register than LR, BLX, and MOV and ADD to PC.
            _ if first & 0xFF87 == 0x4700 && first != 0x4770 => Some(Kind::Computed),
            _ if matches!(first & 0xFF87, 0x4780 | 0x4687 | 0x4487) => Some(Kind::Computed),
            _ => None,
        };
    };
    let condition = usize::from(first >> 6 & 0xF);
    if first & 0xF800 == 0xF000 && second & 0xD000 == 0x8000 && condition < 14 {
        let low = u32::from(second);
        let offset = (bits >> 10 & 1) << 20
            | (low >> 11 & 1) << 19
            | (low >> 13 & 1) << 18
            | (bits & 0x3F) << 12
            | (low & 0x7FF) << 1;
        let offset = (offset << 11) as i32 >> 11;
        return Some(Kind::Conditional { mnemonic: B[condition], target: after(offset) });
    }
    if first & 0xFFF0 == 0xE8D0 && second & 0xFFE0 == 0xF000 {
        return Some(Kind::Table { targets: table(address + 4, second & 0x10 != 0, code.data) });
    }
    // LDR to PC, but not POP.
    (first & 0xFF70 == 0xF850 && second >> 12 == 15 && (first, second) != (0xF85D, 0xFB04))
        .then_some(Kind::Computed)
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

    fn branches_with(halves: &[u16], data: &[u8]) -> Vec<Branch> {
        let bytes: Vec<u8> = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
        decode(&Code { base: BASE, bytes: &bytes, data }).1
    }

    fn branches(halves: &[u16]) -> Vec<Branch> {
        branches_with(halves, &[])
    }

    fn conditional(mnemonic: &'static str, target: u32) -> Kind {
        Kind::Conditional { mnemonic, target }
    }

    #[test]
    fn a_narrow_branch_has_each_condition_and_a_signed_offset() {
        for (condition, mnemonic) in (0..).zip(B) {
            for (offset, target) in [(0, BASE + 4), (0x7F, BASE + 4 + 254), (0x80, BASE + 4 - 256)]
            {
                let [branch] = &branches(&[0xD000 | condition << 8 | offset])[..] else {
                    panic!("{mnemonic}")
                };
                assert_eq!(
                    *branch,
                    Branch { address: BASE, length: 2, kind: conditional(mnemonic, target) }
                );
            }
        }
        // UDF and SVC.
        assert_eq!(branches(&[0xDE00, 0xDF00]), []);
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
                let [branch] = &branches(&[first | condition << 6, second])[..] else {
                    panic!("{mnemonic}")
                };
                assert_eq!(
                    *branch,
                    Branch { address: BASE, length: 4, kind: conditional(mnemonic, target) }
                );
            }
        }
        // B, BL, MSR and DSB have other bits.
        assert_eq!(branches(&[0xF000, 0xB800, 0xF000, 0xF800, 0xF380, 0x8800, 0xF3BF, 0x8F4F]), []);
    }

    #[test]
    fn compare_and_branch_goes_forward_only() {
        for (half, mnemonic, target) in [
            (0xB100, "cbz", BASE + 4),
            (0xB900, "cbnz", BASE + 4),
            (0xB10F, "cbz", BASE + 6),
            (0xBBFF, "cbnz", BASE + 4 + 126),
        ] {
            assert_eq!(branches(&[half])[0].kind, conditional(mnemonic, target));
        }
        // SXTH, PUSH, REV.
        assert_eq!(branches(&[0xB200, 0xB500, 0xBA00]), []);
    }

    #[test]
    fn an_it_block_is_one_branch_with_its_first_condition() {
        for (condition, name) in (0..15).zip(CONDITIONS) {
            // IT, ITT and ITTTT, each followed by a branch that is in none.
            for (mask, length) in [(0b1000, 1), (0b0100, 2), (0b0001, 4)] {
                let mut halves = vec![0xBF00 | condition << 4 | mask];
                halves.resize(1 + length, 0x2001);
                halves.push(0xD000);
                let found = branches(&halves);
                assert_eq!(found[0].kind, Kind::It { condition: name });
                assert_eq!(found[0].address, BASE + 2);
                assert_eq!(found[1].address, BASE + 2 + 2 * length as u32);
                assert_eq!(found.len(), 2);
            }
        }
        // NOP, YIELD, WFE, WFI and SEV.
        assert_eq!(branches(&[0xBF00, 0xBF10, 0xBF20, 0xBF30, 0xBF40]), []);
    }

    #[test]
    fn a_comparison_in_an_it_block_makes_another_branch() {
        // ITT EQ; CMPEQ R0, #1; MOVEQ R0, #0.
        for compare in [0x2801, 0x4508, 0x4288, 0x42C8, 0x4208] {
            let found = branches(&[0xBF04, compare, 0x2000]);
            assert_eq!(
                found.iter().map(|branch| branch.address).collect::<Vec<_>>(),
                [BASE + 2, BASE + 4]
            );
        }
        // ITT EQ; a wide TST, CMP and SUBS, by a constant and a register.
        for first in [0xF010, 0xF1B0, 0xEA10, 0xEBB0] {
            assert_eq!(branches(&[0xBF04, first, 0x0F01, 0x2000]).len(), 2);
        }
        // A wide AND and a narrow addition keep the flags there.
        assert_eq!(branches(&[0xBF04, 0xF000, 0x0001, 0x2000]).len(), 1);
        assert_eq!(branches(&[0xBF04, 0x3001, 0x2000]).len(), 1);
    }

    #[test]
    fn a_table_of_bytes_ends_before_its_padding() {
        let found = branches_with(&[0xE8DF, 0xF001], &[2, 9, 2, 0]);
        let targets = BTreeMap::from([(BASE + 4 + 4, vec![0, 2]), (BASE + 4 + 18, vec![1])]);
        assert_eq!(found, [Branch { address: BASE, length: 4, kind: Kind::Table { targets } }]);
    }

    #[test]
    fn a_table_of_halfwords_reaches_far() {
        let found = branches_with(&[0xE8DF, 0xF011], &[2, 0, 0x34, 0x12]);
        let targets = BTreeMap::from([(BASE + 8, vec![0]), (BASE + 4 + 0x2468, vec![1])]);
        assert_eq!(found[0].kind, Kind::Table { targets });
    }

    #[test]
    fn computed_jumps_are_no_returns() {
        // BX R3, BLX R3, MOV PC, R3, ADD PC, R3.
        for half in [0x4718, 0x4798, 0x469F, 0x449F] {
            assert_eq!(branches(&[half])[0].kind, Kind::Computed, "{half:04X}");
        }
        assert_eq!(branches(&[0xF853, 0xF021])[0].kind, Kind::Computed);
        // BX LR, MOV R8, R3, POP {PC}, and a load of R14.
        assert_eq!(branches(&[0x4770, 0x4698, 0xF85D, 0xFB04, 0xF8D3, 0xE000]), []);
    }

    #[test]
    fn a_wide_instruction_hides_its_second_half() {
        let bytes: Vec<u8> =
            [0xF8D3_u16, 0xD000, 0xD001].iter().flat_map(|half| half.to_le_bytes()).collect();
        let (instructions, branches) = decode(&Code { base: BASE, bytes: &bytes, data: &[] });
        assert_eq!(instructions, [BASE, BASE + 4]);
        assert_eq!(branches.len(), 1);
    }
}
