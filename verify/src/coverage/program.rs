//! The branches of an image, each with the source line that it comes from.

use std::{collections::BTreeMap, fs, path::Path};

use addr2line::{
    Context,
    gimli::{Dwarf, EndianSlice, LittleEndian, SectionId},
};
use anyhow::Context as _;
use testkit::{
    elf::{self, Elf, Object, ObjectSection, codes},
    thumb,
};

use super::branch::Branch;

type Lines<'a> = Context<EndianSlice<'a, LittleEndian>>;

/// A line of the sources, and the function that it is in.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// Relative to the workspace for our code.
    pub file: String,
    /// From 1; 0 for code that belongs to no line.
    pub line: u32,
    /// Without the crate's hash and generic arguments.
    pub function: String,
    /// Whether the line is in this repository.
    pub is_ours: bool,
}

/// The instructions of an image.
pub struct Program {
    /// The place of each instruction.
    pub instructions: BTreeMap<u32, Place>,
    pub branches: Vec<Branch>,
}

impl Program {
    /// Reads an ELF file with debug information.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn load(path: &Path, workspace: &Path) -> anyhow::Result<Self> {
        let bytes = fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        Self::parse(&bytes, workspace).with_context(|| format!("cannot parse {}", path.display()))
    }

    fn parse(bytes: &[u8], workspace: &Path) -> anyhow::Result<Self> {
        let file = Elf::parse(bytes)?;
        let lines = lines(&file)?;
        let mut program = Self { instructions: BTreeMap::new(), branches: Vec::new() };
        for code in codes(&file)? {
            let mut last = None;
            for instruction in thumb::decode(&code) {
                let place = place(&lines, instruction.address, workspace, last.as_ref())?;
                last = Some(place.clone());
                program.instructions.insert(instruction.address, place);
                program.branches.extend(Branch::of(instruction));
            }
        }
        Ok(program)
    }
}

/// The source lines of an image.
fn lines<'a>(file: &Elf<'a>) -> anyhow::Result<Lines<'a>> {
    let section = |id: SectionId| -> elf::Result<_> {
        let section = file.section_by_name(id.name());
        let data = section.map(|section| section.data()).transpose()?;
        Ok(EndianSlice::new(data.unwrap_or_default(), LittleEndian))
    };
    Ok(Context::from_dwarf(Dwarf::load(section)?)?)
}

/// The line of an instruction: that of the innermost call that is inlined from our code or a dependency's. Lines of the
/// standard library, and code without a line, count as their callers'. `last` is the place of the instruction before.
fn place(
    lines: &Lines,
    address: u32,
    workspace: &Path,
    last: Option<&Place>,
) -> anyhow::Result<Place> {
    let mut frames = lines.find_frames(address.into()).skip_all_loads()?;
    let mut innermost = None;
    while let Some(frame) = frames.next()? {
        let name = frame.function.as_ref().and_then(|function| function.raw_name().ok());
        let function = name.map_or_else(|| "?".to_owned(), |name| plain_name(&name));
        let location = frame.location.as_ref();
        let file = location.and_then(|location| location.file).unwrap_or_default();
        let line = location.and_then(|location| location.line).unwrap_or(0);
        let own = Path::new(file).strip_prefix(workspace).ok();
        let mut place = Place {
            file: own.map_or_else(|| file.to_owned(), |own| own.display().to_string()),
            line,
            function,
            is_ours: own.is_some(),
        };
        // The compiler gives no line to code that it has merged.
        if let Some(last) = last.filter(|last| line == 0 && last.function == place.function) {
            place = last.clone();
        }
        if !file.contains("/library/") && place.line > 0 {
            return Ok(place);
        }
        innermost.get_or_insert(place);
    }
    Ok(innermost.unwrap_or_else(|| Place {
        file: String::new(),
        line: 0,
        function: "?".to_owned(),
        is_ours: false,
    }))
}

/// The path of a function, without generic arguments: `<a::B as c::D<e::F>>::g` keeps its first bracket.
fn plain_name(mangled: &str) -> String {
    let name = format!("{:#}", rustc_demangle::demangle(mangled));
    let mut plain = String::new();
    let mut depth = 0;
    for (at, char) in name.char_indices() {
        let is_argument =
            char == '<' && (depth > 0 || at > 0 && !name[..at].ends_with([' ', '(', '<', '&']));
        if is_argument {
            depth += 1;
        } else if depth == 0 {
            plain.push(char);
        } else if char == '>' && !name[..at].ends_with('-') {
            depth -= 1;
        }
    }
    plain.replace("::::", "::").trim_end_matches("::").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_functions_lose_their_generic_arguments() {
        for (name, plain) in [
            ("canopen_node::node::Node<A, B<C>>::poll", "canopen_node::node::Node::poll"),
            (
                "<canopen_node::can::Can as a::B<u8>>::send",
                "<canopen_node::can::Can as a::B>::send",
            ),
            ("a::b::<fn(u8) -> u16>", "a::b"),
            ("a::b::{closure#0}", "a::b::{closure#0}"),
        ] {
            assert_eq!(plain_name(name), plain);
        }
    }
}
