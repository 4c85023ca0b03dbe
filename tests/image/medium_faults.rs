//! The release image on a failing flash: the store is refused, the old settings stay, the node continues, and logs why.

use emulator::chip::{Flash, StuckBits};

use crate::rig::*;

/// Sectors 1 and 2, which hold the settings.
const SECTORS: u32 = 0b110;
/// The place of the next record, behind two of the defaults, and a parameter and the settings of `about_to_store`.
const NEXT_RECORD: u32 = SETTINGS_OFFSET + 4 * PLACE as u32;
/// The places of a record's node-ID and commit word, behind the word that begins them.
const NODE_ID: u32 = 4 + 5;
const COMMIT_WORD: u32 = 4 + 28;
/// The places that a store tries to begin.
const TRIES: u32 = 5;
const HEARTBEAT: Time = Time::from_ms(30);
/// The reasons for a failed store, as logged.
const REPORTS_AN_ERROR: &str = "the flash reports an error";
const IS_NOT_BLANK: &str = "the flash is not blank where it was erased";
const READS_BACK_OTHERWISE: &str = "the flash reads back otherwise than written";

/// Node 40 with a heartbeat, in LSS configuration state and about to store node-ID 4.
fn about_to_store() -> ImageRig {
    let mut rig = node_40(30);
    rig.ask("04 01, 11 04", "11 00");
    rig
}

fn flash(rig: &ImageRig, change: impl FnOnce(&mut Flash)) {
    change(rig.network.board(0).chip().flash_mut());
}

/// Whether the board has logged an error with this text.
fn says(rig: &mut ImageRig, text: &str) -> bool {
    rig.log(0).iter().any(|line| line.level == "error" && line.text.starts_with(text))
}

/// Checks that LSS, SDO and heartbeat of node 40 still work.
fn assert_node_40_goes_on(rig: &mut ImageRig) {
    rig.ask("5E", "5E 40");
    rig.transmit(on_the_wire(&sdo::request(0x40, "40 17 10")));
    let sent = rig.collect(HEARTBEAT + Time::from_ms(5)).texts();
    for expected in ["5C0: 4B 17 10 00 1E 00 00 00", "740: 7F"] {
        assert!(sent.iter().any(|text| text == expected), "{expected}: {sent:?}");
    }
}

/// Checks that a store fails for the reason `why` and nothing else changes, now and after a power cycle.
fn assert_refuses(rig: &mut ImageRig, why: &str) {
    rig.ask("17", "17 02");
    let line = format!("the settings were not stored, the old ones stay: {why}");
    assert!(says(rig, &line), "{line}: {:#?}", rig.log(0));
    assert_node_40_goes_on(rig);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"], "{why}");
    rig.lss("04 01");
    assert_node_40_goes_on(rig);
}

#[test]
fn a_store_that_the_controller_refuses_is_an_error() {
    let mut rig = about_to_store();
    flash(&rig, |flash| flash.refuse_programs(TRIES as _));
    assert_refuses(&mut rig, REPORTS_AN_ERROR);
    assert!(says(&mut rig, "flash: the operation failed with FLASH_SR 0x80"));
}

#[test]
fn a_write_protected_flash_refuses_until_the_protection_is_gone() {
    let mut rig = about_to_store();
    flash(&rig, |flash| flash.protect_sectors(SECTORS));
    assert_refuses(&mut rig, REPORTS_AN_ERROR);
    assert!(says(&mut rig, "flash: not written, the sector is write-protected"));
    let mut client = rig.sdo_client(0x40);
    assert_eq!(client.download(0x1017, 0, &[0xE8, 3]), Ok(()));
    assert_eq!(client.download(0x1010, 1, b"save"), Err(0x0606_0000));
    flash(&rig, |flash| flash.protect_sectors(0));
    assert_stores(&mut rig);
}

#[test]
fn a_stuck_bit_costs_one_store_and_the_next_one_uses_other_cells() {
    for (byte, mask) in [(NODE_ID, 0b0000_0001), (COMMIT_WORD, 0b1000_0000)] {
        let mut rig = about_to_store();
        let stuck = StuckBits { offset: NEXT_RECORD + byte, mask, value: mask };
        flash(&rig, |flash| flash.add_stuck_bits(stuck));
        assert_refuses(&mut rig, READS_BACK_OTHERWISE);
        assert_stores(&mut rig);
    }
}

#[test]
fn places_that_are_not_blank_are_passed_over_and_five_of_them_cost_a_store() {
    for byte in [0, NODE_ID, COMMIT_WORD] {
        for places in [1, TRIES] {
            let mut rig = about_to_store();
            for place in 0..places {
                let offset = NEXT_RECORD + place * PLACE as u32 + byte;
                let stuck = StuckBits { offset, mask: 0b0000_0001, value: 0 };
                flash(&rig, |flash| flash.add_stuck_bits(stuck));
            }
            if places == TRIES {
                assert_refuses(&mut rig, IS_NOT_BLANK);
            }
            assert_stores(&mut rig);
        }
    }
}

#[test]
fn a_store_that_reads_back_differently_is_not_confirmed() {
    for words in [2, 9] {
        let mut rig = about_to_store();
        flash(&rig, |flash| flash.fail_programs(words));
        assert_refuses(&mut rig, READS_BACK_OTHERWISE);
        flash(&rig, |flash| flash.fail_programs(0));
        assert_stores(&mut rig);
    }
}

#[test]
fn a_new_board_whose_flash_cannot_be_erased_answers_and_refuses_to_store() {
    let mut board = blank_board(0);
    board.chip().flash_mut().protect_sectors(SECTORS);
    board.set_flash(SETTINGS_OFFSET, &[0x5A; 0x8000]);
    let mut rig = ImageRig::new(DEFAULT_BIT_RATE, [board]);
    for _ in 0..2 {
        assert!(says(&mut rig, "flash: not written, the sector is write-protected"));
        let line = format!("the flash failed, a store may fail too: {REPORTS_AN_ERROR}");
        assert!(says(&mut rig, &line));
        assert_eq!(rig.lss("4C, 04 01, 11 04, 17"), ["50", "11 00", "17 02"]);
        assert_eq!(rig.lss("04 00"), ["704: 00"], "it keeps the node-ID until the power fails");
        rig.power_cycle(0);
        assert_eq!(rig.collect(Time::from_ms(20)), SILENCE);
    }
}

/// Only the read-back reveals such an erase: the controller reports no error.
#[test]
fn an_incomplete_erase_loses_no_settings_and_is_repeated_at_power_on() {
    let content = flash_with(&[settings(0x40, BitRate::Kbit1000)]);
    let mut not_ready = 0;
    for seed in 0..8 {
        let mut board = board_with_flash(&content);
        board.set_flash(SETTINGS_OFFSET + 0x4000, &[0x5A; 0x4000]);
        board.chip().flash_mut().fail_erases(1, seed);
        let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
        assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"], "seed {seed}");
        let line = format!("the flash failed, a store may fail too: {IS_NOT_BLANK}");
        not_ready += u32::from(says(&mut rig, &line));
        rig.power_cycle(0);
        assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"], "seed {seed}");
        assert_stores(&mut rig);
    }
    assert_eq!(not_ready, 8);
}

#[test]
fn a_board_whose_flash_fails_at_the_start_still_has_its_settings() {
    let mut content = flash_with(&[settings(0x40, BitRate::Kbit1000)]);
    // A store that was cut off after its first word.
    content[5 * PLACE..][..8].copy_from_slice(&[0, 0, 0, 0, 0x9E, 1, 0, 0]);
    for stuck in [6 * PLACE as u32 + 4, 6 * PLACE as u32 + 4 + 28] {
        let board = board_with_flash(&content);
        // The next two places.
        for offset in [SETTINGS_OFFSET + stuck, SETTINGS_OFFSET + stuck + PLACE as u32] {
            let bits = StuckBits { offset, mask: 0b10_0000, value: 0b10_0000 };
            board.chip().flash_mut().add_stuck_bits(bits);
        }
        let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
        assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
        assert!(rig.has_logged("the flash failed, a store may fail too"));
    }
}
