//! The data sheets of this repository's products, and the page of the objects.

use std::fs;

use anyhow::{Context, ensure};
use example_io as io;
use firmware::{application, device};

use super::{DataSheet, Product};
use crate::cargo::workspace;

/// The files that the tables give: their paths and their content.
pub fn files() -> [(&'static str, String); 3] {
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
    let firmware = of_firmware();
    [
        ("eds/lss-slave.eds", firmware.eds()),
        ("docs/object-dictionary.md", firmware.page()),
        ("eds/io.eds", io.eds()),
    ]
}

/// The data sheet of the firmware.
pub fn of_firmware() -> DataSheet<'static> {
    DataSheet::new(
        Product {
            file_name: "lss-slave.eds",
            vendor_name: device::VENDOR_NAME,
            description: device::DESCRIPTION,
            device: device::DEVICE,
        },
        application::Node::entries(&device::DEVICE),
        &application::Application::new(),
    )
}

/// Compares the files with what the tables give.
///
/// # Errors
/// A file is not there, or differs: its name and the first line that differs.
pub fn check() -> anyhow::Result<()> {
    for (name, content) in files() {
        let found = fs::read_to_string(workspace().join(name))
            .with_context(|| format!("cannot read {name}"))?;
        let pairs = found.lines().zip(content.lines());
        let line = 1 + pairs.take_while(|(found, expected)| found == expected).count();
        ensure!(
            found == content,
            "{name} is not what the tables give, first in line {line}. Run `cargo xtask eds`"
        );
    }
    Ok(())
}
