//! The header of an update file: 512 bytes before the program, in the file as in the flash.

use core::{fmt, ops::Range};

use crate::{Status, crc};

/// The length of the header in bytes.
pub const HEADER_LEN: usize = 512;
/// The bytes that the signature covers.
pub const SIGNED_LEN: usize = 252;
/// The first bytes of a header.
pub const MAGIC: [u8; 8] = *b"LSSPROG1";

const AFTER_SIGNATURE: usize = 320;

/// A field of the header. Its value is its offset in bytes, and what 1F57h shows in bits 16 to 31.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum Field {
    /// [`MAGIC`].
    Magic = 0,
    /// The length of the program.
    Length = 8,
    /// The CRC-32 of the program.
    Crc = 12,
    /// The vendor-ID.
    Vendor = 16,
    /// The product code.
    Product = 20,
    /// The revision number.
    Revision = 24,
    /// The release.
    Release = 28,
    /// The chip.
    Chip = 32,
    /// The CRC-32 of the hardware version 1009h.
    Hardware = 48,
    /// The address of the header in the flash; as the fault of a program: its stack pointer or reset vector.
    Address = 52,
    /// The CAN controller.
    Controller = 56,
    /// The software version 100Ah.
    Version = 60,
    /// The SHA-256 of the program.
    Hash = 92,
    /// The CRC-32 of the bytes before.
    HeaderCrc = 252,
    /// The Ed25519 signature of bytes 0 to 251.
    Signature = 256,
    /// The bytes after the signature, FFh.
    Rest = 320,
}

/// A release: major << 20 | minor << 10 | patch. A greater number is a later release.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Release(pub u32);

impl Release {
    /// The release with these numbers; `None` if `major` exceeds 4095, or another one 1023.
    pub const fn new(major: u32, minor: u32, patch: u32) -> Option<Self> {
        if major > 0xFFF || minor > 0x3FF || patch > 0x3FF {
            return None;
        }
        Some(Self(major << 20 | minor << 10 | patch))
    }

    /// The release of a software version such as `1.20.3`; `None` of any other text.
    pub fn parse(version: &str) -> Option<Self> {
        let mut numbers = version.split('.').map(|number| number.parse().ok());
        let [major, minor, patch] = [numbers.next()??, numbers.next()??, numbers.next()??];
        numbers.next().is_none().then(|| Self::new(major, minor, patch))?
    }
}

impl fmt::Display for Release {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}.{}", self.0 >> 20, self.0 >> 10 & 0x3FF, self.0 & 0x3FF)
    }
}

/// The fields of a header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// The length of the program in bytes, without the header: a multiple of four.
    pub length: u32,
    /// The CRC-32 of the program.
    pub crc: u32,
    /// The vendor-ID 1018h sub-index 1.
    pub vendor_id: u32,
    /// The product code 1018h sub-index 2.
    pub product_code: u32,
    /// The revision number 1018h sub-index 3.
    pub revision_number: u32,
    /// The release.
    pub release: Release,
    /// The chip, such as `stm32f405`: see [`text`].
    pub chip: [u8; 16],
    /// The CRC-32 of the text 1009h.
    pub hardware: u32,
    /// The address of the header in the flash: that of RUN.
    pub address: u32,
    /// The number of the CAN controller, from 1.
    pub controller: u32,
    /// The software version 100Ah: see [`text`].
    pub version: [u8; 32],
    /// The SHA-256 of the program.
    pub sha256: [u8; 32],
    /// The Ed25519 signature of bytes 0 to 251; FFh without one.
    pub signature: [u8; 64],
}

/// What a device takes.
#[derive(Clone, Debug)]
pub struct Expected {
    /// The vendor-ID 1018h sub-index 1.
    pub vendor_id: u32,
    /// The product code 1018h sub-index 2.
    pub product_code: u32,
    /// The CRC-32 of the text 1009h.
    pub hardware: u32,
    /// The chip, such as `stm32f405`: see [`text`].
    pub chip: [u8; 16],
    /// The number of the CAN controller, from 1.
    pub controller: u32,
    /// The address of RUN.
    pub address: u32,
    /// The greatest length of a program in bytes, without its header.
    pub capacity: u32,
    /// The addresses of the RAM that a stack may use.
    pub ram: Range<u32>,
    /// Whether a lower release than that of the program before is taken.
    pub allows_downgrade: bool,
}

/// Whether a loader takes only signed programs.
pub trait Verify {
    /// With true the loader asks for [`Action::Verify`](crate::Action::Verify) and [`Action::Hash`](crate::Action::Hash).
    const IS_SIGNED: bool;
}

/// No check of signatures: whoever can send frames can install a program.
#[derive(Clone, Copy, Debug, Default)]
pub struct Unsigned;

impl Verify for Unsigned {
    const IS_SIGNED: bool = false;
}

/// Only programs with the signature of one key, whose check takes too long for [`Updater::poll`](crate::Updater::poll).
#[derive(Clone, Copy, Debug, Default)]
pub struct Signed;

impl Verify for Signed {
    const IS_SIGNED: bool = true;
}

/// A text in a field: the bytes of `text` as far as there is room, then zeros.
pub const fn text<const N: usize>(text: &str) -> [u8; N] {
    let bytes = text.as_bytes();
    let mut field = [0; N];
    let mut i = 0;
    while i < N && i < bytes.len() {
        field[i] = bytes[i];
        i += 1;
    }
    field
}

/// The text in a field; empty if it is not UTF-8.
pub fn text_of(field: &[u8]) -> &str {
    let text = field.split(|byte| *byte == 0).next().unwrap_or_default();
    core::str::from_utf8(text).unwrap_or_default()
}

impl Header {
    /// The header in the file and in the flash.
    #[must_use]
    pub fn to_bytes(&self) -> [u8; HEADER_LEN] {
        let mut bytes = [0xFF; HEADER_LEN];
        let mut put = |field: Field, value: &[u8]| {
            let to = bytes.iter_mut().skip(field as usize);
            to.zip(value).for_each(|(to, from)| *to = *from);
        };
        put(Field::Magic, &MAGIC);
        put(Field::Length, &self.length.to_le_bytes());
        put(Field::Crc, &self.crc.to_le_bytes());
        put(Field::Vendor, &self.vendor_id.to_le_bytes());
        put(Field::Product, &self.product_code.to_le_bytes());
        put(Field::Revision, &self.revision_number.to_le_bytes());
        put(Field::Release, &self.release.0.to_le_bytes());
        put(Field::Chip, &self.chip);
        put(Field::Hardware, &self.hardware.to_le_bytes());
        put(Field::Address, &self.address.to_le_bytes());
        put(Field::Controller, &self.controller.to_le_bytes());
        put(Field::Version, &self.version);
        put(Field::Hash, &self.sha256);
        put(Field::Signature, &self.signature);
        let crc = crc::of(signed(&bytes)).to_le_bytes();
        bytes.iter_mut().skip(Field::HeaderCrc as usize).zip(crc).for_each(|(to, from)| *to = from);
        bytes
    }

    /// The header in these bytes.
    ///
    /// # Errors
    /// The magic bytes, the CRC of the header or the bytes after the signature are wrong.
    pub fn parse(bytes: &[u8; HEADER_LEN]) -> Result<Self, Field> {
        let header = Self {
            length: word(bytes, Field::Length),
            crc: word(bytes, Field::Crc),
            vendor_id: word(bytes, Field::Vendor),
            product_code: word(bytes, Field::Product),
            revision_number: word(bytes, Field::Revision),
            release: Release(word(bytes, Field::Release)),
            chip: part(bytes, Field::Chip as usize),
            hardware: word(bytes, Field::Hardware),
            address: word(bytes, Field::Address),
            controller: word(bytes, Field::Controller),
            version: part(bytes, Field::Version as usize),
            sha256: part(bytes, Field::Hash as usize),
            signature: part(bytes, Field::Signature as usize),
        };
        if part(bytes, Field::Magic as usize) != MAGIC {
            Err(Field::Magic)
        } else if word(bytes, Field::HeaderCrc) != crc::of(signed(bytes)) {
            Err(Field::HeaderCrc)
        } else if bytes.iter().skip(AFTER_SIGNATURE).any(|byte| *byte != 0xFF) {
            Err(Field::Rest)
        } else {
            Ok(header)
        }
    }

    /// Checks each field against what a device takes. `installed` is the release of its program, if it has one.
    ///
    /// # Errors
    /// The first field that does not fit: [`Status::Refused`] or [`Status::TooLong`].
    pub fn check(&self, expected: &Expected, installed: Option<Release>) -> Result<(), Status> {
        let is_lower = installed.is_some_and(|installed| self.release < installed);
        let checks = [
            (Field::Vendor, self.vendor_id == expected.vendor_id),
            (Field::Product, self.product_code == expected.product_code),
            (Field::Hardware, self.hardware == expected.hardware),
            (Field::Chip, self.chip == expected.chip),
            (Field::Controller, self.controller == expected.controller),
            (Field::Address, self.address == expected.address),
            (Field::Length, self.length >= 8 && self.length.is_multiple_of(4)),
            (Field::Release, expected.allows_downgrade || !is_lower),
        ];
        match checks.into_iter().find(|(_, fits)| !fits) {
            Some((field, _)) => Err(Status::Refused(field)),
            None if self.length > expected.capacity => Err(Status::TooLong),
            None => Ok(()),
        }
    }

    /// Checks the first two words of the program: the stack pointer and the reset vector.
    ///
    /// # Errors
    /// The stack is not in the RAM, or the vector leads to no code of the program: [`Status::Damaged`].
    pub fn check_vectors(
        &self,
        expected: &Expected,
        stack_pointer: u32,
        reset: u32,
    ) -> Result<(), Status> {
        let ram = &expected.ram;
        let has_stack = stack_pointer.is_multiple_of(8)
            && ram.start < stack_pointer
            && stack_pointer <= ram.end;
        let code = reset.wrapping_sub(self.address).wrapping_sub(HEADER_LEN as u32);
        if has_stack && reset & 1 == 1 && code >= 8 && code < self.length {
            Ok(())
        } else {
            Err(Status::Damaged(Field::Address))
        }
    }
}

/// Checks a whole update file as a device would, but for its signature and hash.
///
/// # Errors
/// What the device would show in 1F57h.
pub fn check_file(
    file: &[u8],
    expected: &Expected,
    installed: Option<Release>,
) -> Result<Header, Status> {
    let (bytes, program) = file.split_first_chunk().ok_or(Status::Damaged(Field::Length))?;
    let header = Header::parse(bytes).map_err(Status::Refused)?;
    header.check(expected, installed)?;
    if program.len() != header.length as usize {
        return Err(Status::Damaged(Field::Length));
    }
    if crc::of(program) != header.crc {
        return Err(Status::Damaged(Field::Crc));
    }
    let vector = |at| u32::from_le_bytes(part(program, at));
    header.check_vectors(expected, vector(0), vector(4))?;
    Ok(header)
}

/// The bytes that the signature and the CRC of the header cover.
pub(crate) fn signed(header: &[u8; HEADER_LEN]) -> &[u8; SIGNED_LEN] {
    header.first_chunk().unwrap_or(&[0; SIGNED_LEN])
}

fn word(header: &[u8; HEADER_LEN], field: Field) -> u32 {
    u32::from_le_bytes(part(header, field as usize))
}

/// The bytes from an offset on.
fn part<const N: usize>(bytes: &[u8], offset: usize) -> [u8; N] {
    bytes.get(offset..).and_then(<[u8]>::first_chunk).copied().unwrap_or([0; N])
}
