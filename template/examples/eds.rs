//! `cargo eds`: writes the electronic data sheet of the product.

use std::{fs, io, path::Path};

use @crate@::{application, device::{self, DEVICE}};
use testkit::eds::{DataSheet, Product};

fn main() -> io::Result<()> {
    fs::write(Path::new(env!("CARGO_MANIFEST_DIR")).join("@name@.eds"), sheet())?;
    println!("@name@.eds");
    Ok(())
}

/// The data sheet.
pub fn sheet() -> String {
    let product = Product {
        file_name: "@name@.eds",
        vendor_name: device::VENDOR_NAME,
        description: device::DESCRIPTION,
        device: DEVICE,
    };
    let objects = application::Node::entries(&product.device);
    DataSheet::new(product, objects, &application::Application::new()).eds()
}
