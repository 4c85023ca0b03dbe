//! The running `cargo`, in the workspace or for a product.

use std::{
    env,
    path::{Path, PathBuf},
    process::Command,
};

/// The compilation target of the chips.
pub const TARGET: &str = "thumbv7em-none-eabihf";

/// The directory of the workspace.
pub fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("a workspace member")
}

/// Cargo's target directory: this program is in its `debug`.
pub fn target_directory() -> PathBuf {
    let own = env::current_exe().expect("the path of this program is known");
    own.ancestors().nth(2).expect("it is in a target directory").to_owned()
}

/// A command of the `cargo` that runs this program, in the workspace.
pub fn cargo() -> Command {
    let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.current_dir(workspace());
    command
}

/// The same for a program of the chip, without the settings of the host's build.
pub fn cargo_for_the_chip(command: &str) -> Command {
    let mut cargo = cargo();
    for name in ["RUSTFLAGS", "CARGO_ENCODED_RUSTFLAGS", "CARGO_BUILD_TARGET"] {
        cargo.env_remove(name);
    }
    cargo.args([command, "--target", TARGET]);
    cargo
}
