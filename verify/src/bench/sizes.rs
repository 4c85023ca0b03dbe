//! The size of a program in bytes, and of the LSS module within it.

use testkit::elf::{self, Elf, Object, ObjectSymbol, SymbolKind};

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
    pub fn measure(program: Program, builds: &Builds) -> elf::Result<Self> {
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
            symbols(&apart, |kind, name| kind == SymbolKind::Text && name.contains(module))
        };
        let state = symbols(&apart, |_, name| name == "LSS_STATE")?;
        Ok(Self {
            module: module.map(in_module).transpose()?,
            state: (!is_node).then_some(state),
            program: if is_node { Some(flash(&builds.small(program))?) } else { None },
        })
    }
}

/// The total size of the symbols whose kind and name match.
fn symbols(bytes: &[u8], of: impl Fn(SymbolKind, &str) -> bool) -> elf::Result<u64> {
    let file = Elf::parse(bytes)?;
    let matching = file.symbols().filter(|symbol| {
        let name = symbol.name();
        name.is_ok_and(|name| of(symbol.kind(), name))
    });
    Ok(matching.map(|symbol| symbol.size()).sum())
}

/// The bytes loaded into flash: code, constants, and the initial values of RAM.
fn flash(bytes: &[u8]) -> elf::Result<u64> {
    let sections = elf::sections(&Elf::parse(bytes)?)?;
    Ok(sections.iter().filter(|section| section.is_loaded).map(|section| section.bytes).sum())
}
