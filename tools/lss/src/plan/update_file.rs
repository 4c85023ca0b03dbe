//! An update file, and whether it is for a board.

use std::{fs, path::Path};

use canopen_node::lss::Address;
use program_update::{
    Expected, Header, Status, crc,
    header::{Field, HEADER_LEN, check_file, text_of},
};
use serde::Serialize;

use crate::{
    failure::{Failure, Result},
    network::loader::words,
};

/// An update file that is complete.
pub struct UpdateFile {
    /// The header and the program.
    pub bytes: Vec<u8>,
    pub header: Header,
}

/// What the header says, for JSON.
#[derive(Serialize)]
pub struct Description {
    version: String,
    release: String,
    vendor_id: u32,
    product_code: u32,
    revision_number: u32,
    chip: String,
    length: u32,
    crc: u32,
}

impl UpdateFile {
    /// Reads a file, and checks all that it says of itself.
    pub fn read(path: &Path) -> Result<Self> {
        let refused = |why: String| Failure::Refused(format!("{}: {why}", path.display()));
        let bytes = fs::read(path).map_err(|error| refused(error.to_string()))?;
        let no_file = |status: Status| {
            let why = words(status.value(false));
            refused(format!("no update file, or a damaged one: {why}. Nothing was changed"))
        };
        let header = match bytes.first_chunk::<HEADER_LEN>() {
            None => Err(Status::Damaged(Field::Length)),
            Some(header) => Header::parse(header).map_err(Status::Refused),
        };
        let header = header.map_err(no_file)?;
        check_file(&bytes, &any_board(&header), None).map_err(no_file)?;
        Ok(Self { bytes, header })
    }

    /// The version and what it is for, in a line.
    pub fn words(&self) -> String {
        let Header { vendor_id, product_code, length, .. } = self.header;
        format!(
            "version {} ({}) for product {vendor_id:08X}:{product_code:08X} on {}, {} KB",
            text_of(&self.header.version),
            self.header.release,
            text_of(&self.header.chip),
            length.div_ceil(1024)
        )
    }

    pub fn description(&self) -> Description {
        let Header { vendor_id, product_code, revision_number, length, crc, .. } = self.header;
        Description {
            version: text_of(&self.header.version).to_owned(),
            release: self.header.release.to_string(),
            vendor_id,
            product_code,
            revision_number,
            chip: text_of(&self.header.chip).to_owned(),
            length,
            crc,
        }
    }

    /// Why the file is not for a board with this LSS address and this hardware version 1009h, in words. The board itself
    /// checks the rest.
    pub fn misfit(&self, address: &Address, hardware: &str) -> Option<String> {
        let expected = Expected {
            vendor_id: address.vendor_id,
            product_code: address.product_code,
            hardware: crc::of(hardware.as_bytes()),
            ..any_board(&self.header)
        };
        let status = self.header.check(&expected, None).err()?;
        Some(format!("{}, hardware \"{hardware}\"", words(status.value(false))))
    }
}

/// A board that takes the file, whatever it is for.
fn any_board(header: &Header) -> Expected {
    Expected {
        vendor_id: header.vendor_id,
        product_code: header.product_code,
        hardware: header.hardware,
        chip: header.chip,
        controller: header.controller,
        address: header.address,
        capacity: u32::MAX,
        ram: 0x1000_0000..0x3000_0000,
        allows_downgrade: true,
    }
}
