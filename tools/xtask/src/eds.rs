//! `cargo xtask eds`: the electronic data sheets and the page of the objects, from the tables of the firmware and of
//! the examples.

use std::fs;

use anyhow::{Context, ensure};
use example_io as io;
use example_thermo as thermo;
use firmware::{
    application,
    device::{self, DEVICE},
};
use testkit::{
    cargo::workspace,
    eds::{DataSheet, Product},
};

/// Write the electronic data sheets and docs/object-dictionary.md from the tables of the firmware
#[derive(clap::Args)]
pub struct Arguments {
    /// Only compare: fail if a file is not what the tables give
    #[arg(long)]
    check: bool,
}

/// Writes or compares the files.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let sheet = of_firmware();
    let io = DataSheet::new(
        Product {
            file_name: "io.eds",
            vendor_name: io::device::VENDOR_NAME,
            description: io::device::DESCRIPTION,
            device: io::device::DEVICE,
        },
        io::application::Node::entries(&io::device::DEVICE),
        &io::application::Application::new(),
    );
    let thermo = DataSheet::new(
        Product {
            file_name: "thermo.eds",
            vendor_name: thermo::device::VENDOR_NAME,
            description: thermo::device::DESCRIPTION,
            device: thermo::device::DEVICE,
        },
        thermo::application::Node::entries(&thermo::device::DEVICE),
        &thermo::application::Application::new(),
    );
    let files = [
        ("eds/lss-slave.eds", sheet.eds()),
        ("docs/object-dictionary.md", sheet.page()),
        ("eds/io.eds", io.eds()),
        ("eds/thermo.eds", thermo.eds()),
    ];
    for (name, content) in files {
        let path = workspace().join(name);
        if arguments.check {
            let found = fs::read_to_string(&path).with_context(|| format!("cannot read {name}"))?;
            let pairs = found.lines().zip(content.lines());
            let line = 1 + pairs.take_while(|(found, expected)| found == expected).count();
            ensure!(
                found == content,
                "{name} is not what the tables give, first in line {line}. Run `cargo xtask eds`"
            );
        } else {
            fs::write(&path, content).with_context(|| format!("cannot write {name}"))?;
            println!("{name}");
        }
    }
    Ok(())
}

/// The data sheet of the firmware.
pub fn of_firmware() -> DataSheet<'static> {
    DataSheet::new(
        Product {
            file_name: "lss-slave.eds",
            vendor_name: device::VENDOR_NAME,
            description: device::DESCRIPTION,
            device: DEVICE,
        },
        application::Node::entries(&DEVICE),
        &application::Application::new(),
    )
}
