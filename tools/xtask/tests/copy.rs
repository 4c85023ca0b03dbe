//! The commands in a copy of the repository that was made together with what is built: cargo does not build them again.

use std::{
    env, fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use testkit::cargo::{program, scratch, workspace};

/// What the commands of these tests need of the repository.
const SOURCES: [&str; 7] =
    ["Cargo.lock", "docs", "eds", "rust-toolchain.toml", "rustfmt.toml", "src", "template"];

/// A copy of the repository in a new folder of its own, with the program `xtask`.
fn copy(folder: &str) -> PathBuf {
    let folder = scratch(folder);
    let _ = fs::remove_dir_all(&folder);
    let copy = folder.join("lss-slave");
    fs::create_dir_all(copy.join("target/debug")).expect("a new folder");
    for source in SOURCES {
        copy_all(&workspace().join(source), &copy.join(source));
    }
    let program = program("xtask");
    fs::hard_link(program.get_program(), copy.join("target/debug/xtask")).expect("a new file");
    copy
}

fn copy_all(from: &Path, to: &Path) {
    if from.is_dir() {
        fs::create_dir_all(to).expect("a new folder");
        for entry in fs::read_dir(from).expect("a folder") {
            let name = entry.expect("an entry").file_name();
            copy_all(&from.join(&name), &to.join(&name));
        }
    } else {
        fs::copy(from, to).expect("a file");
    }
}

/// `cargo xtask` in the copy.
fn xtask(copy: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(copy.join("target/debug/xtask"));
    command.current_dir(copy).env("CARGO_MANIFEST_DIR", copy.join("xtask"));
    command.args(arguments).output().expect("it runs")
}

#[track_caller]
fn assert_finds_the_change(output: &Output) {
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(error.contains("eds/io.eds is not what the tables give"), "{error}");
}

#[test]
fn a_command_in_a_copy_reads_the_copy() {
    let copy = copy("copy-read");
    fs::write(copy.join("eds/io.eds"), "changed").expect("it is there");
    assert_finds_the_change(&xtask(&copy, &["eds", "--check"]));
}

#[test]
fn a_command_that_cargo_does_not_run_reads_its_own_copy() {
    let copy = copy("copy-alone");
    fs::write(copy.join("eds/io.eds"), "changed").expect("it is there");
    let mut command = Command::new(copy.join("target/debug/xtask"));
    command.current_dir(env::temp_dir()).env_remove("CARGO_MANIFEST_DIR");
    assert_finds_the_change(&command.args(["eds", "--check"]).output().expect("it runs"));
}

#[test]
fn a_product_of_a_copy_lies_beside_it_and_depends_on_it() {
    let copy = copy("copy-product");
    let output = xtask(&copy, &["new-product", "lamp"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let manifest = fs::read_to_string(copy.with_file_name("lamp/Cargo.toml"));
    let manifest = manifest.expect("a product beside the copy");
    assert!(manifest.contains("path = \"../lss-slave/libs/canopen-node\""), "{manifest}");
}
