//! Products made from the folder `template/`: those of `cargo xtask new-product`, and for tests on other controllers.

mod update;

use std::{
    fs, io, mem,
    path::{Component, Path, PathBuf},
    process::{Command, Stdio},
};

use canopen_stm32f4::chip::Chip;
use emulator::{chip::Part, image::Image};

use crate::{
    cargo::workspace,
    image::{self, OF_PRODUCT},
};

/// The files that the product shares with this repository.
const COPIES: [&str; 3] = ["Cargo.lock", "rust-toolchain.toml", "rustfmt.toml"];

/// The files that are those of the firmware in other words.
const OF_FIRMWARE: [&str; 4] = ["src/device.rs", "src/lib.rs", "src/main.rs", "src/pins.rs"];

/// The other files of the product, with gaps for its name, its chip and its controller.
const TEMPLATE: [&str; 12] = [
    ".cargo/config.toml",
    ".vscode/settings.json",
    "Cargo.toml",
    "README.md",
    "build.rs",
    "ci.sh",
    "examples/eds.rs",
    "examples/release_files.rs",
    "memory.x",
    "src/application.rs",
    "src/flash.rs",
    "tests/board.rs",
];

/// The file of a product that finds this repository from every computer.
const OF_GIT: &str = ".github/workflows/ci.yml";

/// The LEDs of the boards that the firmware knows, and those of a product, which is for one board.
const LEDS: [&str; 2] = [
    r#"            indicators: if cfg!(feature = "nucleo-f446re") {
                Indicators { run: Led::active_high(a.split(rcc).pa5), error: Led::None }
            } else if cfg!(feature = "stm32-h405") {
                Indicators { run: Led::active_low(c.split(rcc).pc12), error: Led::None }
            } else {
                // Two LEDs of an STM32F407 Discovery; on a board without them the pins toggle unseen.
                Indicators { run: Led::active_high(d.pd12), error: Led::active_high(d.pd14) }
            },
"#,
    "            // Two LEDs of an STM32F407 Discovery; on a board without them the pins toggle unseen.
            indicators: Indicators {
                run: Led::active_high(d.pd12),
                error: Led::active_high(d.pd14),
            },
",
];

/// A file of the product, a text in it, and the text in its place.
type Change<'a> = (&'a str, &'a str, &'a str);

/// The release image of a new product on a CAN controller, 1 for CAN1, built in `target/products`.
pub fn build(chip: Part, controller: u8) -> anyhow::Result<Image> {
    let elf = build_changed(&format!("{}-can{controller}", chip.name()), chip, controller, &[])?;
    Ok(Image::from_elf(&elf)?)
}

/// The ELF file of a new product with changes of its files, built in `target/products`. An error has the messages of
/// `cargo`.
pub fn build_changed(
    name: &str,
    chip: Part,
    controller: u8,
    changes: &[Change<'_>],
) -> anyhow::Result<Vec<u8>> {
    let folder = workspace().join("target/products").join(name);
    let product = Product {
        name,
        chip,
        controller,
        git: None,
        folder: &folder,
        has_update: false,
        is_signed: false,
    };
    let mut files = product.files()?;
    change(&mut files, changes)?;
    product.write_files(&files)?;
    image::build_with(&folder, name, OF_PRODUCT, |command| {
        in_our_target(command);
        command.stderr(Stdio::piped());
    })
}

/// Makes the changes. Fails if a text is not there.
fn change(files: &mut [(&str, String)], changes: &[Change<'_>]) -> io::Result<()> {
    for (path, from, to) in changes {
        let file = files.iter_mut().find(|file| file.0 == *path && file.1.contains(from));
        let file = file.ok_or_else(|| io::Error::other(format!("{path} has no {from}")))?;
        file.1 = file.1.replacen(from, to, 1);
    }
    Ok(())
}

/// The loader and the program of a new product whose program can be replaced over the bus, built in `target/products`.
/// `change` gets the path and the content of each of its files.
pub fn build_with_update(
    name: &str,
    chip: Part,
    controller: u8,
    change: impl Fn(&str, String) -> String,
) -> anyhow::Result<[Image; 2]> {
    let folder = write_with_update(name, chip, controller, false, change)?;
    Ok([loader_in(&folder, name)?, program_in(&folder, name)?])
}

/// The same for a product whose loader takes only programs that the owner of this key has signed.
pub fn build_signed(
    name: &str,
    chip: Part,
    controller: u8,
    key: &[u8; 32],
) -> anyhow::Result<[Image; 2]> {
    let folder = write_with_update(name, chip, controller, true, |path, content| match path {
        path if path == update::KEY.1 => crate::update::with_key(&content, key),
        _ => content,
    })?;
    Ok([loader_in(&folder, name)?, program_in(&folder, name)?])
}

/// The loader of such a product alone.
pub fn build_loader(name: &str, chip: Part, controller: u8) -> anyhow::Result<Image> {
    let unchanged = |_: &str, content| content;
    loader_in(&write_with_update(name, chip, controller, false, unchanged)?, name)
}

/// The program of such a product alone: another one for boards with the loader of a product.
pub fn build_program(
    name: &str,
    chip: Part,
    controller: u8,
    change: impl Fn(&str, String) -> String,
) -> anyhow::Result<Image> {
    program_in(&write_with_update(name, chip, controller, false, change)?, name)
}

fn write_with_update(
    name: &str,
    chip: Part,
    controller: u8,
    is_signed: bool,
    change: impl Fn(&str, String) -> String,
) -> anyhow::Result<PathBuf> {
    let folder = workspace().join("target/products").join(name);
    let product =
        Product { name, chip, controller, git: None, folder: &folder, has_update: true, is_signed };
    let files = product.files()?.into_iter().map(|(path, content)| (path, change(path, content)));
    product.write_files(&files.collect::<Vec<_>>())?;
    Ok(folder)
}

fn loader_in(folder: &Path, name: &str) -> anyhow::Result<Image> {
    let elf = image::build_loader(folder, name, in_our_target)?;
    crate::update::in_flash(&Image::from_elf(&elf)?)
}

fn program_in(folder: &Path, name: &str) -> anyhow::Result<Image> {
    Ok(Image::from_elf(&image::build_with(folder, name, OF_PRODUCT, in_our_target)?)?)
}

/// The HAL is built there already.
fn in_our_target(command: &mut Command) {
    command.arg("--target-dir").arg(workspace().join("target"));
}

/// A product to be made.
pub struct Product<'a> {
    pub name: &'a str,
    pub chip: Part,
    /// 1 for CAN1.
    pub controller: u8,
    /// The URL of this repository; `None`: its path.
    pub git: Option<&'a str>,
    pub folder: &'a Path,
    /// The program can be replaced over the bus, by a loader.
    pub has_update: bool,
    /// The loader takes only signed programs.
    pub is_signed: bool,
}

impl Product<'_> {
    /// Writes the files of the product.
    pub fn write(&self) -> io::Result<()> {
        self.write_files(&self.files()?)
    }

    fn write_files(&self, files: &[(&str, String)]) -> io::Result<()> {
        for (path, content) in files {
            let path = self.folder.join(path);
            fs::create_dir_all(path.parent().expect("a file in the folder"))?;
            // An unchanged file is not built again.
            if fs::read(&path).ok().as_deref() != Some(content.as_bytes()) {
                fs::write(&path, content)?;
            }
        }
        Ok(())
    }

    fn files(&self) -> io::Result<Vec<(&'static str, String)>> {
        let read = |path: &str| fs::read_to_string(workspace().join(path));
        let words = self.words();
        let mut files = vec![(".gitignore", "/target\n".to_owned())];
        for path in COPIES {
            files.push((path, read(path)?));
        }
        for path in OF_FIRMWARE {
            files.push((path, read(path)?));
        }
        for path in TEMPLATE {
            files.push((path, read(&format!("template/{path}"))?));
        }
        if self.git.is_some() {
            files.push((OF_GIT, read(&format!("template/{OF_GIT}"))?));
        }
        if self.has_update {
            update::add(&mut files, self.is_signed, read)?;
        }
        let exchange = |text: String, (from, to): &(&str, String)| text.replace(from, to);
        let fill =
            |text: String, (word, with): &(&str, String)| text.replace(&format!("@{word}@"), with);
        for (path, content) in &mut files {
            let text = mem::take(content);
            *content = match () {
                () if COPIES.contains(path) || *path == OF_GIT => text,
                () if TEMPLATE.contains(path) || *path == update::UPDATE_FILE => {
                    words.iter().fold(text, fill)
                }
                () => self.exchanges().iter().fold(text, exchange),
            };
        }
        Ok(files)
    }

    /// The words of the firmware, and those of the product in their place.
    fn exchanges(&self) -> [(&'static str, String); 12] {
        let (transmit, receive) = match self.controller {
            1 => (9, 8),
            2 => (13, 12),
            _ => (4, 3),
        };
        let (name, chip) = (self.name, self.chip.name().to_uppercase());
        [
            ("use firmware::", format!("use {}::", name.replace('-', "_"))),
            ("cargo xtask eds", "cargo eds".to_owned()),
            ("CAN1", format!("CAN{}", self.controller)),
            ("b.pb9, b.pb8", format!("b.pb{transmit}, b.pb{receive}")),
            ("0x4C53_5334", "0x0000_0001".to_owned()),
            ("CANopen LSS slave on an STM32F4", format!("{name} on an {chip}")),
            ("\"LSS slave\"", format!("{name:?}")),
            ("cfg!(feature = \"nucleo-f446re\");", "false;".to_owned()),
            (LEDS[0], LEDS[1].to_owned()),
            ("self, GPIOA, GPIOB, GPIOC, GPIOD", "self, GPIOB, GPIOD".to_owned()),
            ("a: GPIOA, b: GPIOB, c: GPIOC, d: GPIOD", "b: GPIOB, d: GPIOD".to_owned()),
            ("chip.GPIOA, chip.GPIOB, chip.GPIOC, chip.GPIOD", "chip.GPIOB, chip.GPIOD".to_owned()),
        ]
    }

    /// The words for the gaps of the template.
    fn words(&self) -> Vec<(&'static str, String)> {
        let chip = Chip::named(self.chip.name()).expect("a test compares the names");
        vec![
            ("name", self.name.to_owned()),
            ("crate", self.name.replace('-', "_")),
            ("chip", chip.feature.to_owned()),
            ("CHIP", chip.feature.to_uppercase()),
            ("controller", self.controller.to_string()),
            ("repository", self.git.map_or_else(|| self.path(""), str::to_owned)),
            ("source chip-build", self.dependency("lab/chip-build")),
            ("source emulator", self.dependency("lab/emulator")),
            ("source canopen-node", self.dependency("libs/canopen-node")),
            ("source stm32f4", self.dependency("boards/stm32f4")),
            ("source testkit", self.dependency("lab/testkit")),
        ]
    }

    /// A package of this repository in `folder`, as a dependency.
    fn dependency(&self, folder: &str) -> String {
        match self.git {
            Some(url) => format!("git = {url:?}"),
            None => format!("path = {:?}", self.path(folder)),
        }
    }

    /// The path of a folder of this repository, from the product on if both lie in one folder.
    fn path(&self, folder: &str) -> String {
        let path = workspace().join(folder);
        let (mut to, mut from) =
            (path.components().peekable(), self.folder.components().peekable());
        let mut common = 0;
        while to.peek().is_some() && to.peek() == from.peek() {
            to.next();
            from.next();
            common += 1;
        }
        let relative = || from.map(|_| Component::ParentDir).chain(to).collect();
        // Both have the root in common.
        let path: PathBuf = if common > 1 { relative() } else { path.components().collect() };
        path.display().to_string().replace('\\', "/")
    }
}

#[cfg(test)]
mod tests {
    use toml::Table;

    use super::*;

    fn files(
        chip: Part,
        controller: u8,
        git: Option<&str>,
        folder: &Path,
        has_update: bool,
    ) -> Vec<(&'static str, String)> {
        let product = Product {
            name: "door-lock",
            chip,
            controller,
            git,
            folder,
            has_update,
            is_signed: false,
        };
        product.files().expect("this repository has what a product needs")
    }

    fn content<'a>(files: &'a [(&str, String)], path: &str) -> &'a str {
        files.iter().find(|file| file.0 == path).map(|file| &*file.1).expect(path)
    }

    #[test]
    fn the_template_has_all_its_files_and_they_have_no_gaps() {
        let folder = Path::new("/products/door-lock");
        for (path, content) in files(Part::Stm32f413, 3, None, folder, false) {
            assert!(path == "Cargo.lock" || !content.contains('@'), "{path}: {content}");
        }
        let tracked = Command::new("git")
            .args(["ls-files", "--", "template"])
            .current_dir(workspace())
            .output()
            .expect("git runs");
        let tracked = String::from_utf8(tracked.stdout).expect("UTF-8");
        let of_options = [OF_GIT, update::KEY.0].len() + update::FILES.len();
        assert_eq!(tracked.lines().count(), TEMPLATE.len() + of_options, "{tracked}");
    }

    #[test]
    fn the_words_of_the_firmware_that_a_product_has_others_for_are_in_it() {
        let folder = Path::new("/products/door-lock");
        let product = Product {
            name: "door-lock",
            chip: Part::Stm32f446,
            controller: 2,
            git: None,
            folder,
            has_update: false,
            is_signed: false,
        };
        let read = |path| fs::read_to_string(workspace().join(path)).expect("a file");
        let firmware: String = OF_FIRMWARE.into_iter().map(read).collect();
        let files = product.files().expect("this repository has what a product needs");
        for (ours, of_product) in product.exchanges() {
            assert!(firmware.contains(ours), "{ours}");
            assert!(files.iter().any(|(_, content)| content.contains(&of_product)), "{of_product}");
        }
    }

    #[test]
    fn the_chip_is_the_one_of_the_manifest_and_the_controller_that_of_the_pins() {
        let files = files(Part::Stm32f413, 3, None, Path::new("/products/door-lock"), false);
        let read = |path: &str| Ok(content(&files, path).to_owned());
        let (part, controller) = image::board_with(read).expect("both are there");
        assert_eq!((part, controller), (Part::Stm32f413, 3));
        for (path, name) in files.iter().filter(|(path, _)| !path.ends_with(".md")) {
            let is_manifest = ["Cargo.toml", "src/device.rs"].contains(path);
            assert_eq!(name.to_lowercase().contains("stm32f413"), is_manifest, "{path}");
        }
    }

    #[test]
    fn an_interrupt_of_another_controller_is_named() {
        let folder = Path::new("/products/door-lock");
        let files = files(Part::Stm32f446, 2, None, folder, true);
        for program in ["src/main.rs", "src/loader.rs"] {
            let read = |path: &str| match content(&files, path) {
                text if path == program => Ok(text.replace("CAN2_SCE", "CAN1_SCE")),
                text => Ok(text.to_owned()),
            };
            let error = image::board_with(read).expect_err("the board would answer nothing");
            let text = " binds no task to CAN2_SCE, an interrupt of CAN2 in src/pins.rs";
            assert_eq!(error.to_string(), format!("{program}{text}"));
        }
    }

    #[test]
    fn the_editor_of_a_product_checks_it_for_its_chip() {
        let files = files(Part::Stm32f413, 3, None, Path::new("/products/door-lock"), false);
        let settings = content(&files, ".vscode/settings.json");
        let manifest: Table = content(&files, "Cargo.toml").parse().expect("TOML");
        let of_program = &manifest["bin"][0]["required-features"][0];
        assert!(settings.contains(&format!("\"rust-analyzer.cargo.features\": [{of_program}]")));
        assert!(settings.contains("\"rust-analyzer.cargo.target\": \"thumbv7em-none-eabihf\""));
    }

    #[test]
    fn the_manifest_names_this_repository_by_path_or_by_url() {
        let beside = workspace().parent().expect("not the root").join("door-lock");
        let files_beside = files(Part::Stm32f446, 1, None, &beside, false);
        let manifest: Table = content(&files_beside, "Cargo.toml").parse().expect("TOML");
        let here = workspace().file_name().and_then(|name| name.to_str()).expect("UTF-8");
        let library = &manifest["dependencies"]["canopen-node"];
        assert_eq!(library["path"].as_str(), Some(&*format!("../{here}/libs/canopen-node")));
        let feature = &manifest["features"]["chip"];
        assert_eq!(feature[0].as_str(), Some("canopen-stm32f4/stm32f446"));

        let url = "https://example.org/lss-slave.git";
        let files_of_url =
            files(Part::Stm32f446, 1, Some(url), Path::new("/products/door-lock"), false);
        assert!(content(&files_of_url, OF_GIT).contains("run: bash ci.sh"));
        assert!(
            !files_beside.iter().any(|(path, _)| *path == OF_GIT),
            "CI has no folder beside it"
        );
        let manifest: Table = content(&files_of_url, "Cargo.toml").parse().expect("TOML");
        for table in [&manifest["dependencies"], &manifest["dev-dependencies"]] {
            for (name, dependency) in table.as_table().expect("dependencies") {
                assert_eq!(dependency["git"].as_str(), Some(url), "{name}");
            }
        }
    }
}
