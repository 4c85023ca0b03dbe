//! The settings log in a working flash: results of open, written records, refused stores.

use canopen_node::{
    BitRate, NodeId, Settings,
    settings::{Error, Found, Log},
};
use testkit::{
    flash::{BoardFlash, Flash},
    random::Random,
    settings::{flash_with, open, record, sealed, settings},
};

/// The number of records in a bank of 16 KB.
const RECORDS: u16 = 512;

#[test]
fn a_new_device_is_blank_once_and_has_no_settings() {
    let flash = BoardFlash::blank(0);
    assert_eq!(open(&flash), (None, Found::Blank));
    assert_eq!(open(&flash), (None, Found::Complete));
}

#[test]
fn stored_settings_are_found_at_the_next_open() {
    let flash = BoardFlash::blank(0);
    for node_id in [1, 2, 0x40, 0x7E, 0x7F, 0xFF] {
        for bit_rate in BitRate::ALL {
            for heartbeat_ms in [0, 1, 0xFF, 0x100, u16::MAX] {
                let node_id = NodeId::from_lss(node_id).unwrap();
                let settings = Settings::new(bit_rate.into())
                    .with_node_id(node_id)
                    .with_heartbeat_ms(heartbeat_ms);
                let (mut log, _) = Log::open(flash.clone());
                assert_eq!(log.store(settings), Ok(()));
                assert_eq!(log.settings(), Some(settings));
                assert_eq!(open(&flash), (Some(settings), Found::Complete));
            }
        }
    }
}

#[test]
fn the_record_in_flash_is_the_documented_one() {
    let flash = BoardFlash::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    assert_eq!(flash.content()[..4], [0, 2, 0, 0], "the sequence");
    assert_eq!(flash.content()[4..8], [0xFF, 0xFD, 0xFF, 0xFF], "its complement");
    assert_eq!(flash.content()[8..28], [0xFF; 20]);
    assert_eq!(&flash.content()[28..32], b"LSSE");
    assert_eq!(flash.content()[32..64], record(513, 0, 0xFF, 0xFF, 0xFFFF));
    log.store(
        Settings::new(BitRate::Kbit500.into()).with_node_id(NodeId::new(5)).with_heartbeat_ms(1000),
    )
    .unwrap();
    assert_eq!(flash.content()[64..96], record(514, 1, 5, 2, 1000));
    log.store(Settings::new(BitRate::Kbit10.into())).unwrap();
    assert_eq!(flash.content()[96..128], record(515, 1, 0xFF, 8, 0));
}

#[test]
fn settings_that_are_stored_already_are_not_written() {
    let flash = BoardFlash::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    log.store(settings(1)).unwrap();
    let writes = flash.writes();
    assert_eq!(log.store(settings(1)), Ok(()));
    assert_eq!(flash.writes(), writes);
    let (mut log, _) = Log::open(flash.clone());
    let writes = flash.writes();
    assert_eq!(log.store(settings(1)), Ok(()));
    assert_eq!(flash.writes(), writes);
    log.store(settings(2)).unwrap();
    log.store(settings(1)).unwrap();
    assert_eq!(open(&flash).0, Some(settings(1)), "not unchanged: 2 was in between");
}

#[test]
fn a_start_after_a_store_writes_nothing() {
    let flash = BoardFlash::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    for n in 1..5 {
        log.store(settings(n)).unwrap();
        let writes = flash.writes();
        (log, _) = Log::open(flash.clone());
        assert_eq!((flash.writes(), flash.erases()), (writes, 2));
        assert_eq!(log.settings(), Some(settings(n)));
    }
}

#[test]
fn a_start_appends_a_record_without_its_last_word_once_more_and_the_next_writes_nothing() {
    let flash = BoardFlash::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    for n in 1..5 {
        log.store(settings(2 * n)).unwrap();
        flash.cut_power_after(7);
        assert_eq!(log.store(settings(2 * n + 1)), Err(Error::Refused));
        flash.power_on();
        let end = 32 * usize::from(3 * n + 1);
        (end - 4..end).for_each(|at| flash.corrupt(at, 0xFF));
        let writes = flash.writes();
        Log::open(flash.clone());
        assert_eq!(flash.writes(), writes + 8, "a record");
        (log, _) = Log::open(flash.clone());
        assert_eq!((flash.writes(), flash.erases()), (writes + 8, 2));
        assert_eq!(log.settings(), Some(settings(2 * n + 1)));
    }
}

#[test]
fn full_banks_refuse_a_store_and_the_next_open_makes_room() {
    let flash = BoardFlash::blank(0);
    // Each bank begins with a mark, and in a new device a record of the defaults follows.
    let mut room = RECORDS - 2 + RECORDS - 1;
    for erases in 2..5 {
        let (mut log, _) = Log::open(flash.clone());
        assert_eq!(flash.erases(), erases);
        for n in 1..=room {
            assert_eq!(log.store(settings(n)), Ok(()), "{n}");
        }
        assert_eq!(log.store(settings(room + 1)), Err(Error::Full));
        assert_eq!(log.settings(), Some(settings(room)));
        assert_eq!(log.store(settings(room)), Ok(()), "which are unchanged");
        assert_eq!(flash.erases(), erases, "store never erases");
        assert_eq!(open(&flash.duplicate(0)), (Some(settings(room)), Found::Complete));
        // The next start erases the bank without the last record.
        room = RECORDS - 1;
    }
}

#[test]
fn open_erases_only_after_the_log_has_moved_to_the_other_bank() {
    let flash = BoardFlash::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    // The mark and the record of defaults.
    for n in 2..RECORDS {
        log.store(settings(n)).unwrap();
        Log::open(flash.duplicate(0));
    }
    let (content, erases) = (flash.content(), flash.erases());
    log.store(settings(0)).unwrap();
    assert_eq!(flash.content()[..0x4000], content[..0x4000], "the bank is full");
    for _ in 0..2 {
        assert_eq!(open(&flash), (Some(settings(0)), Found::Complete));
        assert_eq!(flash.erases(), erases + 1, "once");
    }
}

#[test]
fn a_log_of_an_earlier_version_is_continued() {
    for number in [1, 2, 300, 511, 512] {
        let earlier: Vec<_> = (0..number)
            .map(|n| (0, n, record(n as u32 + 1, 1, n as u8 % 127 + 1, 2, n as u16)))
            .chain([(1, 0, record(1, 1, 1, 1, 1))])
            .collect();
        let flash = flash_with::<4, 0x4000>(&earlier);
        let (mut log, found) = Log::open(flash.clone());
        assert_eq!(log.settings().unwrap().heartbeat_ms, number as u16 - 1);
        assert_eq!((found, flash.erases()), (Found::Complete, 1));
        for n in 1..500 {
            assert_eq!(log.store(settings(n)), Ok(()), "{number} {n}");
        }
        assert_eq!(open(&flash), (Some(settings(499)), Found::Complete));
    }
}

#[test]
fn the_newer_bank_counts_even_where_the_sequence_wraps() {
    for older in [1, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFE, 0xFFFF_FFFF] {
        for newer_by in [1u32, 2, 600] {
            for bank in [0, 1] {
                let flash = flash_with::<4, 0x4000>(&[
                    (1 - bank, 100, record(older, 1, 5, 2, 5)),
                    (bank, 0, record(older.wrapping_add(newer_by), 1, 6, 2, 6)),
                ]);
                let (mut log, _) = Log::open(flash.clone());
                assert_eq!(log.settings().unwrap().heartbeat_ms, 6, "{older:#x} + {newer_by}");
                for n in 10..1_000 {
                    if log.store(settings(n)).is_err() {
                        (log, _) = Log::open(flash.clone());
                        log.store(settings(n)).unwrap();
                    }
                }
                assert_eq!(open(&flash).0, Some(settings(999)));
            }
        }
    }
}

#[test]
fn a_record_with_any_bit_wrong_does_not_count_and_the_one_before_does() {
    let old = record(8, 1, 4, 3, 4);
    for byte in 0..32 {
        for bit in 0..8 {
            let mut new = record(9, 1, 5, 2, 5);
            new[byte] ^= 1 << bit;
            let flash = flash_with::<4, 128>(&[(0, 0, old), (0, 1, new)]);
            let (mut log, found) = Log::open(flash.clone());
            // The last word was only not completed if a bit of it is 1.
            let counts = byte >= 28 && new[byte] & 1 << bit != 0;
            let (heartbeat_ms, result) =
                if counts { (5, Found::Complete) } else { (4, Found::Interrupted) };
            assert_eq!(found, result, "byte {byte}, bit {bit}");
            assert_eq!(log.settings().unwrap().heartbeat_ms, heartbeat_ms);
            assert_eq!(log.store(settings(6)), Ok(()), "after it, not over it");
            assert_eq!(open(&flash), (Some(settings(6)), Found::Complete));
        }
    }
}

#[test]
fn a_record_of_illegal_settings_does_not_count() {
    for wrong in [
        record(9, 1, 0x00, 2, 5),
        record(9, 1, 0x80, 2, 5),
        record(9, 1, 0xFE, 2, 5),
        record(9, 1, 5, 5, 5),
        record(9, 1, 5, 10, 5),
        record(9, 1, 5, 0xFF, 5),
        record(9, 2, 5, 2, 5),
        record(9, 0xFF, 5, 2, 5),
    ] {
        let flash = flash_with::<4, 128>(&[(0, 0, record(8, 1, 4, 3, 4)), (0, 1, wrong)]);
        assert_eq!(open(&flash).0.unwrap().heartbeat_ms, 4, "{wrong:02X?}");
    }
}

#[test]
fn a_record_of_a_later_versions_kind_is_skipped_and_left_unchanged() {
    let later = record(9, 2, 5, 2, 5);
    let flash = flash_with::<4, 256>(&[(0, 0, record(8, 1, 4, 3, 4)), (0, 1, later)]);
    let (mut log, found) = Log::open(flash.clone());
    assert_eq!((log.settings().unwrap().heartbeat_ms, found), (4, Found::Interrupted));
    assert_eq!(log.store(settings(6)), Ok(()));
    assert_eq!(flash.content()[32..64], later);
    assert_eq!(open(&flash), (Some(settings(6)), Found::Complete));
    assert_eq!(open(&flash_with::<4, 256>(&[(0, 0, later)])), (None, Found::Damaged));
}

#[test]
fn unused_bytes_of_a_record_may_have_any_value() {
    let mut later = record(9, 1, 5, 2, 5);
    later[7] = 0x00;
    later[22..24].fill(0x5A);
    let flash = flash_with::<4, 256>(&[(0, 0, record(8, 1, 4, 3, 4)), (0, 1, sealed(later))]);
    let (settings, found) = open(&flash);
    assert_eq!((settings.unwrap().heartbeat_ms, found), (5, Found::Complete));
}

#[test]
fn garbage_means_defaults_and_is_formatted() {
    let mut random = Random::from_environment();
    let mut contents = vec![vec![0; 0x8000], vec![0x5A; 0x8000]];
    // Another program's data in one bank, the other blank.
    contents.push([vec![0x11; 0x4000], vec![0xFF; 0x4000]].concat());
    contents.push([vec![0xFF; 0x7FFF], vec![0xFE]].concat());
    contents.push((0..0x8000).map(|_| random.byte()).collect());
    for content in contents {
        let flash = BoardFlash::with_content(content, 0);
        let (mut log, found) = Log::open(flash.clone());
        assert_eq!((log.settings(), found), (None, Found::Damaged));
        assert_eq!(log.store(settings(1)), Ok(()));
        assert_eq!(open(&flash), (Some(settings(1)), Found::Complete));
    }
}

/// Difficult flash contents: valid records, records with errors, and noise, in any place.
fn any_content<const E: usize>(random: &mut Random) -> Vec<u8> {
    let mut content = Vec::new();
    let any = random.u32();
    let first = random.pick(&[0, 1, 0x7FFF_FFFF, 0x8000_0000, u32::MAX, any]);
    while content.len() < 2 * E {
        let sequence = first.wrapping_add(random.within(0..1_000) as u32);
        let mut record = record(
            sequence,
            random.byte() % 3,
            random.byte(),
            random.byte() % 10,
            random.u64() as u16,
        );
        match random.within(0..4) {
            0 => record = [0xFF; 32],
            1 => record = random.bytes(),
            2 => record[random.within(0..32) as usize] ^= random.byte(),
            _ => {}
        }
        content.extend(record);
    }
    content
}

#[test]
fn with_any_flash_content_open_ends_and_settings_stored_then_are_found() {
    let mut random = Random::from_environment();
    for _ in 0..5_000 {
        let flash = Flash::<4, 128>::with_content(any_content::<128>(&mut random), random.u64());
        let (mut log, found) = Log::open(flash.clone());
        assert!(!matches!(found, Found::MediumFailed(_)));
        assert_eq!(log.settings(), open(&flash.duplicate(0)).0, "the result stays the same");
        let settings = settings(random.u64() as u16);
        assert_eq!(log.store(settings), Ok(()), "open has made room");
        assert_eq!(open(&flash).0, Some(settings));
    }
}

#[test]
fn a_flash_with_room_for_one_record_a_bank_is_of_no_use_but_does_no_harm() {
    let flash = Flash::<4, 32>::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    assert_eq!(log.store(settings(1)), Err(Error::Full));
    assert_eq!(open(&flash).0, None);
}
