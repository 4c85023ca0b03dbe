//! Programs of the computer that a command needs.

use std::{
    io,
    process::{Command, Stdio},
};

use anyhow::{Context, bail, ensure};

/// What `tool --version` says.
///
/// # Errors
/// The tool is missing, with advice how to get it, or does not run.
pub fn version(tool: &str, advice: &str) -> anyhow::Result<String> {
    match Command::new(tool).arg("--version").output() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            bail!("{tool} is missing. {advice}")
        }
        Err(error) => Err(error).context(format!("cannot run {tool}")),
        Ok(output) => Ok(String::from_utf8_lossy(&output.stdout).into_owned()),
    }
}

/// Runs a program, whose output is for the person.
///
/// # Errors
/// It does not run, or fails: what that means.
pub fn run(command: &mut Command, failure: &str) -> anyhow::Result<()> {
    let status = command.status();
    let status = status.with_context(|| format!("cannot run {}", name(command)))?;
    ensure!(status.success(), "{failure}: see above");
    Ok(())
}

/// The output of a program.
///
/// # Errors
/// It does not run, or fails.
pub fn output(command: &mut Command) -> anyhow::Result<String> {
    let output = command.stdin(Stdio::null()).output();
    let output = output.with_context(|| format!("cannot run {}", name(command)))?;
    let errors = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{} failed: {}", name(command), errors.trim_end());
    String::from_utf8(output.stdout).with_context(|| format!("the output of {}", name(command)))
}

fn name(command: &Command) -> String {
    command.get_program().display().to_string()
}
