//! The options of the command line. Five need no library for them, which would take 8 s of CPU of the first build.

use std::{ffi::OsString, path::PathBuf};

use anyhow::{Context, bail};
use emulator::chip::Part;

/// What `--help` prints.
pub const HELP: &str = "\
Show how a board is found, configured and power-cycled, frame by frame, on an
emulated CAN bus

The boards are emulated STM32F4s with the release firmware, one of them blank.
Fails if anything differs from CiA 305.

Usage: cargo demo [OPTIONS]

Options:
  --all             Show every frame of the Fastscan, not only the start and end
                    of its parts
  --chip <CHIP>     The chip on the boards; the README lists them all
                    [default: stm32f407]
  --svg <FILE>      Draw the switch of the bit rate as a timing diagram
  --candump <FILE>  Write the frames as `candump -l` does
  --pcap <FILE>     Write the frames as a capture for Wireshark. To see CANopen:
                    Decode As, CAN next level, or
                    `tshark -d can.subdissector,canopen`
  -h, --help        Print help
";

pub struct Arguments {
    pub all: bool,
    pub chip: Part,
    pub svg: Option<PathBuf>,
    pub candump: Option<PathBuf>,
    pub pcap: Option<PathBuf>,
}

impl Arguments {
    /// The options in these words; `None` if the help is asked for.
    ///
    /// # Errors
    /// An option is unknown, or has no value or a wrong one.
    pub fn parse(words: impl IntoIterator<Item = OsString>) -> anyhow::Result<Option<Self>> {
        let mut words = words.into_iter();
        let (chip, svg, candump, pcap) = (testkit::image::PART, None, None, None);
        let mut arguments = Self { all: false, chip, svg, candump, pcap };
        while let Some(word) = words.next() {
            let word = word.to_string_lossy();
            let (option, value) = match word.split_once('=') {
                Some((option, value)) => (option, Some(OsString::from(value))),
                None => (&*word, None),
            };
            let mut value = || {
                value
                    .clone()
                    .or_else(|| words.next())
                    .with_context(|| format!("{option} lacks its value"))
            };
            match option {
                "--all" => arguments.all = true,
                "--chip" => {
                    let name = value()?;
                    let name = name.to_string_lossy();
                    arguments.chip = name.parse().with_context(|| format!("--chip {name}"))?;
                }
                "--svg" => arguments.svg = Some(value()?.into()),
                "--candump" => arguments.candump = Some(value()?.into()),
                "--pcap" => arguments.pcap = Some(value()?.into()),
                "--help" | "-h" => return Ok(None),
                _ => bail!("there is no option {word}; `cargo demo --help` has all"),
            }
        }
        Ok(Some(arguments))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(words: &str) -> anyhow::Result<Option<Arguments>> {
        Arguments::parse(words.split_whitespace().map(OsString::from))
    }

    #[test]
    fn each_option_of_the_help_is_taken() {
        let words = "--all --chip stm32f446 --svg a --candump=b --pcap c";
        let arguments = parsed(words).expect("they are right").expect("no help");
        assert!(arguments.all && arguments.chip.name() == "stm32f446");
        let files = [arguments.svg, arguments.candump, arguments.pcap];
        assert_eq!(files, ["a", "b", "c"].map(|path| Some(PathBuf::from(path))));
        for word in words.split_whitespace().filter(|word| word.starts_with("--")) {
            assert!(HELP.contains(word.split('=').next().unwrap_or(word)));
        }
        assert!(HELP.contains(&format!("[default: {}]", testkit::image::PART.name())));
        assert!(parsed("--all -h").expect("help").is_none());
    }

    #[test]
    fn a_wrong_option_is_named() {
        for (words, fault) in [
            ("--every", "there is no option --every"),
            ("demo", "there is no option demo"),
            ("--pcap", "--pcap lacks its value"),
            ("--chip stm32f103", "--chip stm32f103: "),
        ] {
            let error = format!("{:#}", parsed(words).err().expect("it is wrong"));
            assert!(error.starts_with(fault), "{error}");
        }
    }
}
