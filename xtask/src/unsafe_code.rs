//! `cargo xtask unsafe-code`: docs/unsafe.md, the list of all code that the compiler does not check, with the argument
//! that is written beside it.

mod scan;

use std::fmt::Write;

use anyhow::bail;

use crate::{generated::write_or_check, sources};
use scan::{Item, items};

const HEAD: &str = "# Unsafe code

Every `unsafe` in the repository, with the argument written beside it. `cargo xtask unsafe-code` makes this page from
the sources and refuses an item without an argument; CI checks that it is up to date. The library has none: it forbids
`unsafe` (`lss-slave/src/lib.rs`). Most of that of the firmware also runs under Miri:
[extended test runs](testing.md#unsafe-code-under-miri).
";

/// The parts of the repository with unsafe code: the beginning of a path, and a heading.
const PARTS: [(&str, &str); 6] = [
    ("src/", "The firmware"),
    ("tests/drivers/", "The drivers over plain memory"),
    ("tests/no_panic/", "The proof that the library cannot panic"),
    ("qemu/", "The bridge to QEMU"),
    ("bench/", "The comparison with other slaves"),
    ("emulator/foreign/", "The programs on drivers of others"),
];

/// Write docs/unsafe.md, the list of all unsafe code with its arguments
#[derive(clap::Args)]
pub struct Arguments {
    /// Only compare: fail if the page is not what the sources give
    #[arg(long)]
    check: bool,
}

/// Writes or compares the page.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let mut parts = PARTS.map(|(start, heading)| (start, heading, Vec::new()));
    let mut faults = Vec::new();
    for source in sources::all()? {
        for item in items(&source) {
            let place = format!("{}:{}", source.path, item.line);
            if item.argument.is_empty() {
                faults.push(format!("{place}: `{}` has no argument", item.kind));
            }
            match parts.iter_mut().find(|(start, ..)| source.path.starts_with(start)) {
                Some((.., found)) => found.push((source.path.clone(), item)),
                None => faults.push(format!("{place}: there is no unsafe code in this part")),
            }
        }
    }
    if !faults.is_empty() {
        bail!("unsafe code:\n{}", faults.join("\n"));
    }
    let mut page = HEAD.to_owned();
    for (_, heading, items) in parts {
        write!(page, "\n## {heading}\n\n| file | in | what | argument |\n|---|---|---|---|\n")?;
        for (path, Item { kind, owner, argument, .. }) in items {
            let owner = if owner.is_empty() { owner } else { format!("`{owner}`") };
            writeln!(page, "| `{path}` | {owner} | `{kind}` | {argument} |")?;
        }
    }
    write_or_check("docs/unsafe.md", &page, arguments.check, "cargo xtask unsafe-code")
}
