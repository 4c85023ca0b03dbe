//! `cargo xtask eds`: the electronic data sheets and the page of the objects, from the tables of the firmware and of
//! the examples.

use std::fs;

use anyhow::Context;
use testkit::{cargo::workspace, eds::ours};

/// Write the electronic data sheets and docs/object-dictionary.md from the tables of the firmware
#[derive(clap::Args)]
pub struct Arguments {
    /// Only compare: fail if a file is not what the tables give
    #[arg(long)]
    check: bool,
}

/// Writes or compares the files.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if arguments.check {
        return ours::check();
    }
    for (name, content) in ours::files() {
        fs::write(workspace().join(name), content)
            .with_context(|| format!("cannot write {name}"))?;
        println!("{name}");
    }
    Ok(())
}
