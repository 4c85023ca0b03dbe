//! The Linux of `cargo verify linux`, made from Debian packages: a kernel, and an initramfs with everything else.

use std::{
    fs, io,
    os::unix::fs::{PermissionsExt, symlink},
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use anyhow::{Context, ensure};
use testkit::cargo::workspace;

use xtask::tool;

pub const QEMU: &str = "qemu-system-x86_64";
/// What Linux needs; apt adds their dependencies.
const PACKAGES: [&str; 7] = [
    "linux-image-amd64",
    "busybox-static",
    "bash",
    "can-utils",
    "iproute2",
    "python3-minimal",
    "libpython3-stdlib",
];
/// The files of the kernel's package that are used, without the modules for other hardware.
const OF_KERNEL: [&str; 2] = ["./boot/vmlinuz*", "*/net/can/*"];
const WHEELS: [&str; 2] = ["canopen", "python-can"];
/// The versions of `WHEELS`: those of the other sessions with python-canopen.
const VERSIONS: &str = "tests/clients/requirements.txt";

const INIT: &str = include_str!("init.sh");
/// The sessions, which run in the alphabetical order of their names.
const SESSIONS: [(&str, &str); 2] = [
    ("can-utils", include_str!("can-utils.sh")),
    ("python-canopen", include_str!("python-canopen.py")),
];

/// The directory with the files of the Linux.
pub struct System(PathBuf);

impl System {
    /// Makes the Linux, or finds the one that an earlier run has made from the same packages.
    ///
    /// # Errors
    /// A tool or a package is missing.
    pub fn prepare() -> anyhow::Result<Self> {
        tool::version(QEMU, "Debian: apt-get install qemu-system-x86")?;
        let system = Self(workspace().join("target/linux"));
        let made_of = format!("{PACKAGES:?} {}", fs::read_to_string(workspace().join(VERSIONS))?);
        let stamp = system.path("made-of");
        if fs::read_to_string(&stamp).is_ok_and(|known| known == made_of) {
            return Ok(system);
        }
        if system.0.exists() {
            fs::remove_dir_all(&system.0)?;
        }
        system.make()?;
        fs::write(stamp, made_of)?;
        Ok(system)
    }

    fn make(&self) -> anyhow::Result<()> {
        for (tool, package) in
            [("apt-get", "apt"), ("dpkg-deb", "dpkg"), ("tar", "tar"), ("python3", "python3-venv")]
        {
            tool::version(tool, &format!("Debian: apt-get install {package}"))?;
        }
        println!("downloading {} and what they need ...", PACKAGES.join(", "));
        self.download()?;
        println!("unpacking them ...");
        self.unpack()?;
        println!("adding {} ...", WHEELS.join(" and "));
        self.add_wheels()?;
        self.archive(&self.files(), &self.path("system.cpio"))
    }

    fn download(&self) -> anyhow::Result<()> {
        let packages = self.packages();
        fs::create_dir_all(packages.join("partial"))?;
        // As for an empty computer: the packages of this one are of no use to the Linux.
        tool::run(
            Command::new("apt-get")
                .args(["install", "--yes", "--quiet=2", "--download-only"])
                .args(["--no-install-recommends", "--option", "Dir::State::status=/dev/null"])
                .args(["--option", "Debug::NoLocking=1", "--option"])
                .arg(format!("Dir::Cache::archives={}", packages.display()))
                .args(PACKAGES)
                .stdout(Stdio::null()),
            "the packages cannot be downloaded (`apt-get update` renews the lists of packages; they are those of \
             Debian 12 or 13 on x86-64)",
        )
    }

    fn unpack(&self) -> anyhow::Result<()> {
        let files = self.files();
        for directory in ["bin", "sbin", "lib", "lib64"] {
            fs::create_dir_all(files.join("usr").join(directory))?;
            symlink(format!("usr/{directory}"), files.join(directory))?;
        }
        for entry in fs::read_dir(self.packages())? {
            let package = entry?.path();
            if package.extension().is_some_and(|ending| ending == "deb") {
                unpack(&package, &files)?;
            }
        }
        let boot = files.join("boot");
        let kernel = fs::read_dir(&boot)?.next().context("the package has a kernel")??.path();
        fs::rename(kernel, self.kernel())?;
        fs::remove_dir(boot)?;
        Ok(())
    }

    fn add_wheels(&self) -> anyhow::Result<()> {
        let venv = self.path("venv");
        tool::run(
            Command::new("python3").args(["-m", "venv"]).arg(&venv),
            "python3 cannot create a venv (Debian: apt-get install python3-venv)",
        )?;
        tool::run(
            Command::new(venv.join("bin/python"))
                .args(["-m", "pip", "install", "--quiet"])
                .args(["--disable-pip-version-check", "--target"])
                .arg(self.files().join("usr/lib/python3/dist-packages"))
                .arg("--constraint")
                .arg(workspace().join(VERSIONS))
                .args(WHEELS),
            "pip cannot download what the sessions need",
        )
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    fn packages(&self) -> PathBuf {
        self.path("packages")
    }

    /// The content of the packages.
    fn files(&self) -> PathBuf {
        self.path("files")
    }

    pub fn kernel(&self) -> PathBuf {
        self.path("kernel")
    }

    /// The initramfs that runs the sessions.
    pub fn with_sessions(&self) -> anyhow::Result<PathBuf> {
        let extra = self.extra("run-parts --exit-on-error /sessions")?;
        fs::copy(workspace().join("eds/lss-slave.eds"), extra.join("lss-slave.eds"))?;
        for (name, text) in SESSIONS {
            write_program(&extra.join("sessions").join(name), text)?;
        }
        self.initramfs(&extra)
    }

    /// The initramfs that runs a program of this computer.
    ///
    /// # Errors
    /// There is no such program.
    pub fn with_program(&self, program: &Path, arguments: &[String]) -> anyhow::Result<PathBuf> {
        let name = program.file_name().context("the program has no name")?.to_string_lossy();
        let ldd = Command::new("ldd").arg(program).output().context("cannot run ldd")?;
        let libraries = libraries(&String::from_utf8_lossy(&ldd.stdout));
        let mut command = vec![format!("/program/{name}")];
        // With the loader and the libraries of this computer, which may be newer than those of the Linux.
        if let Some(loader) = libraries.iter().find(|path| path.contains("/ld-linux")) {
            let loader = Path::new(loader).file_name().context("it is a file")?.to_string_lossy();
            let loader = format!("/program/{loader}");
            command.splice(..0, [loader, "--library-path".into(), "/program".into()]);
        }
        command.extend_from_slice(arguments);
        let words: Vec<String> = command.iter().map(|word| quoted(word)).collect();
        let extra = self.extra(&words.join(" "))?;
        let directory = extra.join("program");
        fs::create_dir_all(&directory)?;
        for file in libraries.iter().map(Path::new).chain([program]) {
            let name = file.file_name().context("it is a file")?;
            fs::copy(file, directory.join(name))
                .with_context(|| format!("cannot copy {}", file.display()))?;
        }
        self.initramfs(&extra)
    }

    /// A new directory for the files that are added to the Linux: at first those that run `command`.
    fn extra(&self, command: &str) -> anyhow::Result<PathBuf> {
        let extra = self.path("extra");
        if extra.exists() {
            fs::remove_dir_all(&extra)?;
        }
        write_program(&extra.join("init"), INIT)?;
        fs::write(extra.join("command"), command)?;
        Ok(extra)
    }

    /// The initramfs: that of the packages, followed by the files in `extra`. The kernel takes one after the other.
    fn initramfs(&self, extra: &Path) -> anyhow::Result<PathBuf> {
        let (added, all) = (self.path("extra.cpio"), self.path("initramfs"));
        self.archive(extra, &added)?;
        fs::copy(self.path("system.cpio"), &all)?;
        let mut end = fs::OpenOptions::new().append(true).open(&all)?;
        io::copy(&mut fs::File::open(added)?, &mut end)?;
        Ok(all)
    }

    /// Packs the files in `directory`.
    fn archive(&self, directory: &Path, archive: &Path) -> anyhow::Result<()> {
        let busybox = self.files().join("usr/bin/busybox");
        tool::run(
            Command::new(&busybox)
                .args(["sh", "-c", "\"$0\" find . | \"$0\" cpio -o -H newc -R 0:0 2>/dev/null"])
                .arg(&busybox)
                .current_dir(directory)
                .stdout(fs::File::create(archive)?),
            "busybox cannot pack the files",
        )
    }
}

fn unpack(package: &Path, files: &Path) -> anyhow::Result<()> {
    let name = package.file_name().unwrap_or_default().to_string_lossy();
    let is_kernel = name.starts_with("linux-image-") && !name.starts_with("linux-image-amd64");
    let mut content = Command::new("dpkg-deb")
        .arg("--fsys-tarfile")
        .arg(package)
        .stdout(Stdio::piped())
        .spawn()?;
    let mut tar = Command::new("tar");
    tar.args(["--extract", "--keep-directory-symlink", "--no-same-owner", "--directory"])
        .arg(files);
    if is_kernel {
        tar.arg("--wildcards").args(OF_KERNEL);
    } else {
        tar.arg("--exclude=./usr/share/*");
    }
    let tar = tar.stdin(content.stdout.take().context("it is piped")?).status()?;
    ensure!(tar.success() && content.wait()?.success(), "cannot unpack {name}");
    Ok(())
}

fn write_program(path: &Path, text: &str) -> anyhow::Result<()> {
    fs::create_dir_all(path.parent().context("it is in a directory")?)?;
    fs::write(path, text)?;
    fs::set_permissions(path, fs::Permissions::from_mode(0o755))?;
    Ok(())
}

/// The paths in the output of `ldd`.
fn libraries(ldd: &str) -> Vec<String> {
    ldd.split_whitespace().filter(|word| word.starts_with('/')).map(str::to_owned).collect()
}

/// A word for the shell.
fn quoted(word: &str) -> String {
    format!("'{}'", word.replace('\'', "'\\''"))
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_shell_takes_a_quoted_word_as_it_is() {
        assert_eq!(super::quoted("it's"), "'it'\\''s'");
    }
}
