//! A release whose program can be replaced over the bus: that of a product of `cargo xtask new-product --update`.

use std::{fs, process::Command};

use anyhow::Context;
use emulator::chip::Part;
use testkit::{cargo::workspace, product::Product, release};

use super::Arguments;
use crate::tool;

/// The name of the product, which must not be that of a library.
const NAME: &str = "lss-node";

/// Makes the product, and takes the files that its commands write.
pub fn write(chip: Part, arguments: &Arguments) -> anyhow::Result<()> {
    let product = workspace().join("target/products").join(format!("{NAME}-{}", chip.name()));
    let (git, folder) = (None, &*product);
    Product { name: NAME, chip, controller: 1, git, folder, has_update: true, is_signed: false }
        .write()?;
    let run = |command: &[&str]| {
        let mut cargo = Command::new("cargo");
        // What is built there already need not be built again, so it is built with the same settings.
        cargo.args(["--config", "profile.dev.package.\"*\".debug=false"]);
        cargo.args(command).env("CARGO_TARGET_DIR", workspace().join("target"));
        tool::run(cargo.current_dir(&product), "the product does not build")
    };
    let out = product.join("target/update");
    run(&["update-file", &out.display().to_string()])?;
    run(&["eds"])?;
    let sheet = format!("{NAME}.eds");
    fs::rename(product.join(&sheet), out.join(&sheet)).context("the data sheet")?;
    let mut files = Vec::new();
    for entry in fs::read_dir(&out)? {
        let path = entry?.path();
        let name = path.file_name().and_then(|name| name.to_str()).context("a name")?;
        files.push((name.to_owned(), fs::read(&path)?));
    }
    release::write(&arguments.folder(&format!("{}-update", chip.name())), files)
}
