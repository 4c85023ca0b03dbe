//! The libraries cannot panic: a program that calls all of them links without a panic handler.

use std::process::Output;

use testkit::cargo::{cargo_for_the_chip, scratch, workspace};

/// Builds the program of `tests/no_panic` for the chip.
fn build(arguments: &[&str]) -> Output {
    let target_dir = scratch("no_panic");
    cargo_for_the_chip(workspace(), "build")
        .expect("the compiler has the library for the chip")
        .args(["--release", "--locked", "--manifest-path", "tests/no_panic/Cargo.toml"])
        .arg("--target-dir")
        .arg(target_dir)
        .args(arguments)
        .output()
        .expect("cargo can be run")
}

#[test]
fn no_call_of_the_libraries_can_panic() {
    let output = build(&[]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
#[ignore = "links once more: `.ci/run tools`"]
fn a_panic_is_detected() {
    let output = build(&["--features", "panic"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "it links with a panic");
    assert!(said.contains("the_library_can_panic"), "it fails for another reason: {said}");
}
