//! The list of programs in `bench/`, and their builds for speed and for size.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Stdio,
};

use anyhow::{Context, ensure};
use testkit::cargo::{TARGET, cargo_for_the_chip, target_directory, workspace};

/// A slave in the harness.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Program {
    /// This project's node.
    Node,
    /// This project's LSS slave alone.
    Slave,
    CanopenRsNode,
    CanopenRsSlave,
    ZencanNode,
}

impl Program {
    pub const ALL: [Self; 5] =
        [Self::Node, Self::Slave, Self::CanopenRsNode, Self::CanopenRsSlave, Self::ZencanNode];

    /// The name in the tables.
    pub const fn title(self) -> &'static str {
        match self {
            Self::Node => "lss-slave node",
            Self::Slave => "lss-slave Slave alone",
            Self::CanopenRsNode => "canopen-rs 0.6.1 node",
            Self::CanopenRsSlave => "canopen-rs LssSlave alone",
            Self::ZencanNode => "zencan-node 0.0.5",
        }
    }

    const fn binary(self) -> &'static str {
        match self {
            Self::Node => "node",
            Self::Slave => "slave",
            Self::CanopenRsNode => "canopen_rs_node",
            Self::CanopenRsSlave => "canopen_rs_slave",
            Self::ZencanNode => "zencan_node",
        }
    }
}

/// The directory of the built programs.
pub struct Builds(PathBuf);

impl Builds {
    /// The program at opt-level 3.
    pub fn fast(&self, program: Program) -> PathBuf {
        self.path("speed", program)
    }

    /// The program at opt-level s.
    pub fn small(&self, program: Program) -> Vec<u8> {
        self.read("size", program)
    }

    /// The program at opt-level s with crates that are not merged, so that its functions stay separate.
    pub fn in_modules(&self, program: Program) -> Vec<u8> {
        self.read("module", program)
    }

    fn path(&self, profile: &str, program: Program) -> PathBuf {
        self.0.join(TARGET).join(profile).join(program.binary())
    }

    fn read(&self, profile: &str, program: Program) -> Vec<u8> {
        let path = self.path(profile, program);
        fs::read(&path).unwrap_or_else(|error| panic!("{} was built: {error}", path.display()))
    }
}

/// Builds all programs with all profiles.
pub fn build() -> anyhow::Result<Builds> {
    let builds = Builds(target_directory().join("bench"));
    for profile in ["speed", "size", "module"] {
        cargo_build(profile, &builds.0)?;
    }
    Ok(builds)
}

fn cargo_build(profile: &str, target_dir: &Path) -> anyhow::Result<()> {
    let status = cargo_for_the_chip("build")
        .current_dir(workspace().join("bench"))
        .args(["--locked", "--bins", "--profile", profile])
        .arg("--target-dir")
        .arg(target_dir)
        .stdin(Stdio::null())
        .status()
        .context("cannot run cargo")?;
    ensure!(status.success(), "bench/ does not build: see above");
    Ok(())
}
