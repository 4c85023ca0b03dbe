//! `cargo xtask new-product`: a product in a folder of its own, which takes the protocol and the drivers from here.

mod features;

use std::{
    env, fs,
    path::{Component, Path, PathBuf},
    process::{Command, Stdio},
};

use anyhow::{Context, bail, ensure};
use emulator::chip::Part;
use lss_slave_firmware::chip::{self, Chip};

use crate::example;

/// Make a product: a package of its own, with its identity, objects, pins and tests
///
/// The product takes the protocol and the drivers from this repository, and has its own src/device.rs,
/// src/application.rs, src/pins.rs and the tasks in src/main.rs. Its tests run its release image on an emulated board.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// The name of the product, such as `lamp` or `door-lock`
    name: String,
    /// Its folder, which must not exist, outside of this repository [default: beside this repository]
    #[arg(long, value_name = "DIR")]
    path: Option<PathBuf>,
    /// Take this repository from there, not from this folder
    #[arg(long, value_name = "URL", value_parser = git_url)]
    git: Option<String>,
    /// The chip of the board
    #[arg(long, default_value = "stm32f405")]
    chip: Part,
    /// The CAN controller: can1, can2, or on some chips can3
    #[arg(long, default_value = "can1", value_parser = chip::controller)]
    controller: u8,
}

/// The files that the product takes as they are.
const COPIES: [&str; 5] =
    ["Cargo.lock", "memory.x", "rust-toolchain.toml", "rustfmt.toml", "src/application.rs"];

/// The files of the product that are made from those in `xtask/product/`.
const TEMPLATES: [(&str, &str); 5] = [
    ("build.rs", include_str!("../product/build.rs")),
    ("README.md", include_str!("../product/README.md")),
    (".cargo/config.toml", include_str!("../product/config.toml")),
    ("examples/eds.rs", include_str!("../product/eds.rs")),
    ("tests/board.rs", include_str!("../product/board.rs")),
];

/// The example of an object in the new `src/application.rs`, and the line that it follows.
const OBJECT: (&str, &str) = (
    "    pub struct Application, values Value;\n",
    "\n    0x2100 {\n        0 \"Brightness in percent\" brightness: u8 = 50, rw, 0..=100, stored;\n    }\n",
);

/// Makes the product, and prints what to do with it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments { name, path, git, chip, controller } = arguments;
    check_name(name)?;
    example::check_controller(*chip, *controller)?;
    let workspace = workspace();
    let folder = match path {
        Some(path) => env::current_dir()?.join(path),
        None => workspace.parent().context("this repository is the root")?.join(name),
    };
    let folder = without_dots(&folder);
    ensure!(
        !folder.starts_with(workspace),
        "{} lies within this repository: give another folder with `--path`",
        folder.display()
    );
    ensure!(
        !folder.exists(),
        "{} exists: remove it, or give another folder with `--path`",
        folder.display()
    );
    let git = git.as_deref();
    let product = Product { name, chip: *chip, controller: *controller, git, folder: &folder };
    let files = product.files(&|path| {
        let path = workspace.join(path);
        fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))
    })?;
    for (path, content) in files {
        let path = folder.join(path);
        fs::create_dir_all(path.parent().expect("a file in the folder"))
            .and_then(|()| fs::write(&path, content))
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    // The lines of the product's names have other lengths. Without rustfmt they stay as they are.
    quietly(Command::new("cargo").arg("fmt"), &folder);
    println!("The product `{name}` is in {}:\n", folder.display());
    println!("    cd {}\n    cargo test\n", folder.display());
    println!("runs it on an emulated board. Its README.md says how to go on.");
    begin_history(&folder);
    Ok(())
}

/// Makes the folder a git repository, unless it lies in one or there is no git.
fn begin_history(folder: &Path) {
    if !quietly(Command::new("git").arg("rev-parse"), folder) {
        quietly(Command::new("git").args(["init", "--quiet"]), folder);
    }
}

/// Whether the command succeeds.
fn quietly(command: &mut Command, folder: &Path) -> bool {
    command.current_dir(folder).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

/// Names that the product cannot have: of crates and modules in its program, and of the test harness.
const TAKEN: [&str; 20] = [
    "alloc",
    "app",
    "bxcan",
    "core",
    "cortex-m",
    "cortex-m-rt",
    "defmt",
    "defmt-rtt",
    "embedded-storage",
    "emulator",
    "fugit",
    "lss-slave",
    "lss-slave-firmware",
    "panic-probe",
    "product",
    "rtic",
    "std",
    "stm32f4xx-hal",
    "test",
    "testkit",
];

/// A URL of git that cargo takes, and that needs no escape in a manifest.
fn git_url(text: &str) -> Result<String, &'static str> {
    let is_of_url = |c: char| c.is_ascii_graphic() && !"\"<>\\^`{|}".contains(c);
    match text.split_once("://") {
        Some(("file" | "git" | "http" | "https" | "ssh", rest))
            if !rest.is_empty() && rest.chars().all(is_of_url) =>
        {
            Ok(text.to_owned())
        }
        _ => Err("give a URL such as https://example.org/lss-slave.git"),
    }
}

/// Checks that cargo and the compiler accept the name.
fn check_name(name: &str) -> anyhow::Result<()> {
    let is_of_name = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    ensure!(
        name.starts_with(|c: char| c.is_ascii_lowercase())
            && name.chars().all(is_of_name)
            && !name.ends_with('-'),
        "`{name}` cannot be the name of a product: it must begin with one of the letters a to z, and go on with such \
         letters, digits and hyphens, as in `door-lock`"
    );
    ensure!(
        !TAKEN.contains(&name) && syn::parse_str::<syn::Ident>(&name.replace('-', "_")).is_ok(),
        "`{name}` cannot be the name of a product, because Rust or something in its program has that name"
    );
    Ok(())
}

/// A product to be made.
struct Product<'a> {
    name: &'a str,
    chip: Part,
    /// 1 for CAN1.
    controller: u8,
    git: Option<&'a str>,
    folder: &'a Path,
}

impl Product<'_> {
    /// The files of the product. `read` gives the files of this repository.
    fn files(
        &self,
        read: &dyn Fn(&str) -> anyhow::Result<String>,
    ) -> anyhow::Result<Vec<(String, String)>> {
        let mut files = Vec::new();
        for path in COPIES {
            files.push((path.to_owned(), read(path)?));
        }
        let (_, application) = files.last_mut().expect("there are copies");
        *application = replace(application, OBJECT.0, &[OBJECT.0, OBJECT.1].concat())?;

        let chip = Chip::named(self.chip.name()).context("src/chip.rs does not have this chip")?;
        let mut features = example::features(self.controller, None);
        features.extend(["chip", chip.feature]);
        let own = |path: &str| -> anyhow::Result<String> {
            features::resolve(&read(path)?, &features).with_context(|| path.to_owned())
        };
        let of_firmware = "lss_slave_firmware";
        let main = own("src/main.rs")?.replace(of_firmware, &self.crate_name());
        let library = replace(&own("src/lib.rs")?, "pub mod chip;\n", "")?;
        let library = replace(&library, "pub mod io;\n", "")?;
        let library = replace(
            &library,
            "use lss_slave::{",
            "pub use lss_slave_firmware::chip;\nuse lss_slave::{",
        )?;
        files.extend([
            ("src/main.rs".to_owned(), with_drivers(&main)?),
            ("src/lib.rs".to_owned(), library),
            ("src/device.rs".to_owned(), self.device(&own("src/device.rs")?)?),
            ("src/pins.rs".to_owned(), own("src/pins.rs")?),
            ("Cargo.toml".to_owned(), self.manifest(&read("Cargo.toml")?)?),
            (".gitignore".to_owned(), "/target\n".to_owned()),
        ]);
        let words = [
            ("@name@", self.name.to_owned()),
            ("@crate@", self.crate_name()),
            ("@chip@", chip.feature.to_owned()),
            ("@CHIP@", chip.feature.to_uppercase()),
            ("@part@", format!("{:?}", self.chip)),
            ("@controller@", self.controller.to_string()),
            ("@probe-rs@", chip.probe_rs.to_owned()),
            ("@source@", self.git.map_or_else(|| self.path(""), str::to_owned)),
        ];
        let filled = TEMPLATES.map(|(path, template)| (path.to_owned(), fill(template, &words)));
        files.extend(filled);
        Ok(files)
    }

    fn crate_name(&self) -> String {
        self.name.replace('-', "_")
    }

    /// `device.rs` with the name of the product.
    fn device(&self, device: &str) -> anyhow::Result<String> {
        let description = format!("{} on an {}", self.name, self.chip.name().to_uppercase());
        let device = with_value(device, "DESCRIPTION: &str", &format!("{description:?}"))?;
        let device = with_value(&device, "NAME: &str", &format!("{:?}", self.name))?;
        with_value(&device, "PRODUCT_CODE: u32", "0x0000_0001")
    }

    /// The manifest, with the dependencies of the drivers and the profiles of the firmware's.
    fn manifest(&self, of_firmware: &str) -> anyhow::Result<String> {
        const DEPENDENCIES: &str = "[target.'cfg(target_os = \"none\")'.dependencies]\n";
        let part = |from: &str, to: &str| -> anyhow::Result<&str> {
            let (_, rest) = of_firmware.split_once(from).with_context(|| format!("no {from}"))?;
            Ok(rest.split_once(to).map_or(rest, |(part, _)| part))
        };
        let library = self.dependency("lss-slave");
        let drivers = replace(part(DEPENDENCIES, "\n\n")?, "path = \"lss-slave\"", &library)?;
        let profiles = replace(
            part("[profile.dev]", "\0")?,
            "\nlss-slave-firmware =",
            &format!("\n{} =", self.name),
        )?;
        let words = [
            ("@name@", self.name.to_owned()),
            ("@features@", self.features()),
            ("@chip@", self.chip.name().to_owned()),
            ("@lss-slave@", library),
            ("@firmware@", self.dependency("")),
            ("@emulator@", self.dependency("emulator")),
            ("@testkit@", self.dependency("testkit")),
            ("@drivers@", format!("{DEPENDENCIES}{drivers}")),
            ("@profiles@", format!("[profile.dev]{profiles}")),
        ];
        Ok(fill(include_str!("../product/Cargo.toml"), &words))
    }

    /// The features of the product: its chip, with its CAN controller unless that is CAN1.
    fn features(&self) -> String {
        let chip = self.chip.name();
        let of_firmware = |feature: &str| format!("\"lss-slave-firmware/{feature}\"");
        match example::features(self.controller, None)[..] {
            [can] => format!(
                "{chip} = [\"{can}\", {}]\n{can} = [{}]",
                of_firmware(chip),
                of_firmware(can)
            ),
            _ => format!("{chip} = [{}]", of_firmware(chip)),
        }
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

/// `main.rs` with the drivers from the build script; it declares only the modules that the product has itself.
fn with_drivers(main: &str) -> anyhow::Result<String> {
    let is_of_firmware =
        |line: &&str| line.starts_with("mod ") && line.ends_with(';') && *line != "mod pins;";
    let main = main.lines().filter(|line| !is_of_firmware(line)).collect::<Vec<_>>().join("\n");
    let drivers = "include!(concat!(env!(\"OUT_DIR\"), \"/drivers.rs\"));";
    let main = replace(&main, "\nmod pins;\n", &format!("\nmod pins;\n{drivers}\n"))?;
    let allowed = "#[allow(dead_code, reason = \"no task takes `io` yet\")]";
    let at = main.find("#[rtic::app(").context("main.rs has no RTIC app")?;
    let (before, app) = main.split_at(at);
    let indent = &before[before.trim_end_matches(' ').len()..];
    Ok(format!("{before}{allowed}\n{indent}{app}\n"))
}

/// `text` with this value of a public constant.
fn with_value(text: &str, constant: &str, value: &str) -> anyhow::Result<String> {
    let begin = format!("pub const {constant} = ");
    let (_, rest) = text.split_once(&begin).with_context(|| format!("no `{begin}`"))?;
    let (old, _) = rest.split_once(';').with_context(|| format!("no end of `{begin}`"))?;
    replace(text, &format!("{begin}{old};"), &format!("{begin}{value};"))
}

/// `text` with `to` in place of `from`, which it has once.
fn replace(text: &str, from: &str, to: &str) -> anyhow::Result<String> {
    match text.matches(from).count() {
        1 => Ok(text.replace(from, to)),
        count => bail!("`{from}` occurs {count} times, not once: adapt xtask/src/new_product.rs"),
    }
}

fn fill(template: &str, words: &[(&str, String)]) -> String {
    words.iter().fold(template.to_owned(), |text, (word, with)| text.replace(word, with))
}

fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("a workspace member")
}

/// `path` without `.` and `..`.
fn without_dots(path: &Path) -> PathBuf {
    path.components().fold(PathBuf::new(), |mut path, component| {
        match component {
            Component::CurDir => {}
            Component::ParentDir => {
                path.pop();
            }
            other => path.push(other),
        }
        path
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_cargo_and_the_compiler_accept_are_taken() {
        for name in ["lamp", "door-lock", "io4"] {
            check_name(name).expect(name);
        }
        for name in
            ["", "Lamp", "4io", "-lamp", "lamp-", "door_lock", "a/b", "fn", "core", "testkit"]
        {
            let error = check_name(name).expect_err(name).to_string();
            assert!(error.starts_with(&format!("`{name}` cannot be the name")), "{error}");
        }
    }

    #[test]
    fn only_urls_that_cargo_accepts_are_taken() {
        for url in ["https://example.org/a.git", "ssh://git@example.org:22/~a/b", "file:///a/b"] {
            assert_eq!(git_url(url).as_deref(), Ok(url));
        }
        for url in [
            "",
            "notaurl\"x",
            "https://",
            "https://a/\"x",
            "https://a/b c",
            "https://a/\u{e4}",
            "a/b.git",
            "git@example.org:a/b.git",
            "lamp://a/b",
        ] {
            git_url(url).expect_err(url);
        }
    }

    fn files(git: Option<&str>, folder: &str) -> Vec<(String, String)> {
        files_with(Part::Stm32f446, 1, git, folder)
    }

    fn files_with(
        chip: Part,
        controller: u8,
        git: Option<&str>,
        folder: &str,
    ) -> Vec<(String, String)> {
        let folder = Path::new(folder);
        let product = Product { name: "door-lock", chip, controller, git, folder };
        let read = |path: &str| Ok(fs::read_to_string(workspace().join(path))?);
        product.files(&read).expect("this repository has what a product needs")
    }

    fn content<'a>(files: &'a [(String, String)], path: &str) -> &'a str {
        files.iter().find(|file| file.0 == path).map(|file| &*file.1).expect(path)
    }

    #[test]
    fn the_files_of_a_product_have_no_gaps_and_no_features() {
        let files_of_can3 = files_with(Part::Stm32f413, 3, None, "/products/door-lock");
        for (path, content) in files(None, "/products/door-lock").into_iter().chain(files_of_can3) {
            assert!(path == "Cargo.lock" || !content.contains('@'), "{path}: {content}");
            if path.starts_with("src/") {
                assert!(!content.contains("#[cfg(feature"), "{path}: {content}");
                assert!(!content.contains("#[cfg(not(feature"), "{path}: {content}");
                assert!(path == "src/lib.rs" || !content.contains("lss_slave_firmware"), "{path}");
            }
        }
    }

    #[test]
    fn cargo_flash_of_a_product_names_its_chip_to_probe_rs() {
        let files = files_with(Part::Stm32f413, 3, None, "/products/door-lock");
        let config: toml::Table = content(&files, ".cargo/config.toml").parse().expect("TOML");
        assert_eq!(config["env"]["PROBE_RS_CHIP"].as_str(), Some("STM32F413VHTx"));
    }

    #[test]
    fn the_manifest_names_this_repository_by_path_or_by_url() {
        let beside = workspace().parent().expect("not the root").join("door-lock");
        let files_beside = files(None, beside.to_str().expect("UTF-8"));
        let manifest: toml::Table = content(&files_beside, "Cargo.toml").parse().expect("TOML");
        let here = workspace().file_name().and_then(|name| name.to_str()).expect("UTF-8");
        let firmware = &manifest["dependencies"]["lss-slave-firmware"];
        assert_eq!(firmware["path"].as_str(), Some(&*format!("../{here}")));
        let library = &manifest["dependencies"]["lss-slave"];
        assert_eq!(library["path"].as_str(), Some(&*format!("../{here}/lss-slave")));
        assert_eq!(manifest["profile"]["release"]["lto"].as_str(), Some("fat"));
        assert!(manifest["profile"]["release"]["package"].get("door-lock").is_some());

        let url = "https://example.org/lss-slave.git";
        let files_of_url = files(Some(url), "/products/door-lock");
        let manifest: toml::Table = content(&files_of_url, "Cargo.toml").parse().expect("TOML");
        for table in [&manifest["dependencies"], &manifest["dev-dependencies"]] {
            for (name, dependency) in table.as_table().expect("dependencies") {
                assert_eq!(dependency["git"].as_str(), Some(url), "{name}");
            }
        }
    }

    #[test]
    fn the_product_has_an_identity_and_an_object_of_its_own() {
        let files = files(None, "/products/door-lock");
        let device = content(&files, "src/device.rs");
        assert!(device.contains("pub const NAME: &str = \"door-lock\";"));
        assert!(content(&files, "src/application.rs").contains("0x2100 {\n        0 \"Bright"));
        assert!(content(&files, "src/main.rs").contains("use door_lock as product;"));
        assert!(content(&files, "tests/board.rs").contains("Part::Stm32f446"));
    }
    #[test]
    fn every_file_of_a_product_has_the_same_can_controller() {
        for (chip, controller, pins, features) in [
            (Part::Stm32f446, 1, "b.pb9, b.pb8", &["lss-slave-firmware/stm32f446"][..]),
            (Part::Stm32f446, 2, "b.pb13, b.pb12", &["can2", "lss-slave-firmware/stm32f446"]),
            (Part::Stm32f413, 3, "b.pb4, b.pb3", &["can3", "lss-slave-firmware/stm32f413"]),
        ] {
            let files = files_with(chip, controller, None, "/products/door-lock");
            let pins = format!("can: CanPins::new({pins}),");
            assert_eq!(content(&files, "src/pins.rs").matches("CanPins::new").count(), 1);
            assert!(content(&files, "src/pins.rs").contains(&pins), "{pins}");
            let interrupts =
                format!("CAN{controller}_RX0, CAN{controller}_TX, CAN{controller}_SCE");
            let application = format!("\napplication!({interrupts});\n");
            assert_eq!(content(&files, "src/main.rs").matches("\napplication!(").count(), 1);
            assert!(content(&files, "src/main.rs").contains(&application), "{application}");
            let board = content(&files, "tests/board.rs");
            assert!(board.contains(&format!("controller: {controller},")), "{board}");
            assert!(board.contains(&format!("Board::new(Part::{chip:?}, &IMAGE")), "{board}");
            let readme = content(&files, "README.md");
            assert!(readme.contains(&format!("on CAN{controller} of an")), "{readme}");

            let manifest: toml::Table = content(&files, "Cargo.toml").parse().expect("TOML");
            let of_chip = manifest["features"][chip.name()].as_array().expect("features");
            assert!(of_chip.iter().map(toml::Value::as_str).eq(features.iter().copied().map(Some)));
            let feature = format!("can{controller}");
            let of_firmware = toml::Value::from(vec![format!("lss-slave-firmware/{feature}")]);
            let expected = (controller > 1).then_some(&of_firmware);
            assert_eq!(manifest["features"].get(&feature), expected);
        }
    }

    #[test]
    fn a_can_controller_has_a_name_and_a_number() {
        for (name, number) in [("can1", Some(1)), ("can2", Some(2)), ("3", Some(3)), ("can4", None)]
        {
            assert_eq!(chip::controller(name).ok(), number, "{name}");
        }
    }
}
