//! `cargo xtask eds`: the electronic data sheets and the page of the objects, from the tables of the firmware and of
//! its example.

use lss_slave_firmware::{application, describe, device, io};
use testkit::eds::{DataSheet, Product};

use crate::generated::write_or_check;

/// Write the electronic data sheets and docs/object-dictionary.md from the tables of the firmware
#[derive(clap::Args)]
pub struct Arguments {
    /// Only compare: fail if a file is not what the tables give
    #[arg(long)]
    check: bool,
}

/// Writes or compares the files.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let device = describe(0);
    let product = |file_name, description| Product {
        file_name,
        vendor_name: device::VENDOR_NAME,
        description,
        device,
    };
    let sheet = DataSheet::new(
        product("lss-slave.eds", device::DESCRIPTION),
        application::Node::entries(&device),
        &application::Application::new(),
    );
    let example = DataSheet::new(
        product("io.eds", io::DESCRIPTION),
        io::Node::entries(&device),
        &io::Application::new(),
    );
    let files = [
        ("eds/lss-slave.eds", sheet.eds()),
        ("docs/object-dictionary.md", sheet.page()),
        ("eds/io.eds", example.eds()),
    ];
    for (name, content) in files {
        write_or_check(name, &content, arguments.check, "cargo xtask eds")?;
    }
    Ok(())
}
