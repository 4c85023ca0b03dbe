//! The programs of `tests/peers/`, their builds for speed and for size, and their sizes in bytes.

use std::{
    fs,
    path::{Path, PathBuf},
};

use testkit::{
    cargo::{TARGET, cargo_for_the_chip, target_directory, workspace},
    elf::{self, Elf, Object, ObjectSymbol, SymbolKind},
};
use xtask::tool;

/// A slave in the harness.
pub struct Program {
    /// The name in the tables.
    pub title: &'static str,
    binary: &'static str,
    /// Whether it is a whole node, not LSS alone.
    pub is_node: bool,
    /// The module with LSS as names are mangled: the crate and the module, each preceded by its length. `None`: it is
    /// merged into the node even in a build of modules.
    module: Option<&'static str>,
}

const OURS: Option<&str> = Some("9lss_slave3lss");
const OF_CANOPEN_RS: Option<&str> = Some("10canopen_rs3lss");

/// All programs, this project's first.
pub const PROGRAMS: [Program; 6] = [
    Program { title: "canopen-node", binary: "node", is_node: true, module: OURS },
    Program {
        title: "canopen-node with an RPDO",
        binary: "node_with_rpdo",
        is_node: true,
        module: OURS,
    },
    Program { title: "lss-slave Slave alone", binary: "slave", is_node: false, module: OURS },
    Program {
        title: "canopen-rs 0.6.1 node",
        binary: "canopen_rs_node",
        is_node: true,
        module: OF_CANOPEN_RS,
    },
    Program {
        title: "canopen-rs LssSlave alone",
        binary: "canopen_rs_slave",
        is_node: false,
        module: OF_CANOPEN_RS,
    },
    Program { title: "zencan-node 0.0.5", binary: "zencan_node", is_node: true, module: None },
];

/// The directory of the built programs.
pub struct Builds(PathBuf);

impl Builds {
    /// Builds all programs: at opt-level 3, at opt-level s, and at opt-level s with crates that are not merged, so that
    /// functions stay separate.
    pub fn make() -> anyhow::Result<Self> {
        let builds = Self(target_directory().join("bench"));
        for profile in ["speed", "size", "module"] {
            cargo_build(profile, &builds.0)?;
        }
        Ok(builds)
    }

    /// The program at opt-level 3.
    pub fn fast(&self, program: &Program) -> PathBuf {
        self.path("speed", program)
    }

    /// The sizes of the module with LSS, of its state, and of the whole program in flash; `None`: not visible in this
    /// program.
    pub fn sizes(&self, program: &Program) -> anyhow::Result<[Option<u64>; 3]> {
        let apart = fs::read(self.path("module", program))?;
        let in_module = |module: &str| {
            symbols(&apart, |kind, name| kind == SymbolKind::Text && name.contains(module))
        };
        let state = symbols(&apart, |_, name| name == "LSS_STATE")?;
        let whole = flash(&fs::read(self.path("size", program))?)?;
        let module = program.module.map(in_module).transpose()?;
        Ok([module, (!program.is_node).then_some(state), program.is_node.then_some(whole)])
    }

    fn path(&self, profile: &str, program: &Program) -> PathBuf {
        self.0.join(TARGET).join(profile).join(program.binary)
    }
}

fn cargo_build(profile: &str, target_dir: &Path) -> anyhow::Result<()> {
    let mut cargo = cargo_for_the_chip(&workspace().join("tests/peers"), "build")?;
    cargo.args(["--locked", "--bins", "--profile", profile, "--target-dir"]).arg(target_dir);
    tool::run(&mut cargo, "tests/peers/ does not build")
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
