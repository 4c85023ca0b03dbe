//! A folder for the files of a test.

use std::{fs, path::PathBuf};

use testkit::cargo;

/// A new folder for a test.
pub fn new_folder(name: &str) -> PathBuf {
    let path = cargo::scratch(name);
    // It exists if the test ran before.
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).expect("the folder can be made");
    path
}
