//! The sections, the code and the functions of a linked program.

use std::collections::{BTreeMap, BTreeSet};

pub use object::{Object, ObjectSection, ObjectSymbol, Result, SectionKind, SymbolKind};
use object::{SectionFlags, elf, read::elf::ElfFile32};

/// A parsed ELF file.
pub type Elf<'a> = ElfFile32<'a>;

/// A section of a program that occupies memory.
pub struct Section {
    pub name: String,
    pub address: u32,
    pub bytes: u64,
    /// Whether its content is loaded into flash: code, constants, and the initial values of RAM.
    pub is_loaded: bool,
}

/// Code in the flash, without the constants between the functions.
pub struct Code<'a> {
    /// The address of the first byte.
    pub base: u32,
    pub bytes: &'a [u8],
    /// The constants that follow, in which the entries of a table branch are.
    pub data: &'a [u8],
}

/// The sections that are not empty, in the order of the file.
pub fn sections(file: &Elf) -> Result<Vec<Section>> {
    let is_allocated = |flags| match flags {
        SectionFlags::Elf { sh_flags } => sh_flags & u64::from(elf::SHF_ALLOC) != 0,
        _ => false,
    };
    let occupied = |section: &object::read::elf::ElfSection32<'_, '_>| {
        section.size() > 0 && is_allocated(section.flags())
    };
    let section = |section: object::read::elf::ElfSection32<'_, '_>| {
        Ok(Section {
            name: section.name()?.to_owned(),
            address: section.address() as u32,
            bytes: section.size(),
            is_loaded: section.file_range().is_some(),
        })
    };
    file.sections().filter(occupied).map(section).collect()
}

/// The code of a program, without the constants in it.
pub fn codes<'a>(file: &Elf<'a>) -> Result<Vec<Code<'a>>> {
    // "$t" begins code and "$d" constants, up to the next of them.
    let is_code: BTreeMap<u64, bool> = file
        .symbols()
        .filter_map(|symbol| Some((symbol.address(), symbol.name().ok()?.get(..2)?.to_owned())))
        .filter(|(_, kind)| kind == "$t" || kind == "$d")
        .map(|(address, kind)| (address, kind == "$t"))
        .collect();
    let mut codes = Vec::new();
    for section in file.sections().filter(|section| section.kind() == SectionKind::Text) {
        let (start, content) = (section.address(), section.data()?);
        let end = start + content.len() as u64;
        let starts: Vec<u64> =
            is_code.range(start..end).map(|(address, _)| *address).chain([end, end]).collect();
        let part = |from: u64, to: u64| &content[(from - start) as usize..(to - start) as usize];
        for window in starts.windows(3).filter(|window| is_code.get(&window[0]) == Some(&true)) {
            let data = if is_code.get(&window[1]) == Some(&false) {
                part(window[1], window[2])
            } else {
                &[]
            };
            codes.push(Code { base: window[0] as u32, bytes: part(window[0], window[1]), data });
        }
    }
    Ok(codes)
}

/// The functions of a program: their addresses and demangled names.
pub fn functions(file: &Elf) -> BTreeMap<u32, String> {
    let mut functions = BTreeMap::new();
    for symbol in file.symbols().filter(|symbol| symbol.kind() == SymbolKind::Text) {
        let name = symbol.name().unwrap_or_default();
        let is_label = symbol.size() == 0 && matches!(name, "__stext" | "__etext");
        if symbol.section_index().is_some() && !is_label && !name.starts_with('$') {
            let name = format!("{:#}", rustc_demangle::demangle(name));
            functions.entry(symbol.address() as u32 & !1).or_insert(name);
        }
    }
    functions
}

/// The functions in the vector table, from the reset on.
///
/// # Errors
/// There is no vector table.
pub fn vectors(file: &Elf) -> Result<BTreeSet<u32>> {
    let table = file.section_by_name(".vector_table").map(|section| section.data()).transpose()?;
    let words = table.unwrap_or_default().as_chunks::<4>().0.iter().skip(1);
    Ok(words.map(|word| u32::from_le_bytes(*word) & !1).filter(|vector| *vector != 0).collect())
}
