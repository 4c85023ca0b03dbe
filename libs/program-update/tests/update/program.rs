//! Programs of a product, and what its devices take.

use program_update::{Expected, Header, Release, crc, header::text};

pub const RUN: u32 = 0x0801_0000;

/// What the devices take whose RUN has this length in bytes.
pub fn expected(run_len: u32) -> Expected {
    Expected {
        vendor_id: 0x1234,
        product_code: 0x5678,
        hardware: crc::of(b"board 1"),
        chip: text("stm32f405"),
        controller: 1,
        address: RUN,
        capacity: run_len - 512,
        ram: 0x2000_0000..0x2002_0000,
        allows_downgrade: true,
    }
}

/// The header of a program for these devices.
pub fn header_of(program: &[u8], release: Release) -> Header {
    Header {
        length: program.len() as u32,
        crc: crc::of(program),
        vendor_id: 0x1234,
        product_code: 0x5678,
        revision_number: 0x0001_0000,
        release,
        chip: text("stm32f405"),
        hardware: crc::of(b"board 1"),
        address: RUN,
        controller: 1,
        version: text("1.2.3"),
        sha256: [0; 32],
        signature: [0xFF; 64],
    }
}

/// The update file of a program of so many words: number `number`, unlike all others.
pub fn file(number: u8, words: usize) -> Vec<u8> {
    let mut program = vec![0; 4 * words];
    program[..4].copy_from_slice(&0x2001_FFE0u32.to_le_bytes());
    program[4..8].copy_from_slice(&(RUN + 0x209).to_le_bytes());
    for (i, byte) in program.iter_mut().enumerate().skip(8) {
        *byte = (i as u8).wrapping_mul(31) ^ number.wrapping_mul(57);
    }
    let release = Release::new(1, number.into(), 0).expect("small numbers");
    let mut file = header_of(&program, release).to_bytes().to_vec();
    file.extend(program);
    file
}

/// The words of bytes.
pub fn words(bytes: &[u8]) -> impl Iterator<Item = u32> {
    bytes.chunks(4).map(|word| u32::from_le_bytes(word.try_into().expect("whole words")))
}
