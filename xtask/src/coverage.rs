//! `cargo xtask coverage`: the branches of the release image that its tests have taken.

mod program;
mod thumb;

use std::path::Path;

use emulator::coverage::Record;

/// TODO
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {}

pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    for name in ["stm32f405", "stm32f407-io"] {
        let directory = workspace.join("target/coverage");
        let program = program::Program::load(&directory.join(format!("{name}.elf")), workspace)?;
        let record = Record::read(&directory.join(format!("{name}.branches")))?;
        println!(
            "{name}: {} instructions, {} branches",
            program.instructions.len(),
            program.branches.len()
        );
        for branch in &program.branches {
            let place = &program.instructions[&branch.address];
            let missing: Vec<_> =
                branch.outcomes(&record).into_iter().filter(|o| !o.was_seen).collect();
            if missing.is_empty() {
                continue;
            }
            println!(
                "{} {}:{} {} {:08x} {}: {}",
                if place.is_ours { "OUR" } else { "DEP" },
                place.file,
                place.line,
                place.function,
                branch.address,
                branch.mnemonic(),
                missing
                    .iter()
                    .map(|o| format!(
                        "never {} {}",
                        o.name,
                        o.target
                            .and_then(|t| program.instructions.get(&t))
                            .map_or(String::new(), |p| format!("{}:{}", p.file, p.line))
                    ))
                    .collect::<Vec<_>>()
                    .join(", ")
            );
        }
    }
    let _ = arguments;
    Ok(())
}
