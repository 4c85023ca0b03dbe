//! The functions of an image as graphs of instructions.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, HashSet},
    path::Path,
};

use anyhow::{Context, bail, ensure};
use object::{Object, ObjectSection, ObjectSymbol, SymbolKind};

use super::instruction::{Flow, Instruction, Mask, mask};
use crate::coverage::{
    program::{Elf, Lines, codes, lines, plain_name},
    thumb::{self, Kind},
};

/// A call that the compiler has inlined, or the function itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// Relative to the workspace for our code.
    pub file: String,
    pub line: u32,
    pub function: String,
}

/// The instructions of an image, and what is known of them.
#[derive(Default)]
pub struct Program {
    pub instructions: BTreeMap<u32, Instruction>,
    /// The masks that an instruction changes.
    pub masks: HashMap<u32, Mask>,
    /// The names of the functions, by address.
    pub names: BTreeMap<u32, String>,
    /// The calls around each instruction, the innermost first.
    pub frames: HashMap<u32, Vec<Frame>>,
    /// The functions in the vector table, by the number of the exception.
    pub vectors: Vec<u32>,
    /// The instructions that the program comes to by a jump or a return.
    pub targets: HashSet<u32>,
    /// The functions that never return.
    pub endless: BTreeSet<u32>,
    /// The functions with the address of a constant in the flash.
    pub readers: BTreeSet<u32>,
    /// The loads that were executed on an emulated board and never read the flash.
    pub ram_loads: HashSet<u32>,
    /// The loads that read it.
    pub constant_loads: HashSet<u32>,
    /// The loads and stores that were executed there and never reached a peripheral.
    pub ram_accesses: HashSet<u32>,
    /// The loads and stores that reached one.
    pub peripheral_accesses: HashSet<u32>,
}

impl Program {
    /// Reads an ELF file with debug information.
    pub fn parse(bytes: &[u8], workspace: &Path) -> anyhow::Result<Self> {
        let file = Elf::parse(bytes)?;
        let lines = lines(&file)?;
        let mut program =
            Self { names: names(&file), vectors: vectors(&file)?, ..Default::default() };
        for code in codes(&file)? {
            program.decode(&code);
        }
        for &address in program.instructions.keys() {
            program.frames.insert(address, frames(&lines, address, workspace)?);
        }
        program.find_endless();
        program.find_readers(&file)?;
        Ok(program)
    }

    /// Adds the instructions of a piece of code.
    pub fn decode(&mut self, code: &thumb::Code) {
        let half = |address: u32| {
            let at = (address - code.base) as usize;
            u16::from_le_bytes([code.bytes[at], code.bytes[at + 1]])
        };
        let (addresses, branches) = thumb::decode(code);
        let mut tables: HashMap<u32, Vec<u32>> = branches
            .into_iter()
            .filter_map(|branch| match branch.kind {
                Kind::Table { targets } => Some((branch.address, targets.into_keys().collect())),
                _ => None,
            })
            .collect();
        let ends = addresses.iter().skip(1).copied().chain([code.base + code.bytes.len() as u32]);
        let mut conditional = 0;
        for (&address, end) in addresses.iter().zip(ends) {
            let first = half(address);
            let second = (end - address == 4).then(|| half(address + 2));
            let mut instruction = Instruction::decode(address, first, second, conditional > 0);
            if let Flow::Table(targets) = &mut instruction.flow {
                *targets = tables.remove(&address).unwrap_or_default();
            }
            conditional = match first {
                0xBF00..=0xBFFF if second.is_none() && first & 0xF != 0 => {
                    4 - (first & 0xF).trailing_zeros()
                }
                _ => conditional.saturating_sub(1),
            };
            match &instruction.flow {
                Flow::Jump(target) | Flow::Branch(target) => self.targets.extend([*target]),
                Flow::Table(targets) => self.targets.extend(targets),
                Flow::Call(target) => self.targets.extend([*target, end]),
                _ => {}
            }
            self.masks.extend(mask(first, second).map(|mask| (address, mask)));
            self.instructions.insert(address, instruction);
        }
    }

    /// The address of the only function with this end of its name.
    pub fn function(&self, name: &str) -> anyhow::Result<u32> {
        let mut found = self.names.iter().filter(|(_, found)| is_named(found, name));
        let (&address, _) = found.next().with_context(|| {
            format!("no function {name} in the image: it was renamed, or inlined into its callers")
        })?;
        ensure!(found.next().is_none(), "there are several functions {name} in the image");
        Ok(address)
    }

    /// The name of the function that begins at an address.
    pub fn name(&self, address: u32) -> &str {
        self.names.get(&address).map_or("?", String::as_str)
    }

    /// The function that an instruction is in.
    pub fn owner(&self, address: u32) -> u32 {
        self.names.range(..=address).next_back().map_or(0, |(address, _)| *address)
    }

    /// The function called or jumped to by an instruction, if it is another than `own`.
    pub fn callee(&self, instruction: &Instruction, own: u32) -> Option<u32> {
        match instruction.flow {
            Flow::Call(target) => Some(target),
            Flow::Jump(target) | Flow::Branch(target)
                if target != own && self.names.contains_key(&target) =>
            {
                Some(target)
            }
            _ => None,
        }
    }

    /// The next instructions within the function at `own`.
    pub fn successors(&self, instruction: &Instruction, own: u32) -> Vec<u32> {
        let callee = self.callee(instruction, own);
        let mut next = Vec::new();
        let falls_through = match &instruction.flow {
            Flow::Call(target) => instruction.is_conditional || !self.endless.contains(target),
            Flow::Jump(target) => {
                next.extend((callee.is_none()).then_some(*target));
                instruction.is_conditional
            }
            Flow::Branch(target) => {
                next.extend((callee.is_none()).then_some(*target));
                true
            }
            Flow::Table(targets) => {
                next.extend(targets);
                false
            }
            Flow::Return => instruction.is_conditional,
            Flow::Fault | Flow::Unknown(_) => false,
            Flow::Next => true,
        };
        next.extend(falls_through.then_some(instruction.end()));
        next
    }

    /// The instructions of the function at `entry`, each with the next ones in it.
    ///
    /// # Errors
    /// An instruction that the analysis cannot follow.
    pub fn graph(&self, entry: u32) -> anyhow::Result<BTreeMap<u32, Vec<u32>>> {
        let mut graph = BTreeMap::new();
        let mut open = vec![entry];
        while let Some(address) = open.pop() {
            if graph.contains_key(&address) {
                continue;
            }
            let Some(instruction) = self.instructions.get(&address) else {
                bail!("{}: no code at {address:#x}", self.name(entry));
            };
            if let Flow::Unknown(what) = instruction.flow {
                bail!("{}: {what} at {address:#x}, {}", self.name(entry), self.place(address));
            }
            let next = self.successors(instruction, entry);
            open.extend(&next);
            graph.insert(address, next);
        }
        Ok(graph)
    }

    /// All functions that `entry` calls, directly or not, and itself.
    pub fn reachable(&self, entry: u32) -> anyhow::Result<BTreeSet<u32>> {
        let mut found = BTreeSet::new();
        let mut open = vec![entry];
        while let Some(function) = open.pop() {
            if found.insert(function) {
                let graph = self.graph(function)?;
                open.extend(
                    graph.keys().filter_map(|at| self.callee(&self.instructions[at], function)),
                );
            }
        }
        Ok(found)
    }

    /// The source line of an instruction, for messages.
    pub fn place(&self, address: u32) -> String {
        let frames = self.frames.get(&address).map_or(&[][..], Vec::as_slice);
        let is_ours = |frame: &&Frame| !frame.file.starts_with('/') && frame.line > 0;
        frames
            .iter()
            .find(is_ours)
            .or(frames.first())
            .map_or("a function without source lines".to_owned(), |frame| {
                format!("{}:{} in {}", frame.file, frame.line, frame.function)
            })
    }

    /// Whether an instruction may access a peripheral: it comes from a volatile access, or from no known line.
    pub fn is_volatile(&self, address: u32) -> bool {
        let frames = self.frames.get(&address).map_or(&[][..], Vec::as_slice);
        let may_be = |frame: &Frame| frame.line == 0 || frame.function.contains("volatile");
        self.peripheral_accesses.contains(&address)
            || frames.first().is_none_or(may_be) && !self.ram_accesses.contains(&address)
    }

    /// The length that the call at `at` passes to a function that copies, if it is a constant.
    pub fn copied(&self, callee: u32, at: u32) -> Option<u64> {
        let register = if self.name(callee).contains("memclr") { 1 } else { 2 };
        let mut at = at;
        loop {
            if self.targets.contains(&at) {
                return None;
            }
            let (_, before) = self.instructions.range(..at).next_back()?;
            if before.end() != at || before.flow != Flow::Next || before.is_conditional {
                return None;
            }
            at = before.address;
            match before.constant {
                Some((destination, constant)) if destination == register => {
                    return Some(constant.into());
                }
                _ if before.may_change >> register & 1 == 1 => return None,
                _ => {}
            }
        }
    }

    /// Finds the functions that never return.
    fn find_endless(&mut self) {
        let called: BTreeSet<u32> = self
            .instructions
            .values()
            .filter_map(|instruction| match instruction.flow {
                Flow::Call(target) => Some(target),
                Flow::Jump(target) if self.names.contains_key(&target) => Some(target),
                _ => None,
            })
            .collect();
        // At first none is known to return; what is found to return makes others return.
        self.endless = called.clone();
        loop {
            let mut returning = Vec::new();
            for &function in &self.endless {
                let graph = self.graph_until_unknown(function);
                let returns = graph.iter().any(|at| {
                    let instruction = &self.instructions[at];
                    match (&instruction.flow, self.callee(instruction, function)) {
                        (Flow::Return | Flow::Unknown(_), _) => true,
                        (Flow::Jump(_) | Flow::Branch(_), Some(callee)) => {
                            !self.endless.contains(&callee)
                        }
                        _ => false,
                    }
                });
                if returns {
                    returning.push(function);
                }
            }
            if returning.is_empty() {
                return;
            }
            self.endless.retain(|function| !returning.contains(function));
        }
    }

    fn graph_until_unknown(&self, entry: u32) -> BTreeSet<u32> {
        let mut found = BTreeSet::new();
        let mut open = vec![entry];
        while let Some(address) = open.pop() {
            if let Some(instruction) = self.instructions.get(&address)
                && found.insert(address)
            {
                open.extend(self.successors(instruction, entry));
            }
        }
        found
    }

    /// Finds the functions that contain the address of a constant in the flash: `MOVW` and `MOVT`, or a word beside the
    /// code.
    fn find_readers(&mut self, file: &Elf) -> anyhow::Result<()> {
        let section = file.section_by_name(".rodata").context("no .rodata")?;
        let constants = section.address() as u32..(section.address() + section.size()) as u32;
        let starts: Vec<u32> = self.names.keys().copied().collect();
        let owner = |address: u32| {
            let position = starts.partition_point(|start| *start <= address);
            position.checked_sub(1).map(|at| starts[at])
        };
        let text = file.section_by_name(".text").context("no .text")?;
        let (base, content) = (text.address() as u32, text.data()?);
        let half = |address: u32| {
            let at = (address - base) as usize;
            content.get(at..at + 2).map_or(0, |half| u16::from_le_bytes([half[0], half[1]]))
        };
        for address in (base..base + content.len() as u32).step_by(4) {
            let word = u32::from(half(address)) | u32::from(half(address + 2)) << 16;
            if !self.instructions.contains_key(&address) && constants.contains(&word) {
                self.readers.extend(owner(address));
            }
        }
        for &address in self.instructions.keys().filter(|address| **address >= base) {
            // MOVW of the lower half: the upper one is the same for all addresses in the flash.
            let (first, second) = (half(address), half(address + 2));
            if first & 0xFBF0 == 0xF240 && second & 0x8000 == 0 {
                let value = u32::from(first & 0xF) << 12
                    | u32::from(first >> 10 & 1) << 11
                    | u32::from(second >> 12 & 7) << 8
                    | u32::from(second & 0xFF);
                if (constants.start & 0xFFFF..=constants.end & 0xFFFF).contains(&value) {
                    self.readers.extend(owner(address));
                }
            }
        }
        Ok(())
    }
}

/// Whether a path ends with `name`, at a path's separator.
pub fn is_named(path: &str, name: &str) -> bool {
    path.strip_suffix(name).is_some_and(|rest| {
        rest.is_empty() || rest.ends_with("::") || rest.ends_with(' ') || rest.ends_with('<')
    })
}

fn names(file: &Elf) -> BTreeMap<u32, String> {
    let mut names = BTreeMap::new();
    for symbol in file.symbols().filter(|symbol| symbol.kind() == SymbolKind::Text) {
        let Ok(name) = symbol.name() else { continue };
        if name.starts_with('$') || name.is_empty() || symbol.section_index().is_none() {
            continue;
        }
        let is_label = symbol.size() == 0 && (name == "__stext" || name == "__etext");
        if !is_label {
            // Of several names the first in the alphabet, so that the choice is always the same.
            let name = plain_name(name);
            let address = symbol.address() as u32 & !1;
            let kept = names.entry(address).or_insert_with(|| name.clone());
            if name < *kept {
                *kept = name;
            }
        }
    }
    names
}

fn vectors(file: &Elf) -> anyhow::Result<Vec<u32>> {
    let section = file.section_by_name(".vector_table").context("no vector table")?;
    let words = section.data()?.as_chunks::<4>().0.iter();
    Ok(words.map(|word| u32::from_le_bytes(*word) & !1).collect())
}

/// The calls around an instruction, the innermost first.
fn frames(lines: &Lines, address: u32, workspace: &Path) -> anyhow::Result<Vec<Frame>> {
    let mut found = Vec::new();
    let mut frames = lines.find_frames(address.into()).skip_all_loads()?;
    while let Some(frame) = frames.next()? {
        let name = frame.function.as_ref().and_then(|function| function.raw_name().ok());
        let location = frame.location.as_ref();
        let file = location.and_then(|location| location.file).unwrap_or_default();
        let own = Path::new(file).strip_prefix(workspace).ok();
        found.push(Frame {
            file: own.map_or_else(|| file.to_owned(), |own| own.display().to_string()),
            line: location.and_then(|location| location.line).unwrap_or(0),
            function: name.map_or_else(|| "?".to_owned(), |name| plain_name(&name)),
        });
    }
    Ok(found)
}

#[cfg(test)]
impl Program {
    /// The program in these halfwords, with functions at the given ones.
    pub fn of(halves: &[u16], functions: &[(usize, &str)]) -> Self {
        let mut program = Self::default();
        let bytes: Vec<u8> = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
        program.decode(&thumb::Code { base: Self::BASE, bytes: &bytes, data: &[] });
        let address = |at: usize| Self::BASE + 2 * at as u32;
        program.names =
            functions.iter().map(|(at, name)| (address(*at), (*name).to_owned())).collect();
        program.frames =
            program.instructions.keys().map(|address| (*address, Vec::new())).collect();
        program.find_endless();
        program
    }

    pub const BASE: u32 = 0x0800_C000;
}
