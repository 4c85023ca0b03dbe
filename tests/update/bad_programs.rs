//! Programs that fail: after three starts the one before is back.

use emulator::{Time, chip::FLASH_BASE, image::Image};
use testkit::product;

use super::{
    power_cut::Files,
    rig::{PART, RUN, Rig, board_with, file_of, program},
};

/// A program with this code at its first instruction.
pub fn with_first_instruction(program: &Image, code: u16) -> Image {
    let vectors = program.segments().next().expect("the vectors").1;
    let reset = u32::from_le_bytes(vectors[4..8].try_into().expect("four bytes")) & !1;
    patched(program, |address, bytes| {
        if let Some(at) = reset.checked_sub(address).filter(|at| (*at as usize) < bytes.len()) {
            bytes[at as usize..][..2].copy_from_slice(&code.to_le_bytes());
        }
    })
}

fn patched(program: &Image, patch: impl Fn(u32, &mut [u8])) -> Image {
    let segments = program.segments().map(|(address, bytes)| {
        let mut bytes = bytes.to_vec();
        patch(address, &mut bytes);
        (address, bytes)
    });
    Image::from_segments(segments.collect())
}

/// Installs a program that fails by itself; after three starts the old one is back.
fn fails(program: &Image, limit: Time) {
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    rig.load(&file_of(program, "0.2.0"), &mut Vec::new());
    let resets = rig.0.network.board(0).resets().len();
    assert!(rig.try_control(1).unwrap());
    rig.0.network.run_for(limit);
    rig.revive();
    assert_eq!(rig.version(), "0.1.0");
    assert_eq!(
        (rig.number(0x2001, 1), rig.number(0x2001, 2)),
        (4, 3),
        "restored after three starts"
    );
    // To start it, three failures, and the end of the restore.
    assert_eq!(rig.0.network.board(0).resets().len() - resets, 5);
    rig.check_settings();
    assert_eq!(rig.0.network.board(0).misuse(), None);
}

#[test]
fn a_program_that_hangs_at_once_has_three_starts_then_the_old_one_is_back() {
    const JUMP_TO_ITSELF: u16 = 0xE7FE;
    fails(&with_first_instruction(&program("0.2.0"), JUMP_TO_ITSELF), Time::from_s(12));
}

/// An undefined instruction.
pub const UNDEFINED: u16 = 0xDE00;

#[test]
fn a_program_that_faults_has_three_starts_then_the_old_one_is_back() {
    fails(&with_first_instruction(&program("0.2.0"), UNDEFINED), Time::from_s(4));
}

#[test]
fn a_program_that_never_feeds_the_watchdog_has_three_starts_then_the_old_one_is_back() {
    // The key that feeds it, 0xAAAA, in a MOVW.
    let is_key = |code: &[u8]| {
        code[0] == 0x4A && code[1] == 0xF6 && code[2] == 0xAA && code[3] & 0xF0 == 0x20
    };
    let program = patched(&program("0.2.0"), |_, bytes| {
        for at in (0..bytes.len().saturating_sub(3)).step_by(2) {
            if is_key(&bytes[at..at + 4]) {
                bytes[at..at + 3].copy_from_slice(&[0x40, 0xF2, 0x00]);
                bytes[at + 3] &= 0x0F;
            }
        }
    });
    fails(&program, Time::from_s(14));
}

#[test]
fn a_program_with_the_pins_of_another_controller_has_three_starts_then_the_old_one_is_back() {
    let program = product::build_program("astray", PART, 2, |_, content| content);
    let program = program.unwrap_or_else(|error| panic!("{error}"));
    // It waits without a bus for 60 s each time.
    fails(&program, Time::from_s(190));
}

#[test]
fn a_program_that_is_damaged_in_the_flash_is_replaced_by_the_one_before() {
    let files = Files::small();
    let mut rig = Rig::of(board_with(&files.old));
    rig.0.network.permit_misuse();
    rig.load(&files.new, &mut Vec::new());
    assert!(rig.try_control(1).unwrap());
    rig.0.expect("705: 00", Time::from_ms(500));
    assert!(rig.try_control(0x80).unwrap());
    rig.0.network.power_off(0);
    // The last byte of the program, which it does not use.
    let offset = RUN - FLASH_BASE + files.new.len() as u32 - 1;
    let byte = files.new.last().unwrap() ^ 0x10;
    rig.0.network.board_mut(0).set_flash(offset, &[byte]);
    rig.0.network.run_for(Time::from_ms(10));
    rig.0.network.power_on(0);
    rig.revive();
    assert_eq!(rig.version(), "0.1.0");
    rig.check_settings();
    assert_eq!(rig.0.network.board(0).misuse(), None);
}
