//! The sections of a linked program, and the memory that it takes.

use emulator::chip::{FLASH_BASE, Part, RAM_BASE};
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

impl Section {
    /// Whether it takes flash.
    pub fn is_in_flash(&self) -> bool {
        self.is_loaded && self.address >= FLASH_BASE
    }

    fn is_in_ram(&self) -> bool {
        self.address >= RAM_BASE
    }
}

/// The table of the flash and the RAM that each section of an ELF file takes, and the flash that all take, in bytes.
pub fn size(elf: &[u8], part: Part) -> Result<(String, u64)> {
    let sections = sections(&Elf::parse(elf)?)?;
    let sum = |of: fn(&Section) -> bool| -> u64 {
        sections.iter().filter(|section| of(section)).map(|section| section.bytes).sum()
    };
    let (flash, ram) = (sum(Section::is_in_flash), sum(Section::is_in_ram));
    let mut report = format!("{:16} {:>8} {:>8}\n", part.name(), "flash", "RAM");
    for section in &sections {
        let column = |takes: bool| if takes { section.bytes.to_string() } else { String::new() };
        let (flash, ram) = (column(section.is_in_flash()), column(section.is_in_ram()));
        report += &format!("{:16} {flash:>8} {ram:>8}\n", section.name);
    }
    report += &format!("{:16} {flash:>8} {ram:>8}\n", "total");
    Ok((report, flash))
}
