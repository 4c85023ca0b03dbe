//! What is different in a product whose program can be replaced over the bus: `cargo xtask new-product --update`.

use std::io;

use super::{Change, change};

/// `cargo update-file`, with the gaps of a template.
pub(super) const UPDATE_FILE: &str = "examples/update_file.rs";

/// `cargo release-files`.
const RELEASE_FILES: &str = "examples/release_files.rs";

/// The files in the template and in the product.
pub(super) const FILES: [(&str, &str); 2] = [
    ("template/update/loader.rs", "src/loader.rs"),
    ("template/update/update_file.rs", UPDATE_FILE),
];

/// The file with the key of a loader that takes only signed programs.
pub(super) const KEY: (&str, &str) = ("template/update/key.rs", "src/key.rs");

/// The changes of the files of a product.
pub(super) const CHANGES: &[Change<'_>] = &[
    (
        ".cargo/config.toml",
        "release-files = \"run --quiet --example release_files --\"\n",
        "update-file = \"run --quiet --example update_file --\"\n",
    ),
    (
        "README.md",
        "| `cargo release-files` | writes `.hex`, `.bin`, `.elf`, data sheet, size and checksums into `target/release-files`, \
         for those who put it on boards without Rust |",
        "| `cargo update-file` | writes loader, program and update file into `target/update`; `lss update` of the firmware's \
         repository installs it over the bus |",
    ),
    (
        "tests/board.rs",
        "Product::build(&directory, env!(\"CARGO_PKG_NAME\"))",
        "testkit::update::build_product(&directory, env!(\"CARGO_PKG_NAME\"), &DEVICE)",
    ),
    ("ci.sh", "cargo eds\n", "cargo eds\ncargo update-file\n"),
    (
        "ci.sh",
        "$CARGO_TARGET_DIR/thumbv7em-none-eabihf/release/@name@",
        "$product/target/update/factory.hex",
    ),
    ("memory.x", "boards/stm32f4/image.x", "boards/stm32f4/program.x"),
    ("memory.x", "INCLUDE image.x", "INCLUDE program.x"),
    ("Cargo.toml", "canopen-stm32f4 = { ", "canopen-stm32f4 = { features = [\"update\"], "),
    (
        "Cargo.toml",
        "[[bin]]\nname = \"flash\"",
        "[[bin]]\nname = \"@name@-loader\"\npath = \"src/loader.rs\"\nrequired-features = [\"chip\"]\n\
         test = false\nbench = false\ndoc = false\n\n[[bin]]\nname = \"flash\"",
    ),
    (
        "build.rs",
        "\"--icf=all\", \"-Tlink.x\", \"-Tdefmt.x\"] {\n            println!(\"cargo::rustc-link-arg-bins={arg}\");\n        }\n",
        "\"--icf=all\"] {\n            println!(\"cargo::rustc-link-arg-bins={arg}\");\n        }\n        \
         for arg in [\"-Tlink.x\", \"-Tdefmt.x\"] {\n            \
         println!(\"cargo::rustc-link-arg-bin=@name@={arg}\");\n        }\n        \
         println!(\"cargo::rustc-link-arg-bin=@name@-loader=-Tloader.x\");\n",
    ),
    (
        "src/application.rs",
        "use canopen_node::objects;",
        "use canopen_node::{Program, objects};\nuse canopen_stm32f4::update::Update;",
    ),
    (
        "src/application.rs",
        "values Value;\n",
        "values Value;\n\n    /// What program control does.\n    private update: Update = Update::new();\n",
    ),
    (
        "src/application.rs",
        "impl canopen_node::Application for Application {}",
        "impl canopen_node::Application for Application {\n    const PROGRAM_DOWNLOAD: bool = true;\n\n    \
         fn program(&mut self) -> Option<&mut dyn Program> {\n        Some(&mut self.update)\n    }\n}\n\n\
         impl Application {\n    /// What program control does.\n    \
         pub const fn update(&mut self) -> &mut Update {\n        &mut self.update\n    }\n}",
    ),
    ("src/main.rs", "board, watchdog::Task}", "board, update::{Confirm, Steps}, watchdog::Task}"),
    (
        "src/main.rs",
        "        watchdog: Watchdog,\n    }",
        "        steps: Steps,\n        watchdog: Watchdog,\n    }",
    ),
    ("src/main.rs", "let (runner, storage", "let (mut runner, storage"),
    (
        "src/main.rs",
        "        (Shared { runner }, Local { indicators: pins.indicators, storage, watchdog })",
        "        let confirm = Confirm::ByItself;\n        \
         let steps = runner.application(|application| application.update().begin(confirm));\n        \
         (Shared { runner }, Local { indicators: pins.indicators, storage, steps, watchdog })",
    ),
    ("src/main.rs", "local = [storage], shared", "local = [storage, steps], shared"),
    (
        "src/main.rs",
        "        cx.local.storage.store(&mut cx.shared.runner);\n",
        "        cx.local.storage.store(&mut cx.shared.runner);\n        \
         cx.local.steps.step(&mut cx.shared.runner, Application::update);\n",
    ),
];

/// The further changes of a product whose loader takes only signed programs.
const CHANGES_IF_SIGNED: &[Change<'_>] = &[
    ("Cargo.toml", "features = [\"update\"]", "features = [\"signed\"]"),
    (
        ".cargo/config.toml",
        "runner = \"probe-rs",
        "# SHA-512 in 3 KB instead of 26 KB.\nrustflags = [\"--cfg\", \"sha2_backend_soft=\\\"compact\\\"\"]\nrunner = \"probe-rs",
    ),
    (
        "ci.sh",
        "cargo update-file\n",
        "cargo update-file --key \"${KEY:?is the file of the private key}\"\n",
    ),
    ("src/loader.rs", "mod pins;", "mod key;\nmod pins;"),
    ("src/loader.rs", "loader::{self, Place", "loader::{self, Author, Place"),
    (
        "src/loader.rs",
        "    use crate::pins::{Can, Pins};\n",
        "    use crate::{\n        key::{DOWNGRADE, KEY},\n        pins::{Can, Pins},\n    };\n",
    ),
    (
        "src/loader.rs",
        "    #[shared]\n",
        "    const AUTHOR: Author = Author::new(KEY, DOWNGRADE);\n\n    #[shared]\n",
    ),
    ("src/loader.rs", "chip.CAN1, pins.can)", "chip.CAN1, pins.can, &AUTHOR)"),
    (
        UPDATE_FILE,
        "fn main()",
        "#[allow(dead_code, reason = \"the loader has the rest\")]\n#[path = \"../src/key.rs\"]\nmod key;\n\nfn main()",
    ),
    (UPDATE_FILE, "let loader_key = None;", "let loader_key = Some(&key::KEY);"),
];

/// Adds the loader to the files of a product, and makes the changes.
pub(super) fn add(
    files: &mut Vec<(&'static str, String)>,
    is_signed: bool,
    read: impl Fn(&str) -> io::Result<String>,
) -> io::Result<()> {
    change(files, CHANGES)?;
    // Its files are those of `cargo update-file`.
    files.retain(|(path, _)| *path != RELEASE_FILES);
    for (template, path) in FILES {
        files.push((path, read(template)?));
    }
    if is_signed {
        files.push((KEY.1, read(KEY.0)?));
        change(files, CHANGES_IF_SIGNED)?;
    }
    Ok(())
}
