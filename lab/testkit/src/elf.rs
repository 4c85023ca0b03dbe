//! The sections of a linked program.

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
