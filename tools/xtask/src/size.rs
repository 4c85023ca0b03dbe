//! `cargo xtask size`: the flash and RAM of the firmware by part, compared with the budget in `size-budget.toml`.

use std::collections::BTreeMap;

use anyhow::bail;
use emulator::chip::Part;
use testkit::{
    elf::{self, Elf, Object, ObjectSymbol, Section, SymbolKind, sections},
    image,
};

use crate::example::Example;

/// Show the firmware's memory use, and check it against the budget
///
/// Fails if the flash takes more than tools/xtask/size-budget.toml allows.
#[derive(clap::Args)]
pub struct Arguments {
    /// The chip to build for
    #[arg(long, default_value = testkit::image::PART.name())]
    chip: Part,
    /// Show an example of a product, which has no budget
    #[arg(long)]
    example: Option<Example>,
}

/// Prints the sizes. Fails if they are above the budget.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let elf = image::build_elf(&Example::package(arguments.example), arguments.chip)?;
    let has_budget = arguments.example.is_none();
    let (report, flash) = report(&elf, arguments.chip, has_budget)?;
    print!("{report}");
    let budget = budget();
    if has_budget && flash > budget {
        bail!(
            "the firmware takes {} bytes more flash than tools/xtask/size-budget.toml allows",
            flash - budget
        );
    }
    Ok(())
}

/// The table of the sizes of an ELF file, and the flash that it takes in bytes.
fn report(elf: &[u8], chip: Part, has_budget: bool) -> anyhow::Result<(String, u64)> {
    let file = Elf::parse(elf)?;
    let sections = sections(&file)?;
    let (mut report, flash) = elf::size(elf, chip)?;
    if has_budget {
        report += &format!("{:16} {:>8}\n", "budget", budget());
    }
    report += &format!("\n{:28} {:>8}\n", "flash by part", "bytes");
    for (part, bytes) in parts(&file, &sections).into_iter().filter(|(_, bytes)| *bytes > 0) {
        report += &format!("{part:28} {bytes:>8}\n");
    }
    report += &format!("{:28} {flash:>8}\n", "total");
    Ok((report, flash))
}

/// The part that a function belongs to, by text in its name; the first match counts. Inlined code counts as its
/// caller's.
const PARTS: [(&str, &[&str]); 14] = [
    ("tasks", &["_RX0", "_TX", "_SCE", "TIM2", "TIM5", "RCC", "::app::idle"]),
    (
        "application",
        &["firmware::application", "example_", "canopen_node::application", "stm32f4xx_hal::adc"],
    ),
    ("start and clocks", &["::app::", "canopen_stm32f4::board", "canopen_stm32f4::clock", "::__"]),
    ("process data", &["canopen_node::pdo", "canopen_node::sync", "canopen_node::node::process"]),
    (
        "SDO",
        &["canopen_node::sdo", "canopen_node::object_dictionary", "canopen_node::node::objects"],
    ),
    ("LSS", &["lss_slave::lss"]),
    ("bit rate", &["lss_slave::bit_rate"]),
    ("settings log", &["lss_slave::settings"]),
    ("flash driver", &["canopen_stm32f4::flash"]),
    ("CAN driver", &["canopen_stm32f4::can", "bxcan"]),
    ("node", &["canopen_node::", "lss_slave::", "canopen_stm32f4::"]),
    ("defmt", &["defmt"]),
    ("panic text", &["core::", "rust_begin_unwind"]),
    ("compiler's memory functions", &["mem"]),
];

/// The parts of the flash content with their sizes in bytes, which add up to the total.
fn parts(file: &Elf, sections: &[Section]) -> Vec<(&'static str, u64)> {
    let bytes_of = |name: &str| -> u64 {
        sections.iter().filter(|section| section.name == name).map(|section| section.bytes).sum()
    };
    // A function may have several names.
    let functions: BTreeMap<u64, (u64, String)> = file
        .symbols()
        .filter(|symbol| symbol.kind() == SymbolKind::Text && symbol.size() > 0)
        .filter_map(|symbol| {
            let name = format!("{:#}", rustc_demangle::demangle(symbol.name().ok()?));
            Some((symbol.address(), (symbol.size(), name)))
        })
        .collect();
    let mut parts = PARTS.map(|(part, _)| (part, 0));
    let mut rest = bytes_of(".text");
    for (bytes, name) in functions.values() {
        let fits = |(_, words): &(_, &[&str])| words.iter().any(|word| name.contains(word));
        if let Some(part) = PARTS.iter().position(fits) {
            parts[part].1 += bytes;
            rest -= bytes;
        }
    }
    let of_sections = sections.iter().filter(|section| section.is_in_flash());
    let other_sections: u64 = of_sections
        .filter(|section| ![".vector_table", ".text", ".rodata", ".data"].contains(&&*section.name))
        .map(|section| section.bytes)
        .sum();
    let mut all = vec![("vector table", bytes_of(".vector_table"))];
    all.extend(parts);
    all.push(("constants", bytes_of(".rodata")));
    all.push(("initial values of RAM", bytes_of(".data")));
    all.push(("other", rest + other_sections));
    all
}

/// The flash budget in bytes.
fn budget() -> u64 {
    let budget: toml::Table =
        include_str!("../size-budget.toml").parse().expect("size-budget.toml is TOML");
    let flash = budget["flash"].as_integer().expect("size-budget.toml gives flash in bytes");
    flash.try_into().expect("the budget is not negative")
}
