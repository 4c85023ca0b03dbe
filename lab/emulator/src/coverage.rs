//! The outcomes of a program's branches, recorded while boards run it.

use std::{
    collections::BTreeSet,
    fs::{self, File},
    io::{self, Read, Seek, Write},
    mem,
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
};

use rsemu::cpu::arm::v7m::{isa::Cond, xpsr};

use crate::chip::FLASH_BASE;

/// The next instruction was two bytes further.
const NEXT_AFTER_2: u8 = 1 << 0;
/// The next instruction was four bytes further.
const NEXT_AFTER_4: u8 = 1 << 1;
/// The next instruction was elsewhere.
const ELSEWHERE: u8 = 1 << 2;
/// The instruction was in an IT block, and its condition was true.
const CONDITION_TRUE: u8 = 1 << 3;
/// The instruction was in an IT block, and its condition was false.
const CONDITION_FALSE: u8 = 1 << 4;

/// What the instructions of an image did on all boards that have run it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Record {
    /// The outcomes of the instruction at each halfword of the flash.
    outcomes: Vec<u8>,
    /// The table branches and where they went, as addresses.
    table_jumps: BTreeSet<(u32, u32)>,
}

impl Record {
    /// Reads a record that [`Coverage`] has written.
    ///
    /// # Errors
    /// The file cannot be read, or it is no record.
    pub fn read(path: &Path) -> io::Result<Self> {
        let bytes = fs::read(path)?;
        Self::parse(&bytes)
            .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidData, "no record of coverage"))
    }

    fn parse(bytes: &[u8]) -> Option<Self> {
        let (length, rest) = bytes.split_first_chunk()?;
        let (outcomes, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
        let (pairs, []) = rest.as_chunks::<8>() else { return None };
        let word = |bytes: &[u8]| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
        let table_jumps = pairs.iter().map(|pair| (word(&pair[..4]), word(&pair[4..]))).collect();
        Some(Self { outcomes: outcomes.to_vec(), table_jumps })
    }

    fn bytes(&self) -> Vec<u8> {
        let mut bytes = (self.outcomes.len() as u32).to_le_bytes().to_vec();
        bytes.extend_from_slice(&self.outcomes);
        bytes.extend(
            self.table_jumps.iter().flat_map(|&(from, to)| [from, to]).flat_map(u32::to_le_bytes),
        );
        bytes
    }

    fn outcomes(&self, address: u32) -> u8 {
        self.outcomes.get(index(address)).copied().unwrap_or(0)
    }

    /// Whether the instruction was executed; in an IT block, whether it was reached.
    pub fn was_executed(&self, address: u32) -> bool {
        self.outcomes(address) != 0
    }

    /// Whether the conditional branch of `length` bytes did not branch, and whether it did.
    pub fn branch(&self, address: u32, length: u32) -> [bool; 2] {
        let [next, other] =
            if length == 2 { [NEXT_AFTER_2, NEXT_AFTER_4] } else { [NEXT_AFTER_4, NEXT_AFTER_2] };
        let outcomes = self.outcomes(address);
        [outcomes & next != 0, outcomes & (other | ELSEWHERE) != 0]
    }

    /// Whether the condition of an instruction in an IT block was false, and whether it was true.
    pub fn condition(&self, address: u32) -> [bool; 2] {
        [CONDITION_FALSE, CONDITION_TRUE].map(|bit| self.outcomes(address) & bit != 0)
    }

    /// Whether the table branch at `from` went to `to`.
    pub fn has_jumped(&self, from: u32, to: u32) -> bool {
        self.table_jumps.contains(&(from, to))
    }

    /// Adds another record; returns whether it has anything new.
    fn merge(&mut self, other: &Self) -> bool {
        let before = self.table_jumps.len();
        self.table_jumps.extend(&other.table_jumps);
        let mut is_new = self.table_jumps.len() > before;
        if self.outcomes.len() < other.outcomes.len() {
            self.outcomes.resize(other.outcomes.len(), 0);
        }
        for (sum, outcomes) in self.outcomes.iter_mut().zip(&other.outcomes) {
            is_new |= outcomes & !*sum != 0;
            *sum |= outcomes;
        }
        is_new
    }
}

/// Collects the records of the boards with an image in a file, which other processes may add to.
#[derive(Debug)]
pub struct Coverage {
    path: PathBuf,
    /// What this process knows to be in the file.
    known: Mutex<Record>,
}

impl Coverage {
    /// Adds to the record in the file, if there is one.
    pub fn new(path: PathBuf) -> Self {
        Self { path, known: Mutex::default() }
    }

    fn add(&self, new: &Record) {
        let mut known = self.known.lock().expect("a panic while the record was written");
        if known.merge(new)
            && let Err(error) = self.write(&mut known)
        {
            eprintln!("cannot write {}: {error}", self.path.display());
        }
    }

    fn write(&self, known: &mut Record) -> io::Result<()> {
        let mut file =
            File::options().read(true).write(true).create(true).truncate(false).open(&self.path)?;
        file.lock()?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        known.merge(&Record::parse(&bytes).unwrap_or_default());
        // A record never becomes shorter.
        file.rewind()?;
        file.write_all(&known.bytes())
    }
}

/// The instruction that a core has executed.
#[derive(Clone, Copy, Debug)]
pub struct Executed {
    pub pc: u32,
    pub next: u32,
    /// The flags and ITSTATE before it.
    pub xpsr: u32,
}

/// Records one board's run; the record is added to the image's when the board is dropped.
#[derive(Debug)]
pub struct Recorder {
    record: Record,
    /// Whether the halfword is a table branch.
    is_table_branch: Vec<bool>,
    coverage: Arc<Coverage>,
}

impl Recorder {
    /// For a program in the flash.
    pub fn new(coverage: Arc<Coverage>, flash: &[u8]) -> Self {
        let (halfwords, _) = flash.as_chunks();
        let is_table_branch: Vec<bool> =
            halfwords.iter().map(|half| u16::from_le_bytes(*half) & 0xFFF0 == 0xE8D0).collect();
        let record = Record { outcomes: vec![0; halfwords.len()], ..Default::default() };
        Self { record, is_table_branch, coverage }
    }

    /// Records an instruction. A jump to itself may be sleep, and is left out.
    pub fn executed(&mut self, Executed { pc, next, xpsr }: Executed) {
        let index = index(pc);
        let Some(outcomes) = self.record.outcomes.get_mut(index) else { return };
        *outcomes |= match next.wrapping_sub(pc) {
            0 => return,
            2 => NEXT_AFTER_2,
            4 => NEXT_AFTER_4,
            _ => ELSEWHERE,
        };
        if let Some(condition) = condition(xpsr) {
            *outcomes |= if condition { CONDITION_TRUE } else { CONDITION_FALSE };
        }
        if self.is_table_branch[index] {
            self.record.table_jumps.insert((pc, next));
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.coverage.add(&mem::take(&mut self.record));
    }
}

fn index(address: u32) -> usize {
    (address.wrapping_sub(FLASH_BASE) / 2) as usize
}

/// The condition of an instruction in an IT block with these flags (ARM DDI 0403, A7.3).
fn condition(xpsr: u32) -> Option<bool> {
    let cond = Cond((xpsr >> 12 & 0xF) as u8);
    (xpsr & xpsr::IT_MASK != 0).then(|| cond.passes(xpsr))
}

#[cfg(test)]
mod tests {
    use super::*;

    const AT: u32 = FLASH_BASE + 8;

    fn recorder(flash: &[u8]) -> Recorder {
        let coverage = Coverage::new(PathBuf::new());
        Recorder::new(Arc::new(coverage), flash)
    }

    #[test]
    fn both_directions_of_a_branch_are_told_apart_by_its_length() {
        let mut recorder = recorder(&[0; 16]);
        recorder.executed(Executed { pc: AT, next: AT + 4, xpsr: 0 });
        assert_eq!(recorder.record.branch(AT, 2), [false, true]);
        assert_eq!(recorder.record.branch(AT, 4), [true, false]);
        recorder.executed(Executed { pc: AT, next: AT - 8, xpsr: 0 });
        assert_eq!(recorder.record.branch(AT, 4), [true, true]);
    }

    #[test]
    fn sleep_and_code_outside_of_the_image_are_left_out() {
        let mut recorder = recorder(&[0; 16]);
        recorder.executed(Executed { pc: AT, next: AT, xpsr: 0 });
        recorder.executed(Executed { pc: AT + 8, next: AT, xpsr: 0 });
        recorder.executed(Executed { pc: 0, next: AT, xpsr: 0 });
        assert!(recorder.record.outcomes.iter().all(|outcomes| *outcomes == 0));
    }

    #[test]
    fn an_instruction_in_an_it_block_has_the_condition_of_its_flags() {
        // ADDEQ in ITETE EQ, then ADDNE in its second place.
        const Z: u32 = xpsr::Z;
        for (state, flags, expected) in
            [(0x0B, 0, false), (0x0B, Z, true), (0x16, 0, true), (0x16, Z, false)]
        {
            let it = (state >> 2) << 10 | (state & 0b11) << 25;
            assert_eq!(condition(it | flags), Some(expected), "{state:#x}, {flags:#x}");
        }
        assert_eq!(condition(Z), None);
    }

    #[test]
    fn a_file_adds_up_what_the_boards_have_done() {
        let path = std::env::temp_dir().join(format!("coverage-{}", std::process::id()));
        for next in [AT + 2, AT + 6] {
            let coverage = Arc::new(Coverage::new(path.clone()));
            let mut recorder = Recorder::new(coverage, &[0xD0, 0xE8].repeat(8));
            recorder.executed(Executed { pc: AT, next, xpsr: 0 });
        }
        let record = Record::read(&path).expect("a record");
        fs::remove_file(&path).expect("it exists");
        assert_eq!(record.branch(AT, 2), [true, true]);
        assert!(record.has_jumped(AT, AT + 6));
        assert_eq!(Record::parse(&record.bytes()), Some(record));
    }

    #[test]
    fn a_damaged_file_is_no_record() {
        for bytes in [&[][..], &[1, 0, 0], &[1, 0, 0, 0], &[0, 0, 0, 0, 1]] {
            assert_eq!(Record::parse(bytes), None);
        }
    }
}
