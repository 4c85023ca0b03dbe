//! The files of a program: HEX and BIN, and the check that none of the files touches the settings.

use std::{collections::BTreeMap, ops::Range};

use anyhow::{bail, ensure};
use emulator::{chip::FLASH_BASE, image::Image};
use ihex::{Reader, Record};

use super::File;
use crate::{
    hex,
    image_rig::{SETTINGS_LENGTH, SETTINGS_OFFSET},
};

/// The sectors of the settings.
const SETTINGS: Range<u32> = {
    let start = FLASH_BASE + SETTINGS_OFFSET;
    start..start + SETTINGS_LENGTH as u32
};
/// The value of an erased byte.
const ERASED: u8 = 0xFF;

/// A part of the program: its first address and its bytes.
type Part = (u32, Vec<u8>);

/// The HEX file and the BIN files of a program, with their names. Fails if they differ, or if one has a byte for the
/// settings.
pub fn files(image: &Image, name: &str) -> anyhow::Result<Vec<File>> {
    let parts = parts(image)?;
    ensure!(!parts.is_empty(), "the program is empty");
    let borrowed: Vec<_> = parts.iter().map(|(address, bytes)| (*address, &bytes[..])).collect();
    let hex = hex::file(&borrowed);
    let mut bytes = BTreeMap::new();
    for (address, part) in &parts {
        insert(&mut bytes, *address, part)?;
    }
    ensure!(read_hex(&hex)? == bytes, "HEX and BIN files differ");
    let is_there = |(address, segment): (u32, &[u8])| {
        (address..).zip(segment).all(|(address, byte)| bytes.get(&address) == Some(byte))
    };
    ensure!(image.segments().all(is_there), "HEX and ELF files differ");
    let mut files = vec![(format!("{name}.hex"), hex.into_bytes())];
    files.extend(
        parts.into_iter().map(|(address, bytes)| (format!("{name}-{address:08X}.bin"), bytes)),
    );
    Ok(files)
}

/// The program before and after the settings, each without gaps.
fn parts(image: &Image) -> anyhow::Result<Vec<Part>> {
    let mut segments: Vec<_> = image.segments().collect();
    segments.sort();
    let mut parts: Vec<Part> = Vec::new();
    for (address, bytes) in segments {
        match parts.last_mut() {
            Some((start, part)) if (*start < SETTINGS.start) == (address < SETTINGS.start) => {
                let offset = (address - *start) as usize;
                ensure!(part.len() <= offset, "two segments overlap at {address:08X}");
                part.resize(offset, ERASED);
                part.extend_from_slice(bytes);
            }
            _ => parts.push((address, bytes.to_vec())),
        }
    }
    Ok(parts)
}

/// The bytes of a HEX file, by address.
pub fn read_hex(text: &str) -> anyhow::Result<BTreeMap<u32, u8>> {
    let mut bytes = BTreeMap::new();
    let mut upper = 0;
    for record in Reader::new(text) {
        match record? {
            Record::Data { offset, value } => {
                insert(&mut bytes, upper | u32::from(offset), &value)?
            }
            Record::ExtendedLinearAddress(address) => upper = u32::from(address) << 16,
            Record::EndOfFile => return Ok(bytes),
            other => bail!("unexpected record {other:?}"),
        }
    }
    bail!("no end of the HEX file")
}

/// Adds the bytes from `start` on. Fails if one is there already, or is for the settings.
fn insert(bytes: &mut BTreeMap<u32, u8>, start: u32, new: &[u8]) -> anyhow::Result<()> {
    for (address, byte) in (start..).zip(new) {
        ensure!(!SETTINGS.contains(&address), "{address:08X} belongs to the settings");
        ensure!(bytes.insert(address, *byte).is_none(), "{address:08X} is given twice");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const VECTORS: u32 = 0x0800_0000;
    const CODE: u32 = 0x0800_C000;

    fn image(segments: &[(u32, &[u8])]) -> Image {
        Image::from_segments(segments.iter().map(|(at, bytes)| (*at, bytes.to_vec())).collect())
    }

    #[test]
    fn the_parts_lie_before_and_after_the_settings_without_gaps() {
        let image = image(&[(CODE + 4, &[3, 4]), (VECTORS, &[1]), (CODE, &[2])]);
        let parts = parts(&image).expect("no overlap");
        assert_eq!(parts, [(VECTORS, vec![1]), (CODE, vec![2, 0xFF, 0xFF, 0xFF, 3, 4])]);
    }

    #[test]
    fn a_hex_file_reads_back_as_what_was_written() {
        let bytes: Vec<u8> = (0..=255).cycle().take(0x1_2345).collect();
        let parts = [(VECTORS, vec![7; 3]), (CODE + 5, bytes)];
        let borrowed = parts.each_ref().map(|(address, bytes)| (*address, &bytes[..]));
        let text = hex::file(&borrowed);
        assert!(text.starts_with(":020000040800F2\n"), "{}", &text[..40]);
        let read = read_hex(&text).expect("valid");
        assert_eq!(read.len(), 3 + 0x1_2345);
        for (start, bytes) in parts {
            assert!((start..).zip(bytes).all(|(address, byte)| read[&address] == byte));
        }
    }

    #[test]
    fn a_file_with_a_byte_for_the_settings_is_refused() {
        assert_eq!(SETTINGS, 0x0800_4000..0x0800_C000);
        for address in [SETTINGS.start, SETTINGS.end - 1] {
            let text = hex::file(&[(address, &[0xFF])]);
            let error = read_hex(&text).expect_err("a byte for the settings").to_string();
            assert_eq!(error, format!("{address:08X} belongs to the settings"));
        }
        for address in [SETTINGS.start - 1, SETTINGS.end] {
            read_hex(&hex::file(&[(address, &[0])])).expect("beside the settings");
        }
    }
}
