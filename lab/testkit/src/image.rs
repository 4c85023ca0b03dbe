//! Builds the release images of the workspace and of products. Where this fails, `cargo` has said why.

use std::{
    fs::{self, File},
    io,
    path::Path,
    process::{Command, Stdio},
    sync::OnceLock,
};

use anyhow::{Context, bail, ensure};
use canopen_stm32f4::chip::Chip;
use emulator::{chip::Part, image::Image};

use crate::cargo::{cargo_for_the_chip, workspace};

/// The package of the plain firmware.
const FIRMWARE: &str = "firmware";
/// The usual chip of programs and boards. One chip for all of them saves the time to compile its registers again.
pub const PART: Part = Part::Stm32f407;

/// A firmware of this workspace whose release image is tested.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Firmware {
    /// The root package.
    Default,
    /// The same without bit-rate supervision.
    Plain,
    /// The example `io`.
    Io,
}

impl Firmware {
    /// The release image for [`PART`], built once.
    pub fn image(self) -> &'static Image {
        static IMAGES: [OnceLock<Image>; 3] = [const { OnceLock::new() }; 3];
        let build = || match self {
            Self::Default => build(PART),
            Self::Plain => build_plain(PART),
            Self::Io => build_example("io", PART),
        };
        IMAGES[self as usize].get_or_init(|| build().unwrap_or_else(|error| panic!("{error}")))
    }
}

/// The release image of the root package.
pub fn image() -> &'static Image {
    Firmware::Default.image()
}

/// The release image of the example `io`.
pub fn example() -> &'static Image {
    Firmware::Io.image()
}

/// Builds the release firmware for `part` with the running `cargo`, and loads it.
pub fn build(part: Part) -> anyhow::Result<Image> {
    build_package(FIRMWARE, part)
}

/// Builds the release firmware for `part` without bit-rate supervision.
pub fn build_plain(part: Part) -> anyhow::Result<Image> {
    build_firmware(part, &["--no-default-features"])
}

/// Builds the release firmware for a board of this name, which is a feature beside that of its chip.
pub fn build_board(name: &str, part: Part) -> anyhow::Result<Image> {
    build_firmware(part, &["--features", name])
}

fn build_firmware(part: Part, options: &[&str]) -> anyhow::Result<Image> {
    let elf = build_with(workspace(), FIRMWARE, part.name(), |command| {
        command.args(options);
    })?;
    Ok(Image::from_elf(&elf)?)
}

/// Builds the release image of an example for `part`: that in the folder `examples/` of this name.
pub fn build_example(name: &str, part: Part) -> anyhow::Result<Image> {
    build_package(&format!("example-{name}"), part)
}

fn build_package(package: &str, part: Part) -> anyhow::Result<Image> {
    Ok(Image::from_elf(&build_elf(package, part)?)?)
}

/// Builds the release firmware of a package of the workspace for `part`, and returns the ELF file.
pub fn build_elf(package: &str, part: Part) -> anyhow::Result<Vec<u8>> {
    build_with(workspace(), package, part.name(), |_| ())
}

/// The feature of a product that turns its program on; it names the chip.
pub(crate) const OF_PRODUCT: &str = "chip";

/// A product that `cargo xtask new-product` has made.
pub struct Product {
    pub part: Part,
    /// The CAN controller: 1 for CAN1.
    pub controller: u8,
    /// The release image.
    pub image: Image,
}

impl Product {
    /// Builds the program of the package `name` in `directory`.
    ///
    /// # Errors
    /// It does not build, its chip or its controller is not found, or no task serves the controller.
    pub fn build(directory: &str, name: &str) -> anyhow::Result<Self> {
        let directory = Path::new(directory);
        let (part, controller) = board_of(directory)?;
        let elf = build_with(directory, name, OF_PRODUCT, |_| ())?;
        Ok(Self { part, controller, image: Image::from_elf(&elf)? })
    }
}

/// The chip of a product in `Cargo.toml`, and its controller in `src/pins.rs`, to whose interrupts `src/main.rs` must bind,
/// and `src/loader.rs` if the product has one.
pub(crate) fn board_of(directory: &Path) -> anyhow::Result<(Part, u8)> {
    board_with(|path| {
        fs::read_to_string(directory.join(path)).with_context(|| format!("cannot read {path}"))
    })
}

pub(crate) fn board_with(
    read: impl Fn(&str) -> anyhow::Result<String>,
) -> anyhow::Result<(Part, u8)> {
    let manifest = read("Cargo.toml")?;
    let chip = Chip::of_manifest(&manifest);
    let chip = chip.context("the feature `chip` of Cargo.toml names no chip")?;
    let pins = read("src/pins.rs")?;
    let can = pins.split("type Can = pac::CAN").nth(1).and_then(|rest| rest.get(..1));
    let can = can.context("src/pins.rs has no `type Can = pac::CAN1`, or CAN2 or CAN3")?;
    let loader = Some("src/loader.rs").filter(|path| manifest.contains(path));
    for path in ["src/main.rs"].into_iter().chain(loader) {
        let program = read(path)?;
        for interrupt in ["RX0", "TX", "SCE"].map(|name| format!("CAN{can}_{name}")) {
            ensure!(
                program.contains(&format!("binds = {interrupt},")),
                "{path} binds no task to {interrupt}, an interrupt of CAN{can} in src/pins.rs"
            );
        }
    }
    let part = chip.feature.parse().map_err(anyhow::Error::msg)?;
    Ok((part, can.parse().context("the number of a CAN controller")?))
}

/// Builds the program of a package for others: the ELF file. It does not depend on the `directory`, which holds the package
/// or a copy of it, nor on the folder of cargo's registry, which is `cargo_home` or the usual one.
#[cfg(feature = "products")]
pub(crate) fn build_release(
    directory: &Path,
    package: &str,
    cargo_home: Option<&Path>,
    part: Part,
) -> anyhow::Result<Vec<u8>> {
    use std::env;

    let usual_home = || match env::var_os("CARGO_HOME") {
        Some(home) => Some(home.into()),
        None => env::home_dir().map(|home| home.join(".cargo")),
    };
    let home = cargo_home.map(Path::to_owned).or_else(usual_home);
    // The debug information and the locations of panics contain the paths of the sources.
    // Of several that fit the last one counts.
    let new_names = [
        (Some(workspace()), "/lss-slave"),
        (Some(directory), if package == FIRMWARE { "/lss-slave" } else { package }),
        (home.as_deref(), "/cargo"),
    ];
    let new_names = new_names.into_iter().filter_map(|(path, name)| {
        path.map(|path| format!("--remap-path-prefix={}={name}", path.display()))
    });
    let flags = new_names.collect::<Vec<_>>().join("\u{1f}");
    let feature = if package == FIRMWARE { part.name() } else { OF_PRODUCT };
    build_with(directory, package, feature, |command| {
        command.args(["--locked", "--target-dir"]).arg(directory.join("target"));
        command.env("CARGO_ENCODED_RUSTFLAGS", &flags);
        if let Some(home) = cargo_home {
            command.env("CARGO_HOME", home);
        }
    })
}

/// Builds the program of a package in `directory`, which has the same name, and returns the ELF file. `cargo` shows its
/// progress, unless `change` takes its messages for the error.
pub(crate) fn build_with(
    directory: &Path,
    package: &str,
    feature: &str,
    change: impl FnOnce(&mut Command),
) -> anyhow::Result<Vec<u8>> {
    build_bin(directory, [package; 2], feature, change)
}

/// Builds the loader of a product in `directory`, which has the name of its package, and returns the ELF file.
#[cfg(feature = "products")]
pub(crate) fn build_loader(
    directory: &Path,
    package: &str,
    change: impl FnOnce(&mut Command),
) -> anyhow::Result<Vec<u8>> {
    let bin = format!("{package}-loader");
    build_bin(directory, [package, &bin], OF_PRODUCT, |command| {
        // There is no room for a log. The level is built into this package. The loader gets a copy of its own, so that its
        // build and that of the program do not undo each other.
        command.env("DEFMT_LOG", "off").arg("--no-default-features");
        command.args(["--config", "profile.release.package.defmt-macros.codegen-units=1"]);
        // It has 32 KB. The packages of others stay as they are, since the program needs them too.
        for of_loader in [package, "canopen-node", "canopen-stm32f4", "lss-slave", "program-update"]
        {
            for option in ["opt-level=\"z\"", "overflow-checks=false"] {
                command
                    .arg("--config")
                    .arg(format!("profile.release.package.{of_loader}.{option}"));
            }
        }
        change(command);
    })
}

fn build_bin(
    directory: &Path,
    [package, bin]: [&str; 2],
    feature: &str,
    change: impl FnOnce(&mut Command),
) -> anyhow::Result<Vec<u8>> {
    let _lock = lock(directory).context("cannot wait for other builds of the firmware")?;
    let mut command = cargo_for_the_chip(directory, "build")?;
    command
        .args(["--package", package, "--bin", bin, "--release"])
        .args(["--features", feature, "--message-format", "json-render-diagnostics"])
        .stdin(Stdio::null())
        .stderr(Stdio::inherit());
    change(&mut command);
    let output = command.output().context("cannot run cargo")?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        bail!("the firmware does not build: {}", if said.is_empty() { "see above" } else { &said });
    }
    let messages = String::from_utf8_lossy(&output.stdout);
    let path = executable(&messages).context("cargo reported no executable for the firmware")?;
    fs::read(&path).with_context(|| format!("cannot read {path}"))
}

/// Waits until no other thread or process builds the firmware: all images of a target directory have one path.
fn lock(directory: &Path) -> io::Result<File> {
    let directory = directory.join("target");
    fs::create_dir_all(&directory)?;
    let file = File::create(directory.join("firmware.lock"))?;
    file.lock()?;
    Ok(file)
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
