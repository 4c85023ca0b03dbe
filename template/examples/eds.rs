//! `cargo eds`: writes the electronic data sheet of the product.

use std::{env, fs, io, path::PathBuf};

use @crate@::{application, device::{self, DEVICE}};
use testkit::eds::{DataSheet, Product};

fn main() -> io::Result<()> {
    let product = Product {
        file_name: "@name@.eds",
        vendor_name: device::VENDOR_NAME,
        description: device::DESCRIPTION,
        device: DEVICE,
    };
    let objects = application::Node::entries(&product.device);
    let sheet = DataSheet::new(product, objects, &application::Application::new());
    let folder = env::var_os("CARGO_MANIFEST_DIR").map(PathBuf::from).unwrap_or_default();
    fs::write(folder.join("@name@.eds"), sheet.eds())?;
    println!("@name@.eds");
    Ok(())
}
