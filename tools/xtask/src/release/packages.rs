//! The packages that are linked into the firmware.

use std::{
    collections::{BTreeMap, BTreeSet},
    env, fs,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, bail, ensure};
use emulator::chip::Part;
use serde_json::Value;

use testkit::cargo::{TARGET, cargo, workspace};

use crate::tool;

/// A package: those of cargo, and the one of the compiler.
pub struct Package {
    pub name: String,
    pub version: String,
    /// The SPDX expression of its licence.
    pub licence: String,
    pub repository: Option<String>,
    /// The SHA-256 checksum of the package in the registry; none for the packages of this repository.
    pub checksum: Option<String>,
    /// Where its files are; none for the compiler's.
    pub folder: Option<PathBuf>,
    /// The packages that it uses, by name and version.
    pub uses: BTreeSet<(String, String)>,
}

/// The name of the firmware's package.
pub const FIRMWARE: &str = "firmware";
/// The library of the compiler, which every program contains.
pub const CORE: &str = "core";

/// The packages in the firmware for a chip, by name and version.
pub fn linked(chip: Part) -> anyhow::Result<Vec<Package>> {
    let tree = tool::output(
        cargo()
            .args(["tree", "--locked", "--package", FIRMWARE, "--features", chip.name()])
            .args(["--target", TARGET, "--edges", "no-dev,no-build,no-proc-macro"])
            .args(["--no-dedupe", "--prefix", "depth", "--format", "|{p}|{l}|{r}"]),
    )?;
    let metadata = tool::output(cargo().args(["metadata", "--locked", "--format-version", "1"]))?;
    let metadata: Value = serde_json::from_str(&metadata).context("the metadata of cargo")?;
    let folder = |name: &str, version: &str| {
        let mut packages = metadata["packages"].as_array()?.iter();
        let package = packages.find(|it| it["name"] == name && it["version"] == version)?;
        Path::new(package["manifest_path"].as_str()?).parent().map(Path::to_owned)
    };
    let lock = fs::read_to_string(workspace().join("Cargo.lock")).context("Cargo.lock")?;
    let lock: toml::Table = lock.parse().context("Cargo.lock")?;
    let checksum = |name: &str, version: &str| {
        let is = |package: &toml::Value| {
            package["name"].as_str() == Some(name) && package["version"].as_str() == Some(version)
        };
        let package = lock["package"].as_array()?.iter().find(|package| is(package))?;
        package.get("checksum")?.as_str().map(str::to_owned)
    };
    let mut packages: BTreeMap<(String, String), Package> = BTreeMap::new();
    // The package of the line before, the one that uses it, and so on.
    let mut users: Vec<(String, String)> = Vec::new();
    for line in tree.lines() {
        let [depth, package, licence, repository] =
            line.split('|').collect::<Vec<_>>().try_into().ok().with_context(|| line.to_owned())?;
        let [name, version, ..] = package.split(' ').collect::<Vec<_>>()[..] else {
            bail!("{line}")
        };
        let (name, version) = (name.to_owned(), version.trim_start_matches('v').to_owned());
        ensure!(!licence.is_empty(), "{name} has no licence");
        let key = (name.clone(), version.clone());
        users.truncate(depth.parse().with_context(|| line.to_owned())?);
        if let Some(user) = users.last().and_then(|user| packages.get_mut(user)) {
            user.uses.insert(key.clone());
        }
        packages.entry(key.clone()).or_insert_with(|| Package {
            licence: licence.replace('/', " OR "),
            repository: Some(repository.to_owned()).filter(|repository| !repository.is_empty()),
            checksum: checksum(&name, &version),
            folder: folder(&name, &version),
            uses: BTreeSet::new(),
            name,
            version,
        });
        users.push(key);
    }
    let core = core()?;
    packages.insert((core.name.clone(), core.version.clone()), core);
    Ok(packages.into_values().collect())
}

fn core() -> anyhow::Result<Package> {
    let rustc = env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let version = tool::output(Command::new(rustc).arg("--version"))?;
    let version = version.split_whitespace().nth(1).context("rustc has no version")?;
    Ok(Package {
        name: CORE.to_owned(),
        version: version.to_owned(),
        licence: "MIT OR Apache-2.0".to_owned(),
        repository: Some("https://github.com/rust-lang/rust".to_owned()),
        checksum: None,
        folder: None,
        uses: BTreeSet::new(),
    })
}
