//! Programs of the computer that a command needs.

use std::{io, process::Command};

use anyhow::{Context, bail};

/// What `tool --version` says.
///
/// # Errors
/// The tool, which Debian has in `package`, is missing or does not run.
pub fn version(tool: &str, package: &str) -> anyhow::Result<String> {
    match Command::new(tool).arg("--version").output() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            bail!("{tool} is missing (Debian: apt-get install {package})")
        }
        Err(error) => Err(error).context(format!("cannot run {tool}")),
        Ok(output) => Ok(String::from_utf8_lossy(&output.stdout).into_owned()),
    }
}
