//! The running `cargo`, in the workspace.

use std::{
    env, fs,
    path::{Path, PathBuf},
    process::Command,
    sync::LazyLock,
};

pub use chip_build::{TARGET, cargo_for_the_chip};

/// The directory of the workspace that this program works in, which may be a copy of the one it was built in: the first
/// around the package that cargo runs, the current directory, or this program.
///
/// # Panics
/// There is none.
pub fn workspace() -> &'static Path {
    static WORKSPACE: LazyLock<PathBuf> = LazyLock::new(|| {
        let package = env::var_os("CARGO_MANIFEST_DIR").map(PathBuf::from);
        let places = package.into_iter().chain(env::current_dir()).chain(env::current_exe());
        let around = |place: PathBuf| {
            place
                .ancestors()
                .find(|folder| folder.join("template/Cargo.toml").is_file())
                .map(Path::to_owned)
        };
        places.into_iter().find_map(around).expect("run this in the folder of lss-slave")
    });
    &WORKSPACE
}

/// The directory of this program, or of the programs beside this test or example: `debug` in cargo's target directory.
fn profile_directory() -> PathBuf {
    let own = env::current_exe().expect("the path of this program is known");
    let mut folders = own.ancestors().skip(1);
    let is_profile = |folder: &&Path| !folder.ends_with("deps") && !folder.ends_with("examples");
    folders.find(is_profile).expect("it is in a folder").to_owned()
}

/// Cargo's target directory.
pub fn target_directory() -> PathBuf {
    profile_directory().parent().expect("it is in a target directory").to_owned()
}

/// The program of this name of the package under test.
pub fn program(name: &str) -> Command {
    Command::new(profile_directory().join(name))
}

/// A path in the folder for the files of tests, which is there.
pub fn scratch(name: &str) -> PathBuf {
    let folder = target_directory().join("tmp");
    fs::create_dir_all(&folder).expect("the target directory can be written");
    folder.join(name)
}

/// A command of the `cargo` that runs this program, in the workspace.
pub fn cargo() -> Command {
    chip_build::cargo(workspace())
}
