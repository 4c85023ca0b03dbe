//! A firmware image: the flash content of an ELF file, and its symbols.

use std::{collections::HashMap, fmt, fs, io, path::Path, sync::Arc};

use object::{
    Object, ObjectSymbol,
    elf::{FileHeader32, PT_LOAD},
    endian::Endianness,
    read::elf::{ElfFile32, FileHeader, ProgramHeader},
};

use crate::chip::FLASH_BASE;

/// A linked program. Clones share the content.
#[derive(Clone, Debug)]
pub struct Image(Arc<Content>);

#[derive(Debug)]
struct Content {
    segments: Vec<(u32, Vec<u8>)>,
    symbols: HashMap<String, u32>,
    elf: Vec<u8>,
}

fn malformed(error: impl fmt::Display) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, format!("not a firmware image: {error}"))
}

impl Image {
    /// Reads an ELF file.
    ///
    /// # Errors
    /// The file cannot be read, or [`from_elf`](Self::from_elf) refuses it.
    pub fn load(path: impl AsRef<Path>) -> io::Result<Self> {
        let path = path.as_ref();
        let image = fs::read(path).and_then(|bytes| Self::from_elf(&bytes));
        image.map_err(|error| {
            io::Error::new(error.kind(), format!("cannot read {}: {error}", path.display()))
        })
    }

    /// Parses the content of an ELF file.
    ///
    /// # Errors
    /// It is not a 32-bit ELF file.
    pub fn from_elf(bytes: &[u8]) -> io::Result<Self> {
        let header = FileHeader32::<Endianness>::parse(bytes).map_err(malformed)?;
        let endian = header.endian().map_err(malformed)?;
        let mut segments = Vec::new();
        for program in header.program_headers(endian, bytes).map_err(malformed)? {
            let data = program
                .data(endian, bytes)
                .map_err(|()| malformed("a segment lies outside of the file"))?;
            if program.p_type(endian) == PT_LOAD && !data.is_empty() {
                segments.push((program.p_paddr(endian), data.to_vec()));
            }
        }
        let file = ElfFile32::<Endianness>::parse(bytes).map_err(malformed)?;
        let symbols = file
            .symbols()
            .filter_map(|symbol| Some((symbol.name().ok()?.to_owned(), symbol.address() as u32)))
            .collect();
        Ok(Self(Arc::new(Content { segments, symbols, elf: bytes.to_vec() })))
    }

    /// An image of the given bytes and addresses, without symbols.
    pub fn from_segments(segments: Vec<(u32, Vec<u8>)>) -> Self {
        Self(Arc::new(Content { segments, symbols: HashMap::new(), elf: Vec::new() }))
    }

    /// The address and content of each segment.
    pub fn segments(&self) -> impl Iterator<Item = (u32, &[u8])> {
        self.0.segments.iter().map(|(address, bytes)| (*address, bytes.as_slice()))
    }

    pub fn symbol(&self, name: &str) -> Option<u32> {
        self.0.symbols.get(name).copied()
    }

    /// The last symbol of the program at or before an address, and its distance.
    pub fn symbol_at(&self, address: u32) -> Option<(&str, u32)> {
        let symbols = self.0.symbols.iter().filter(|(name, _)| !name.starts_with('$'));
        let before = symbols.filter_map(|(name, start)| {
            // Bit 0 of a function's address gives the instruction set.
            let offset = address.checked_sub(start & !1)?;
            (*start >= FLASH_BASE).then_some((offset, name.as_str()))
        });
        before.min().map(|(offset, name)| (name, offset))
    }

    /// The ELF file; empty if it was made of segments.
    pub fn elf(&self) -> &[u8] {
        &self.0.elf
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_is_no_elf_is_refused_with_a_reason() {
        let error = Image::from_elf(b"#!/bin/sh").expect_err("no image");
        assert!(error.to_string().starts_with("not a firmware image: "), "{error}");
    }

    #[test]
    fn a_file_that_is_missing_or_no_elf_is_named() {
        for file in ["no/such/file", "Cargo.toml"] {
            let error = Image::load(file).expect_err("no image");
            assert!(error.to_string().starts_with(&format!("cannot read {file}: ")), "{error}");
        }
    }
}
