//! The packages that are linked into the firmware.

use std::{
    collections::{BTreeMap, BTreeSet},
    env, fs,
    path::PathBuf,
    process::{Command, Stdio},
};

use anyhow::{Context, bail};
use emulator::chip::Part;
use serde_json::Value;

use testkit::cargo::{self, workspace};

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
    let of_chip = ["--locked", "--features", chip.name()];
    let tree = cargo(
        &["tree", "--package", FIRMWARE, "--target", "thumbv7em-none-eabihf"],
        &[&of_chip[..], &["--edges", "no-dev,no-build,no-proc-macro", "--prefix", "none"]].concat(),
    )?;
    let names: BTreeSet<(&str, &str)> = tree.lines().filter_map(name_and_version).collect();
    let metadata = cargo(
        &["metadata", "--format-version", "1", "--filter-platform", "thumbv7em-none-eabihf"],
        &of_chip,
    )?;
    let metadata: Value = serde_json::from_str(&metadata).context("the metadata of cargo")?;
    let lock = fs::read_to_string(workspace().join("Cargo.lock")).context("Cargo.lock")?;
    let checksums = checksums(&lock)?;

    let of_id: BTreeMap<&str, (String, String)> = array(&metadata["packages"])
        .map(|package| Ok((text(package, "id")?, key(package)?)))
        .collect::<anyhow::Result<_>>()?;
    let mut uses: BTreeMap<&str, BTreeSet<(String, String)>> = BTreeMap::new();
    for node in array(&metadata["resolve"]["nodes"]) {
        let used = array(&node["dependencies"]).filter_map(|id| of_id.get(id.as_str()?).cloned());
        let linked = used.filter(|(name, version)| names.contains(&(name, version)));
        uses.insert(text(node, "id")?, linked.collect());
    }
    let mut packages = Vec::new();
    for package in array(&metadata["packages"]) {
        let (name, version) = key(package)?;
        if !names.contains(&(&name, &version)) {
            continue;
        }
        let mut folder = PathBuf::from(text(package, "manifest_path")?);
        folder.pop();
        let licence =
            package["license"].as_str().with_context(|| format!("{name} has no licence"))?;
        packages.push(Package {
            licence: licence.replace('/', " OR "),
            repository: package["repository"].as_str().map(str::to_owned),
            checksum: checksums.get(&(name.clone(), version.clone())).cloned(),
            folder: Some(folder),
            uses: uses.remove(text(package, "id")?).unwrap_or_default(),
            name,
            version,
        });
    }
    if packages.len() != names.len() {
        bail!("cargo tree names {} packages, cargo metadata {}", names.len(), packages.len());
    }
    packages.push(core()?);
    packages.sort_by(|a, b| (&a.name, &a.version).cmp(&(&b.name, &b.version)));
    Ok(packages)
}

/// The package and its version in a line of `cargo tree`.
fn name_and_version(line: &str) -> Option<(&str, &str)> {
    let mut words = line.split_whitespace();
    Some((words.next()?, words.next()?.strip_prefix('v')?))
}

fn core() -> anyhow::Result<Package> {
    let rustc = env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let version = output(Command::new(rustc).arg("--version"))?;
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

/// The checksums of the packages in `Cargo.lock`.
fn checksums(lock: &str) -> anyhow::Result<BTreeMap<(String, String), String>> {
    let lock: toml::Table = lock.parse().context("Cargo.lock")?;
    let packages = lock["package"].as_array().context("Cargo.lock has no packages")?;
    let entries = packages.iter().filter_map(|package| {
        let text = |key: &str| package.get(key)?.as_str().map(str::to_owned);
        Some(((text("name")?, text("version")?), text("checksum")?))
    });
    Ok(entries.collect())
}

fn cargo(command: &[&str], arguments: &[&str]) -> anyhow::Result<String> {
    output(cargo::cargo().args(command).args(arguments))
}

fn output(command: &mut Command) -> anyhow::Result<String> {
    let name = command.get_program().display().to_string();
    let output =
        command.stdin(Stdio::null()).output().with_context(|| format!("cannot run {name}"))?;
    if !output.status.success() {
        bail!("{name} failed: {}", String::from_utf8_lossy(&output.stderr).trim_end());
    }
    String::from_utf8(output.stdout).with_context(|| format!("the output of {name}"))
}

fn array(value: &Value) -> impl Iterator<Item = &Value> {
    value.as_array().into_iter().flatten()
}

fn text<'a>(value: &'a Value, key: &str) -> anyhow::Result<&'a str> {
    value[key].as_str().with_context(|| format!("the metadata of cargo have no `{key}`"))
}

fn key(package: &Value) -> anyhow::Result<(String, String)> {
    Ok((text(package, "name")?.to_owned(), text(package, "version")?.to_owned()))
}
