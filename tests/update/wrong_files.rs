//! Files that are not for the board, or are damaged: none starts, and the status says why.

use program_update::{
    Status, crc,
    header::{Field, HEADER_LEN},
};
use testkit::sdo::Client;

use super::rig::{RUN, Rig, file};

const NOT_STORED: u32 = 0x0800_0020;
const HARDWARE: u32 = 0x0606_0000;
/// The reset vector of the program behind the header.
const RESET: usize = HEADER_LEN + 4;

/// The file with other bytes in a field of the header, whose own CRC is right again.
fn with_field(file: &[u8], field: Field, bytes: &[u8]) -> Vec<u8> {
    let mut file = file.to_vec();
    let at = field as usize;
    file[at..at + bytes.len()].copy_from_slice(bytes);
    if field != Field::HeaderCrc {
        seal(&mut file);
    }
    file
}

/// Corrects the CRC of the header.
fn seal(file: &mut [u8]) {
    let at = Field::HeaderCrc as usize;
    let crc = crc::of(&file[..at]).to_le_bytes();
    file[at..at + 4].copy_from_slice(&crc);
}

/// The file with another reset vector and stack pointer, whose CRCs are right.
fn with_vectors(file: &[u8], stack: u32, reset: u32) -> Vec<u8> {
    let mut file = file.to_vec();
    file[HEADER_LEN..RESET].copy_from_slice(&stack.to_le_bytes());
    file[RESET..RESET + 4].copy_from_slice(&reset.to_le_bytes());
    let crc = crc::of(&file[HEADER_LEN..]).to_le_bytes();
    with_field(&file, Field::Crc, &crc)
}

impl Rig {
    /// Downloads a file by blocks; `Err` is the abort code.
    fn download(&mut self, file: &[u8]) -> Result<(), u32> {
        let outcome = self.client().block_download(0x1F50, 1, file);
        self.0.send_all();
        self.0.collect(emulator::Time::from_ms(10));
        outcome
    }

    fn check_refused(&mut self, name: &str, file: &[u8], abort: u32, status: Status) {
        assert_eq!(self.download(file), Err(abort), "{name}");
        assert_eq!(self.number(0x1F57, 1), status.value(false), "{name}");
    }
}

#[test]
fn a_wrong_field_of_the_header_is_named_and_nothing_is_erased_or_written() {
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    assert!(rig.try_control(0).unwrap());
    let good = file("0.2.0");
    let operations = rig.operations();
    for (field, bytes) in [
        (Field::Magic, &b"LSSPROG2"[..]),
        (Field::Length, &[9, 0, 0, 0]),
        (Field::Vendor, &[1, 0, 0, 0]),
        (Field::Product, &[2, 0, 0, 0]),
        (Field::Chip, b"stm32f405\0"),
        (Field::Hardware, &[0; 4]),
        (Field::Address, &(RUN + 0x1_0000).to_le_bytes()),
        (Field::Controller, &[2, 0, 0, 0]),
        (Field::HeaderCrc, &[0; 4]),
        (Field::Rest, &[0]),
    ] {
        let file = with_field(&good, field, bytes);
        rig.check_refused(&format!("{field:?}"), &file, NOT_STORED, Status::Refused(field));
    }
    let too_long = with_field(&good, Field::Length, &(192u32 * 1024).to_le_bytes());
    rig.check_refused("too long", &too_long, NOT_STORED, Status::TooLong);
    assert_eq!(rig.operations(), operations);
    assert!(rig.try_control(1).unwrap());
    rig.revive();
    assert_eq!(rig.version(), "0.1.0");
}

#[test]
fn a_damaged_program_is_not_started_and_the_old_one_is_back() {
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    assert!(rig.try_control(0).unwrap());
    let good = file("0.2.0");
    let mut flipped = good.clone();
    *flipped.last_mut().unwrap() ^= 1;
    let vector = |at: usize| u32::from_le_bytes(*good[at..].first_chunk().unwrap());
    let (stack, reset) = (vector(HEADER_LEN), vector(RESET));
    let longer = [&good[..], &[0xFF; 4]].concat();
    for (name, file, field) in [
        ("a flipped bit", flipped, Field::Crc),
        ("cut short", good[..good.len() - 4].to_vec(), Field::Length),
        ("four bytes more", longer, Field::Length),
        ("no stack", with_vectors(&good, RUN, reset), Field::Address),
        ("a reset vector into the loader", with_vectors(&good, stack, 0x0800_0201), Field::Address),
        ("a reset vector without bit 0", with_vectors(&good, stack, reset & !1), Field::Address),
    ] {
        assert!(rig.try_control(3).unwrap());
        assert_eq!(rig.try_finish().unwrap(), 0, "{name}");
        rig.check_refused(name, &file, HARDWARE, Status::Damaged(field));
        assert!(!rig.try_control(1).unwrap(), "{name} is started");
        assert_eq!(rig.number(0x1F51, 1), 3, "{name}");
    }
    assert!(rig.try_control(2).unwrap());
    rig.revive();
    assert_eq!((rig.version().as_str(), rig.number(0x2001, 1)), ("0.1.0", 4));
    rig.check_settings();
    assert_eq!(rig.0.network.board(0).misuse(), None);
}
