//! The licence texts of the packages in the firmware.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, bail};

use super::packages::Package;

/// The copyright notices of packages that do not contain their licence text, from their repositories. All may be used under
/// the MIT licence.
const NOTICES: [(&str, &str); 7] = [
    ("core", "Copyright (c) The Rust Project Contributors"),
    (
        "cortex-m",
        "Copyright (c) 2016 Jorge Aparicio\nCopyright (c) 2016-2026 The Embedded Devices Working Group Developers",
    ),
    (
        "cortex-m-rt",
        "Copyright (c) 2016 Jorge Aparicio\nCopyright (c) 2016-2026 The Embedded Devices Working Group Developers",
    ),
    (
        "embedded-storage",
        "Copyright (c) 2020 Jonathan 'theJPster' Pallant\nCopyright (c) 2020 Mathias Koch\n\
         Copyright (c) 2020 Diego Barrios Romero",
    ),
    ("rtic", "Copyright (c) 2017-2019 The Real Time For the Masses developers"),
    ("stm32f4", "Copyright (c) 2017 Adam Greig"),
    ("void", "Copyright (c) 2015 The rust-void Developers"),
];

/// The list of the packages, and each text with the packages that it belongs to.
///
/// # Errors
/// A package has no text.
pub fn of(packages: &[Package]) -> anyhow::Result<String> {
    let mut list = String::from("This firmware contains these packages:\n\n");
    let mut texts: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for package in packages {
        let name = format!("{} {}", package.name, package.version);
        list += &format!("{name}: {}\n", package.licence);
        for text in texts_of(package, packages)? {
            texts.entry(text).or_default().push(name.clone());
        }
    }
    let mut texts: Vec<_> = texts.into_iter().collect();
    texts.sort_by(|a, b| a.1.cmp(&b.1));
    for (text, packages) in texts {
        let line = "=".repeat(80);
        list += &format!("\n{line}\n{}\n{line}\n\n{}\n", packages.join(", "), text.trim_end());
    }
    Ok(list)
}

/// The texts of a package: those in its folder, or in that of a package of the same repository, or the MIT licence with
/// its notice.
fn texts_of(package: &Package, packages: &[Package]) -> anyhow::Result<Vec<String>> {
    if let Some(texts) = texts_in_folder(package)? {
        return Ok(texts);
    }
    if let Some((_, notice)) = NOTICES.iter().find(|(name, _)| *name == package.name) {
        return Ok(vec![mit(notice, &package.licence)?]);
    }
    let beside = |other: &&Package| match &package.repository {
        Some(repository) => other.repository.as_ref() == Some(repository),
        // A package of this repository, as those of the registry have a checksum.
        None => package.checksum.is_none() && other.checksum.is_none(),
    };
    for other in packages.iter().filter(beside) {
        if let Some(texts) = texts_in_folder(other)? {
            return Ok(texts);
        }
    }
    bail!(
        "{} {} ({}) has no licence text: add its copyright notice to xtask/src/release/licences.rs",
        package.name,
        package.version,
        package.licence
    )
}

/// The licence texts in the folder of a package, if there is any.
fn texts_in_folder(package: &Package) -> anyhow::Result<Option<Vec<String>>> {
    let Some(folder) = &package.folder else { return Ok(None) };
    let mut paths = Vec::new();
    for entry in fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let entry = entry?;
        if entry.file_type()?.is_file() && is_licence(&entry.path()) {
            paths.push(entry.path());
        }
    }
    paths.sort();
    let read = |path: &PathBuf| {
        let text = fs::read_to_string(path).with_context(|| path.display().to_string())?;
        Ok(text.replace("\r\n", "\n"))
    };
    let texts = paths.iter().map(read).collect::<anyhow::Result<Vec<_>>>()?;
    Ok(Some(texts).filter(|texts| !texts.is_empty()))
}

fn is_licence(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let name = name.to_lowercase();
    ["licen", "copying", "copyright", "notice", "unlicense"]
        .iter()
        .any(|begin| name.starts_with(begin))
}

/// The MIT licence with this notice.
fn mit(notice: &str, licence: &str) -> anyhow::Result<String> {
    if !licence.split(" OR ").any(|licence| licence == "MIT") {
        bail!("the licence is {licence}, not MIT");
    }
    let own = include_str!("../../../LICENSE-MIT");
    let at = own.find("Permission is hereby granted").context("LICENSE-MIT has another text")?;
    Ok(format!("MIT License\n\n{notice}\n\n{}", &own[at..]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn package(name: &str, licence: &str) -> Package {
        Package {
            name: name.to_owned(),
            version: "1.0.0".to_owned(),
            licence: licence.to_owned(),
            repository: None,
            checksum: None,
            folder: None,
            uses: Default::default(),
        }
    }

    #[test]
    fn a_package_without_a_licence_text_is_refused() {
        let error = of(&[package("core", "MIT"), package("strange", "MIT")]).expect_err("no text");
        assert!(
            error.to_string().starts_with("strange 1.0.0 (MIT) has no licence text"),
            "{error}"
        );
        of(&[package("core", "BSD-3-Clause")]).expect_err("the notice is for the MIT licence");
    }

    #[test]
    fn a_text_of_several_packages_of_a_repository_is_there_once() {
        let folder = Some(Path::new(env!("CARGO_MANIFEST_DIR")).join(".."));
        let firmware = Package { folder, ..package("firmware", "MIT") };
        let list = of(&[firmware, package("library", "MIT"), package("void", "MIT")]);
        let list = list.expect("texts");
        assert_eq!(list.matches("The lss-slave contributors").count(), 1);
        assert!(list.contains("\nfirmware 1.0.0, library 1.0.0\n"), "{list}");
        let notice = "Copyright (c) 2015 The rust-void Developers\n\nPermission";
        assert!(list.contains(notice), "{list}");
    }
}
