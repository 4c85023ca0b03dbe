//! The size of a program in bytes, and of the LSS module within it.

use object::{
    Object, ObjectSection, ObjectSymbol, SectionFlags, SymbolKind, elf, read::elf::ElfFile32,
};

use super::programs::{Builds, Program};

/// Sizes in bytes; `None`: not visible in this program.
#[derive(Clone, Copy, Debug)]
pub struct Sizes {
    /// The functions of the module that contains LSS.
    pub module: Option<u64>,
    /// The LSS state.
    pub state: Option<u64>,
    /// Flash of the whole program.
    pub program: Option<u64>,
}

impl Sizes {
    /// Measures the builds of a program.
    pub fn measure(program: Program, builds: &Builds) -> object::Result<Self> {
        let is_node =
            matches!(program, Program::Node | Program::CanopenRsNode | Program::ZencanNode);
        let apart = builds.in_modules(program);
        // As names are mangled: the crate and the module, each preceded by its length.
        let module = match program {
            Program::Node | Program::Slave => Some("9lss_slave3lss"),
            Program::CanopenRsNode | Program::CanopenRsSlave => Some("10canopen_rs3lss"),
            // It is merged into the node even in this build.
            Program::ZencanNode => None,
        };
        let in_module = |module: &str| {
            symbols(&apart, |symbol, name| {
                symbol.kind() == SymbolKind::Text && name.contains(module)
            })
        };
        let state = symbols(&apart, |_, name| name == "LSS_STATE")?;
        Ok(Self {
            module: module.map(in_module).transpose()?,
            state: (!is_node).then_some(state),
            program: if is_node { Some(flash(&builds.small(program))?) } else { None },
        })
    }
}

type Symbol<'data, 'file> = object::read::elf::ElfSymbol32<'data, 'file>;

/// The total size of the matching symbols.
fn symbols(bytes: &[u8], of: impl Fn(&Symbol<'_, '_>, &str) -> bool) -> object::Result<u64> {
    let file = ElfFile32::<object::Endianness>::parse(bytes)?;
    let of = |symbol: &Symbol<'_, '_>| symbol.name().is_ok_and(|name| of(symbol, name));
    Ok(file.symbols().filter(of).map(|symbol| symbol.size()).sum())
}

/// The bytes loaded into flash: code, constants, and the initial values of RAM.
fn flash(bytes: &[u8]) -> object::Result<u64> {
    let file = ElfFile32::<object::Endianness>::parse(bytes)?;
    let is_allocated = |flags| match flags {
        SectionFlags::Elf { sh_flags } => sh_flags & u64::from(elf::SHF_ALLOC) != 0,
        _ => false,
    };
    let in_flash = file
        .sections()
        .filter(|section| is_allocated(section.flags()) && section.file_range().is_some());
    Ok(in_flash.map(|section| section.size()).sum())
}
