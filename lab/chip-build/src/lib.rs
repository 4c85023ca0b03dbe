//! Builds programs for the chip: `cargo`, and the compiler's library for the chip.

use std::{
    env,
    ffi::OsString,
    fs::File,
    io::{self, Write},
    path::{Path, PathBuf},
    process::Command,
};

/// The compilation target of the chips.
pub const TARGET: &str = "thumbv7em-none-eabihf";

/// A command of the `cargo` that runs this program, in `directory`.
pub fn cargo(directory: &Path) -> Command {
    let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.current_dir(directory);
    command
}

/// The same for a program of the chip, without the settings of the host's build. The compiler's library for the chip is
/// there: if it was missing, rustup has added it.
///
/// # Errors
/// It is missing and cannot be added; the message says what to do.
pub fn cargo_for_the_chip(directory: &Path, command: &str) -> io::Result<Command> {
    let rustc = env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    Tools { rustc, rustup: "rustup".into(), directory }.add_target()?;
    let mut cargo = cargo(directory);
    for name in ["RUSTFLAGS", "CARGO_ENCODED_RUSTFLAGS", "CARGO_BUILD_TARGET"] {
        cargo.env_remove(name);
    }
    cargo.args([command, "--target", TARGET]);
    Ok(cargo)
}

/// The programs that know the compiler's libraries, run in a directory: its `rust-toolchain.toml` chooses the compiler.
struct Tools<'a> {
    rustc: OsString,
    rustup: OsString,
    directory: &'a Path,
}

impl Tools<'_> {
    /// Adds the compiler's library for the chip if it is missing.
    fn add_target(&self) -> io::Result<()> {
        let library = self.library()?;
        // Of two rustup at once, one fails. Where another user has made the file, this one goes without it.
        let lock = File::create(env::temp_dir().join("lss-slave-add-target.lock"));
        let _locked = lock.and_then(|file| file.lock().map(|()| file));
        if library.exists() {
            return Ok(());
        }
        // Not `eprintln!`, which a test keeps to itself.
        writeln!(
            io::stderr(),
            "The compiler lacks its library for the chip: rustup target add {TARGET}"
        )?;
        let mut rustup = Command::new(&self.rustup);
        rustup.args(["target", "add", TARGET]).env("RUST_BACKTRACE", "0");
        match rustup.current_dir(self.directory).output() {
            Ok(output) if output.status.success() => Ok(()),
            Ok(output) => Err(io::Error::other(format!(
                "rustup cannot add it, for which it needs the network once:\n{}",
                String::from_utf8_lossy(&output.stderr).trim_end()
            ))),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                Err(io::Error::other(format!(
                    "there is no rustup. Install it, see https://rustup.rs; or else what belongs into {}",
                    library.display()
                )))
            }
            Err(error) => Err(error),
        }
    }

    /// The folder of the compiler's library for the chip.
    fn library(&self) -> io::Result<PathBuf> {
        let mut rustc = Command::new(&self.rustc);
        rustc.args(["--print", "target-libdir", "--target", TARGET]).current_dir(self.directory);
        let output = rustc.output()?;
        if !output.status.success() {
            return Err(io::Error::other(String::from_utf8_lossy(&output.stderr).into_owned()));
        }
        Ok(PathBuf::from(String::from_utf8_lossy(&output.stdout).trim_end()))
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::{
        fs,
        os::unix::fs::PermissionsExt,
        process,
        sync::{Mutex, MutexGuard, PoisonError},
        thread,
    };

    use super::*;

    /// A compiler without the library for the chip, and a rustup that runs this script.
    struct Machine {
        folder: PathBuf,
        /// A script that is being written when another test starts a program cannot be run.
        _alone: MutexGuard<'static, ()>,
    }

    impl Machine {
        fn new(name: &str, rustup: &str) -> Self {
            static ALONE: Mutex<()> = Mutex::new(());
            let alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
            let folder = env::temp_dir().join(format!("chip-build-{}-{name}", process::id()));
            fs::create_dir_all(&folder).expect("a new folder");
            let library = folder.join("lib/rustlib").join(TARGET).join("lib");
            let script = |name: &str, lines: &str| {
                let path = folder.join(name);
                fs::write(&path, format!("#!/bin/sh\n{lines}\n")).expect("a new file");
                fs::set_permissions(&path, PermissionsExt::from_mode(0o755)).expect("it is ours");
            };
            script("rustc", &format!("echo {}", library.display()));
            script("rustup", rustup);
            Self { folder, _alone: alone }
        }

        fn add_target(&self, rustup: &str) -> Result<(), String> {
            let [rustc, rustup] = ["rustc", rustup].map(|name| self.folder.join(name).into());
            let tools = Tools { rustc, rustup, directory: &self.folder };
            tools.add_target().map_err(|error| error.to_string())
        }

        fn calls_of_rustup(&self) -> usize {
            fs::read_to_string(self.folder.join("calls")).unwrap_or_default().lines().count()
        }
    }

    impl Drop for Machine {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.folder);
        }
    }

    #[test]
    fn builds_at_the_same_time_add_the_target_once() {
        // As rustup's, this work cannot be done twice at once; it takes a while.
        let rustup = "echo $@ >> calls; mkdir busy || exit 1; sleep 0.2; mkdir -p lib/rustlib/$3/lib; rmdir busy";
        let machine = Machine::new("at-once", rustup);
        thread::scope(|scope| {
            let builds: Vec<_> =
                (0..4).map(|_| scope.spawn(|| machine.add_target("rustup"))).collect();
            for build in builds {
                assert_eq!(build.join().expect("no panic"), Ok(()));
            }
        });
        assert_eq!(machine.calls_of_rustup(), 1);
    }

    #[test]
    fn a_machine_without_rustup_is_told_what_to_do() {
        let machine = Machine::new("no-rustup", "");
        let error = machine.add_target("no-such-rustup").expect_err("nobody adds it");
        assert!(
            error.contains(
                "no rustup. Install it, see https://rustup.rs; or else what belongs into /"
            ),
            "{error}"
        );
    }

    #[test]
    fn what_rustup_says_without_a_network_is_shown() {
        let machine = Machine::new("offline", "echo error: no network >&2; exit 1");
        let error = machine.add_target("rustup").expect_err("rustup fails");
        assert!(error.contains("needs the network once:\nerror: no network"), "{error}");
    }
}
