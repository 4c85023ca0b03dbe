//! Builds the workspace's firmware for a part, and suggests a remedy if that fails.

use std::{
    env, error, fmt,
    fs::{self, File},
    io,
    path::Path,
    process::{Command, Output, Stdio},
    sync::{OnceLock, mpsc},
    thread,
    time::Duration,
};

use emulator::{
    chip::Part,
    coverage::Coverage,
    image::{Image, ImageError},
};

/// The package of the plain firmware.
const FIRMWARE: &str = "firmware";
const TARGET: &str = "thumbv7em-none-eabihf";
/// The environment variable with the directory for records of the branches that all boards have taken.
pub const COVERAGE: &str = "LSS_SLAVE_COVERAGE";
/// The environment variable that runs the tests of the release image with the image of the example `io`.
pub const EXAMPLE: &str = "LSS_SLAVE_EXAMPLE";
/// The time after which a build prints a notice that it is running.
const PATIENCE: Duration = Duration::from_secs(3);

/// The reason for a failed build of the image.
#[derive(Debug)]
pub enum BuildError {
    /// `cargo` could not be run or failed: its message and a remedy.
    Cargo(String),
    /// The output of `cargo` is no image.
    Image(ImageError),
}

impl fmt::Display for BuildError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cargo(why) => write!(f, "the firmware does not build: {why}"),
            Self::Image(error) => error.fmt(f),
        }
    }
}

impl error::Error for BuildError {}

/// Whether the tests of the release image run with the example `io`, by the environment variable [`EXAMPLE`].
fn is_with_example() -> bool {
    env::var_os(EXAMPLE).is_some()
}

/// The chip that [`image`] is for: an STM32F405, or an STM32F407 with the example.
pub fn part() -> Part {
    if is_with_example() { Part::Stm32f407 } else { Part::Stm32f405 }
}

/// The release image, built once.
pub fn image() -> &'static Image {
    static IMAGE: OnceLock<Image> = OnceLock::new();
    if is_with_example() {
        return example();
    }
    IMAGE.get_or_init(|| build(part()).unwrap_or_else(|error| panic!("{error}")))
}

/// The release image with the example `io` for the STM32F407, built once.
pub fn example() -> &'static Image {
    static IMAGE: OnceLock<Image> = OnceLock::new();
    IMAGE.get_or_init(|| {
        build_example("io", Part::Stm32f407).unwrap_or_else(|error| panic!("{error}"))
    })
}

/// Builds the release firmware for `part` with the running `cargo`, and loads it.
///
/// # Errors
/// The message of `cargo`. A missing compilation target is first installed with `rustup`.
pub fn build(part: Part) -> Result<Image, BuildError> {
    build_package(FIRMWARE, part)
}

/// Builds the release firmware for `part` without bit-rate supervision.
///
/// # Errors
/// The same as for [`build`].
pub fn build_plain(part: Part) -> Result<Image, BuildError> {
    build_with(workspace(), part, || {
        let mut command = cargo_build(workspace(), FIRMWARE, part);
        command.args(["--features", "plain"]);
        command
    })
    .and_then(parse)
}

/// Builds the release image of an example for `part`: that in the folder `examples/` of this name.
///
/// # Errors
/// The same as for [`build`].
pub fn build_example(name: &str, part: Part) -> Result<Image, BuildError> {
    build_package(&format!("example-{name}"), part)
}

fn build_package(package: &str, part: Part) -> Result<Image, BuildError> {
    let elf = build_elf(package, part)?;
    let image = Image::from_elf(&elf).map_err(BuildError::Image)?;
    if let Some(directory) = env::var_os(COVERAGE) {
        let name = format!("{package}-{}", part.name());
        let coverage = coverage(Path::new(&directory), &name, &elf)
            .map_err(|error| BuildError::Cargo(format!("cannot record branches: {error}")))?;
        image.record(coverage);
    }
    Ok(image)
}

/// Builds the release firmware of a package of the workspace for `part`, and returns the ELF file.
///
/// # Errors
/// The same as for [`build`].
pub fn build_elf(package: &str, part: Part) -> Result<Vec<u8>, BuildError> {
    build_with(workspace(), part, || cargo_build(workspace(), package, part))
}

/// Builds the release firmware of a product for `part`: the program `name` of the package of that name in `directory`,
/// which `cargo xtask new-product` has made.
///
/// # Errors
/// The same as for [`build`].
pub fn build_product(directory: &str, name: &str, part: Part) -> Result<Image, BuildError> {
    let directory = Path::new(directory);
    build_with(directory, part, || cargo_build(directory, name, part)).and_then(parse)
}

/// Builds the release firmware for `part` for others: the ELF file. It does not depend on the `directory`, which holds the
/// workspace or a copy of it, nor on the folder of cargo's registry, which is `cargo_home` or the usual one.
///
/// # Errors
/// The same as for [`build`].
pub fn build_release(
    directory: &Path,
    cargo_home: Option<&Path>,
    part: Part,
) -> Result<Vec<u8>, BuildError> {
    let usual_home = || match env::var_os("CARGO_HOME") {
        Some(home) => Some(home.into()),
        None => env::home_dir().map(|home| home.join(".cargo")),
    };
    let home = cargo_home.map(Path::to_owned).or_else(usual_home);
    // The debug information and the locations of panics contain the paths of the sources.
    let new_names = [(Some(directory), "/lss-slave"), (home.as_deref(), "/cargo")];
    let new_names = new_names.into_iter().filter_map(|(path, name)| {
        path.map(|path| format!("--remap-path-prefix={}={name}", path.display()))
    });
    let flags = new_names.collect::<Vec<_>>().join("\u{1f}");
    build_with(directory, part, || {
        let mut command = cargo_build(directory, FIRMWARE, part);
        command
            .arg("--locked")
            .arg("--target-dir")
            .arg(directory.join("target"))
            .env("CARGO_ENCODED_RUSTFLAGS", &flags);
        if let Some(home) = cargo_home {
            command.env("CARGO_HOME", home);
        }
        command
    })
}

fn parse(elf: Vec<u8>) -> Result<Image, BuildError> {
    Image::from_elf(&elf).map_err(BuildError::Image)
}

/// Runs the command, which builds in `directory`, and returns the ELF file that it makes.
fn build_with(
    directory: &Path,
    part: Part,
    command: impl Fn() -> Command,
) -> Result<Vec<u8>, BuildError> {
    let _lock = lock(directory).map_err(|error| {
        BuildError::Cargo(format!("cannot wait for other builds of the firmware: {error}"))
    })?;
    let mut output = run_with_notice(&mut command(), part)?;
    if !output.status.success() && stderr(&output).contains("target may not be installed") {
        add_target()?;
        output = run_with_notice(&mut command(), part)?;
    }
    if !output.status.success() {
        return Err(BuildError::Cargo(format!("\n{}", stderr(&output).trim_end())));
    }
    let messages = String::from_utf8_lossy(&output.stdout);
    let path = executable(&messages).ok_or_else(|| {
        BuildError::Cargo("cargo reported no executable for the firmware".to_owned())
    })?;
    fs::read(&path).map_err(|error| BuildError::Image(ImageError::Io(path.into(), error)))
}

/// The record `name.branches` in the directory, beside the image `name.elf` that it belongs to.
fn coverage(directory: &Path, name: &str, image: &[u8]) -> io::Result<Coverage> {
    let (copy, record) =
        (directory.join(format!("{name}.elf")), directory.join(format!("{name}.branches")));
    if fs::read(&copy).ok().as_deref() != Some(image) {
        // It is not there, or belongs to another image.
        let _ = fs::remove_file(&record);
        fs::write(copy, image)?;
    }
    Ok(Coverage::new(record))
}

/// Waits until no other thread or process builds the firmware: all images of a target directory have one path.
fn lock(directory: &Path) -> io::Result<File> {
    let directory = directory.join("target");
    fs::create_dir_all(&directory)?;
    let file = File::create(directory.join("firmware.lock"))?;
    file.lock()?;
    Ok(file)
}

/// The folder of this repository.
pub fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("a workspace member")
}

/// The command that builds the program of a package, which has the same name.
fn cargo_build(directory: &Path, package: &str, part: Part) -> Command {
    let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    command
        .current_dir(directory)
        .args(["build", "--package", package, "--bin", package, "--release", "--target", TARGET])
        .args(["--features", part.name(), "--message-format", "json-render-diagnostics"])
        // The host build's settings are not meant for the firmware.
        .env_remove("RUSTFLAGS")
        .env_remove("CARGO_ENCODED_RUSTFLAGS")
        .env_remove("CARGO_BUILD_TARGET");
    command
}

fn run_with_notice(command: &mut Command, part: Part) -> Result<Output, BuildError> {
    let (done, waiting) = mpsc::channel::<()>();
    let notice = thread::spawn(move || {
        if waiting.recv_timeout(PATIENCE) == Err(mpsc::RecvTimeoutError::Timeout) {
            eprintln!("building the firmware for {} ...", part.name());
        }
    });
    let output = run(command);
    drop(done);
    notice.join().expect("the notice does not panic");
    output
}

fn add_target() -> Result<(), BuildError> {
    eprintln!("installing the compilation target {TARGET} ...");
    let output = run(Command::new("rustup").args(["target", "add", TARGET]));
    if output.is_ok_and(|output| output.status.success()) {
        return Ok(());
    }
    Err(BuildError::Cargo(format!(
        "the compilation target {TARGET} is missing. Install it with `rustup target add {TARGET}`"
    )))
}

fn run(command: &mut Command) -> Result<Output, BuildError> {
    command.stdin(Stdio::null()).output().map_err(|error| {
        BuildError::Cargo(format!("cannot run `{}`: {error}", command.get_program().display()))
    })
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The path in the last `"executable":"..."` of cargo's messages.
fn executable(messages: &str) -> Option<String> {
    let (_, rest) = messages.rsplit_once("\"executable\":\"")?;
    let (path, _) = rest.split_once('"')?;
    Some(path.replace("\\\\", "\\"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_executable_is_found_in_cargos_messages() {
        let messages =
            "{\"executable\":null}\n{\"executable\":\"C:\\\\t\\\\lss-slave\",\"fresh\":true}";
        assert_eq!(executable(messages).as_deref(), Some("C:\\t\\lss-slave"));
        assert_eq!(executable("{\"executable\":null}"), None);
    }
}
