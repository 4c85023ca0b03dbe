//! A folder for the files of a test.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// A new folder for a test.
pub fn new_folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    // It exists if the test ran before.
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).expect("the folder can be made");
    path
}
