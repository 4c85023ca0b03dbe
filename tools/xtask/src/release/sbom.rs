//! The packages in the firmware as a software bill of materials, in CycloneDX 1.5 (ECMA-424): JSON without time and
//! random number, so that it is always the same.

use anyhow::Context;
use serde_json::{Value, json};

use super::packages::{CORE, FIRMWARE, Package};

/// The bill of materials of the program with this checksum.
pub fn of(packages: &[Package], sha256_of_elf: &str) -> anyhow::Result<String> {
    let is_firmware = |package: &&Package| package.name == FIRMWARE;
    let firmware = packages.iter().find(is_firmware).context("the firmware is no package")?;
    let core = packages.iter().find(|package| package.name == CORE).context("no core")?;
    let mut subject = component(firmware, "firmware");
    subject["hashes"] = hash(sha256_of_elf);
    let uses = packages.iter().map(|package| {
        let mut uses: Vec<_> =
            package.uses.iter().map(|(name, version)| reference(name, version)).collect();
        if package.name != CORE {
            uses.push(reference(&core.name, &core.version));
        }
        json!({ "ref": reference(&package.name, &package.version), "dependsOn": uses })
    });
    let bill = json!({
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": { "component": subject },
        "components": packages
            .iter()
            .filter(|package| !is_firmware(package))
            .map(|package| component(package, "library"))
            .collect::<Vec<_>>(),
        "dependencies": uses.collect::<Vec<_>>(),
    });
    Ok(serde_json::to_string_pretty(&bill)? + "\n")
}

fn component(package: &Package, kind: &str) -> Value {
    let Package { name, version, licence, repository, checksum, .. } = package;
    let mut component = json!({
        "type": kind,
        "bom-ref": reference(name, version),
        "name": name,
        "version": version,
        "licenses": [{ "expression": licence }],
    });
    if let Some(url) = repository {
        component["externalReferences"] = json!([{ "type": "vcs", "url": url }]);
    }
    // Those without a checksum are not in the registry.
    if let Some(checksum) = checksum {
        component["purl"] = format!("pkg:cargo/{name}@{version}").into();
        component["hashes"] = hash(checksum);
    }
    component
}

fn hash(sha256: &str) -> Value {
    json!([{ "alg": "SHA-256", "content": sha256 }])
}

fn reference(name: &str, version: &str) -> String {
    format!("{name}@{version}")
}
