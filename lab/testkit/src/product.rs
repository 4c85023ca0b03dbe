//! Products made from the folder `template/`: those of `cargo xtask new-product`, and for tests on other controllers.

use std::{
    fs, io,
    path::{Component, Path, PathBuf},
};

use canopen_stm32f4::chip::Chip;
use emulator::{chip::Part, image::Image};

use crate::{cargo::workspace, image};

/// The files that the product shares with this repository.
const COPIES: [&str; 3] = ["Cargo.lock", "rust-toolchain.toml", "rustfmt.toml"];

/// The files of the product, with gaps for its name, its chip and its controller.
const TEMPLATE: [&str; 13] = [
    ".cargo/config.toml",
    "Cargo.toml",
    "README.md",
    "build.rs",
    "examples/eds.rs",
    "memory.x",
    "src/application.rs",
    "src/device.rs",
    "src/flash.rs",
    "src/lib.rs",
    "src/main.rs",
    "src/pins.rs",
    "tests/board.rs",
];

/// The release image of a new product on a CAN controller, 1 for CAN1, built in `target/products`.
pub fn build(chip: Part, controller: u8) -> anyhow::Result<Image> {
    let name = format!("{}-can{controller}", chip.name());
    let folder = workspace().join("target/products").join(&name);
    let product = Product { name: &name, chip, controller, git: None, folder: &folder };
    product.write()?;
    let elf = image::build_with(&folder, &name, chip, |command| {
        // The HAL is built there already.
        command.arg("--target-dir").arg(workspace().join("target"));
    })?;
    Ok(Image::from_elf(&elf)?)
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
}

impl Product<'_> {
    /// Writes the files of the product.
    pub fn write(&self) -> io::Result<()> {
        for (path, content) in self.files()? {
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
        for path in TEMPLATE {
            let template = read(&format!("template/{path}"))?;
            let content = words
                .iter()
                .fold(template, |text, (word, with)| text.replace(&format!("@{word}@"), with));
            files.push((path, content));
        }
        Ok(files)
    }

    /// The words for the gaps of the template.
    fn words(&self) -> Vec<(&'static str, String)> {
        let chip = Chip::named(self.chip.name()).expect("a test compares the names");
        let (transmit, receive) = match self.controller {
            1 => ("9", "8"),
            2 => ("13", "12"),
            _ => ("4", "3"),
        };
        vec![
            ("name", self.name.to_owned()),
            ("crate", self.name.replace('-', "_")),
            ("chip", chip.feature.to_owned()),
            ("CHIP", chip.feature.to_uppercase()),
            ("part", format!("{:?}", self.chip)),
            ("can", format!("CAN{}", self.controller)),
            ("controller", self.controller.to_string()),
            ("transmit", transmit.to_owned()),
            ("receive", receive.to_owned()),
            ("probe-rs", chip.probe_rs.to_owned()),
            ("repository", self.git.map_or_else(|| self.path(""), str::to_owned)),
            ("source emulator", self.dependency("emulator")),
            ("source canopen-node", self.dependency("canopen-node")),
            ("source stm32f4", self.dependency("stm32f4")),
            ("source testkit", self.dependency("testkit")),
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
    use std::process::Command;

    use toml::Table;

    use super::*;

    fn files(
        chip: Part,
        controller: u8,
        git: Option<&str>,
        folder: &Path,
    ) -> Vec<(&'static str, String)> {
        let product = Product { name: "door-lock", chip, controller, git, folder };
        product.files().expect("this repository has what a product needs")
    }

    fn content<'a>(files: &'a [(&str, String)], path: &str) -> &'a str {
        files.iter().find(|file| file.0 == path).map(|file| &*file.1).expect(path)
    }

    #[test]
    fn the_template_has_all_its_files_and_they_have_no_gaps() {
        let folder = Path::new("/products/door-lock");
        for (path, content) in files(Part::Stm32f413, 3, None, folder) {
            assert!(path == "Cargo.lock" || !content.contains('@'), "{path}: {content}");
        }
        let tracked = Command::new("git")
            .args(["ls-files", "--", "template"])
            .current_dir(workspace())
            .output()
            .expect("git runs");
        let tracked = String::from_utf8(tracked.stdout).expect("UTF-8");
        assert_eq!(tracked.lines().count(), TEMPLATE.len(), "{tracked}");
    }

    #[test]
    fn the_tasks_of_a_product_are_those_of_the_plain_firmware() {
        let files = files(Part::Stm32f405, 1, None, Path::new("/products/door-lock"));
        let tasks = |main: &str| main.split_once("#[shared]").map(|(_, rest)| rest.to_owned());
        let firmware = fs::read_to_string(workspace().join("src/main.rs")).expect("main.rs");
        assert_eq!(tasks(content(&files, "src/main.rs")), tasks(&firmware));
    }

    #[test]
    fn cargo_flash_of_a_product_names_its_chip_to_probe_rs() {
        let files = files(Part::Stm32f413, 3, None, Path::new("/products/door-lock"));
        let config: Table = content(&files, ".cargo/config.toml").parse().expect("TOML");
        assert_eq!(config["env"]["PROBE_RS_CHIP"].as_str(), Some("STM32F413VHTx"));
    }

    #[test]
    fn the_manifest_names_this_repository_by_path_or_by_url() {
        let beside = workspace().parent().expect("not the root").join("door-lock");
        let files_beside = files(Part::Stm32f446, 1, None, &beside);
        let manifest: Table = content(&files_beside, "Cargo.toml").parse().expect("TOML");
        let here = workspace().file_name().and_then(|name| name.to_str()).expect("UTF-8");
        let library = &manifest["dependencies"]["canopen-node"];
        assert_eq!(library["path"].as_str(), Some(&*format!("../{here}/canopen-node")));
        let feature = &manifest["features"]["stm32f446"];
        assert_eq!(feature[0].as_str(), Some("canopen-stm32f4/stm32f446"));

        let url = "https://example.org/lss-slave.git";
        let files_of_url = files(Part::Stm32f446, 1, Some(url), Path::new("/products/door-lock"));
        let manifest: Table = content(&files_of_url, "Cargo.toml").parse().expect("TOML");
        for table in [&manifest["dependencies"], &manifest["dev-dependencies"]] {
            for (name, dependency) in table.as_table().expect("dependencies") {
                assert_eq!(dependency["git"].as_str(), Some(url), "{name}");
            }
        }
    }
}
