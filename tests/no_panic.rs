//! The libraries cannot panic: a program that calls all of them links without a panic handler.

use std::{
    env,
    path::Path,
    process::{Command, Output},
};

/// Builds the program of `tests/no_panic` for the chip.
fn build(arguments: &[&str]) -> Output {
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/no_panic/Cargo.toml");
    let target_dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join("no_panic");
    Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
        .args(["build", "--release", "--locked", "--target", "thumbv7em-none-eabihf"])
        .arg("--manifest-path")
        .arg(manifest)
        .arg("--target-dir")
        .arg(target_dir)
        .args(arguments)
        // The flags of the test's own build do not apply to the chip.
        .env_remove("RUSTFLAGS")
        .env_remove("CARGO_ENCODED_RUSTFLAGS")
        .env_remove("CARGO_BUILD_TARGET")
        .output()
        .expect("cargo can be run")
}

#[test]
fn no_call_of_the_libraries_can_panic() {
    let output = build(&[]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn a_panic_is_detected() {
    let output = build(&["--features", "panic"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "it links with a panic");
    assert!(said.contains("the_library_can_panic"), "it fails for another reason: {said}");
}
