//! Update files for these boards.

use program_update::{Header, Release, crc, header::text};
use testkit::node_rig::ADDRESS;

/// The address of RUN.
pub const RUN: u32 = 0x0801_0000;

/// What a program does; it is its third word.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Good = 0,
    /// Its watchdog resets it.
    Hangs = 1,
    /// It does not accept the confirmation.
    RefusesConfirmation = 2,
}

/// A file with a program of `len` bytes, whose header `change` changes.
pub fn file_with(
    version: &str,
    kind: Kind,
    len: usize,
    change: impl FnOnce(&mut Header),
) -> Vec<u8> {
    let words = [0x2000_1000, RUN + 0x200 + 0x11, kind as u32];
    let mut program: Vec<u8> = words.into_iter().flat_map(u32::to_le_bytes).collect();
    program.extend(version.bytes().cycle().take(len - program.len()));
    file_of(&program, version, change)
}

/// A file with this program.
pub fn file_of(program: &[u8], version: &str, change: impl FnOnce(&mut Header)) -> Vec<u8> {
    let mut header = Header {
        length: program.len() as u32,
        crc: crc::of(program),
        vendor_id: ADDRESS.vendor_id,
        product_code: ADDRESS.product_code,
        revision_number: ADDRESS.revision_number,
        release: Release::new(1, 2, 3).expect("a release"),
        chip: text("stm32f405"),
        hardware: crc::of(b"A"),
        address: RUN,
        controller: 1,
        version: text(version),
        sha256: [0xFF; 32],
        signature: [0xFF; 64],
    };
    change(&mut header);
    [&header.to_bytes()[..], program].concat()
}
