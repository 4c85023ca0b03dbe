//! The settings log in a working flash: results of open, written records, refused stores.

use canopen_node::{
    BitRate, NodeId, Settings,
    settings::{Error, Found, Log, parameters},
};
use testkit::{
    flash::{BoardFlash, Flash, Operation::Erase},
    power_cut::store,
    random::{Random, every},
    settings::{
        flash_with, open, open_with_parameters, parameters as packed, place, record, sealed,
        settings,
    },
    with_each_kind,
};

/// The length of a place in flash that is written in words, and its first bytes, which say that it was begun.
const PLACE: usize = 40;
const BEGUN: usize = 4;

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
            let node_id = NodeId::from_lss(node_id).unwrap();
            let settings = Settings::new(bit_rate.into()).with_node_id(node_id);
            let (mut log, _) = Log::open(flash.clone());
            assert_eq!(log.store(settings), Ok(()));
            assert_eq!(log.settings(), Some(settings));
            assert_eq!(open(&flash), (Some(settings), Found::Complete));
            assert_eq!(Log::<_, 0>::peek(flash.clone()), Some(settings), "one who only reads");
        }
    }
}

/// A record that says how the other bank is.
fn with_other_bank(mut record: [u8; 32], other_is: u8) -> [u8; 32] {
    record[22] = other_is;
    sealed(record)
}

#[test]
fn the_record_in_flash_is_the_documented_one() {
    let flash = BoardFlash::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    let place_at = |place: usize| flash.content()[place * PLACE..][..PLACE].to_vec();
    for (place, other_is) in [0, 2].into_iter().enumerate() {
        // The sequence begins with the number of places in a bank.
        let defaults = record(409 + place as u32, 0, 0xFF, 0xFF);
        let expected = testkit::settings::place::<4>(&with_other_bank(defaults, other_is));
        assert_eq!(place_at(place), expected, "used, erased");
    }
    log.store(Settings::new(BitRate::Kbit500.into()).with_node_id(NodeId::new(5))).unwrap();
    assert_eq!(place_at(2), place::<4>(&with_other_bank(record(411, 1, 5, 2), 2)));
    log.store(Settings::new(BitRate::Kbit10.into())).unwrap();
    assert_eq!(place_at(3), place::<4>(&with_other_bank(record(412, 1, 0xFF, 8), 2)));
    assert_eq!(flash.content()[4 * PLACE..], [0xFF; 0x8000 - 4 * PLACE]);
}

#[test]
fn the_place_in_flash_with_wide_units_is_the_documented_one() {
    let flash = Flash::<16, 0x800>::blank(0);
    let (mut log, ..) = open_with_parameters::<40, 16, 0x800>(&flash);
    let parameters = packed(5, 18);
    log.store_with_parameters(settings(5), &parameters).unwrap();

    let content = flash.content();
    let (part, stored) = (&content[2 * 64..3 * 64], &content[3 * 64..4 * 64]);
    assert_eq!(part[..16], [0; 16], "it is begun");
    assert_eq!(part[16..20], 34_u32.to_le_bytes(), "the sequence begins with the places of a bank");
    assert_eq!(part[20..44], parameters);
    assert_eq!(part[44..48], *b"\0\0SP");
    assert_eq!(part[48..], [0xFF; 16]);
    let mut expected = record(35, 1, 5, settings(5).bit_rate.index());
    expected[10..22].copy_from_slice(&stored[26..38]);
    assert_eq!(stored, place::<16>(&with_other_bank(expected, 2)));
    assert_eq!(content[4 * 64..], [0xFF; 0x1000 - 4 * 64]);
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
fn a_start_after_a_store_writes_nothing_with_any_unit() {
    with_each_kind!(|W, E| {
        let flash = Flash::<W, E>::blank_with_sectors(4, 0);
        assert_eq!(open(&flash), (None, Found::Blank));
        for n in 1..5 {
            let (mut log, found) = Log::open(flash.clone());
            assert_eq!(found, Found::Complete);
            log.store(settings(n)).unwrap();
            let steps = (flash.writes(), flash.erases());
            assert_eq!(open(&flash), (Some(settings(n)), Found::Complete));
            assert_eq!((flash.writes(), flash.erases()), steps);
        }
    });
}

#[test]
fn a_start_appends_a_record_that_is_not_certain_once_more_and_the_next_writes_nothing() {
    let flash = BoardFlash::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    for n in 1..5 {
        log.store(settings(2 * n)).unwrap();
        log.store(settings(2 * n + 1)).unwrap();
        // Behind the two records of the format.
        let end = PLACE * (2 + 3 * usize::from(n) - 1);
        (end - 4..end).for_each(|at| flash.corrupt(at, 0xFF));
        let writes = flash.writes();
        Log::open(flash.clone());
        assert_eq!(flash.writes(), writes + 10, "a record");
        (log, _) = Log::open(flash.clone());
        assert_eq!((flash.writes(), flash.erases()), (writes + 10, 2));
        assert_eq!(log.settings(), Some(settings(2 * n + 1)));
    }
}

#[test]
fn a_start_after_one_whose_erase_was_cut_writes_a_record_erases_and_writes_another() {
    // An earlier version wrote 1 in the second record.
    let records = [0, 1]
        .map(|place| (0, place, with_other_bank(record(409 + place as u32, 1, 5, 2), place as u8)));
    let flash: BoardFlash = flash_with(&[records[0], records[1], (1, 0, [0; 32])]);
    let stored = Settings::new(BitRate::Kbit500.into()).with_node_id(NodeId::new(5));
    assert_eq!(open(&flash), (Some(stored), Found::Complete));
    assert_eq!((flash.writes(), flash.erases()), (20, 1), "used, erased");
}

#[test]
fn of_two_banks_that_do_not_count_the_one_where_a_format_was_cut_is_erased_last() {
    const LEN: usize = 1024;
    let [old, new] = [u32::MAX, 0].map(|sequence| record(sequence, 0, 0xFF, 0xFF));
    let other = [0; 32];
    // Its erase can be cut, and make the record read as certain: then the log must be in the other bank.
    for (before, cut) in [(Some(old), new), (Some(other), new), (None, other)] {
        for bank in [0, 1] {
            let before = before.map(|before| (1 - bank, 0, before));
            let records: Vec<_> = before.into_iter().chain([(bank, 0, cut)]).collect();
            let flash = flash_with::<4, LEN>(&records);
            records.iter().for_each(|(bank, ..)| flash.corrupt(bank * LEN + PLACE - 1, 0xFF));
            let content = flash.content();
            flash.fail_after(Erase, 1);
            assert_eq!(open(&flash), (None, Found::MediumFailed(Error::Refused)));
            assert_eq!(flash.erases(), 2);
            let range = bank * LEN..(bank + 1) * LEN;
            assert!(flash.content()[range.clone()] == content[range], "bank {bank} is unchanged");
        }
    }
}

#[test]
fn a_start_leaves_eight_places_blank_however_many_there_were() {
    for used in 2..25 {
        let records = (0..used).map(|n| (0, n, record(100 + n as u32, 1, 5, 2)));
        let records: Vec<_> = records.chain([(1, 0, [0; 32])]).collect();
        let flash = flash_with::<4, 1024>(&records);
        open(&flash);
        let content = flash.content();
        let blank = |bank: &[u8]| bank.iter().rev().take_while(|&&byte| byte == 0xFF).count();
        let [first, second] = [&content[..1000], &content[1024..2024]].map(blank);
        assert_eq!(first.max(second), 1000, "a bank is erased");
        assert!(first.min(second) >= 8 * PLACE, "{used} places were used");
    }
}

#[test]
fn parameters_up_to_the_capacity_can_be_stored_after_every_start_with_any_unit() {
    with_each_kind!(|W, E| {
        for sectors in 2..6 {
            let len = parameters::capacity(sectors * E, W) - 6;
            let flash = Flash::<W, E>::blank_with_sectors(sectors, 0);
            let mut last = (None, Vec::new());
            for n in 1..40 {
                let (mut log, found, _) = open_with_parameters::<1024, W, E>(&flash);
                assert_eq!(found, last);
                last = (Some(settings(n)), packed(n, len));
                assert!(store(&mut log, &last), "unit of {W}, {len} bytes, store {n}");
            }
        }
    });
    assert_eq!(parameters::capacity(0x4000, 4), 199 * 24);
    assert_eq!(parameters::capacity(0x4000, 8), 165 * 24);
}

#[test]
fn open_erases_only_after_the_log_has_moved_to_the_other_bank() {
    let flash = BoardFlash::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    // Two places are taken by the format, eight are kept for starts.
    for n in 2..409 - 8 {
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
fn the_newer_bank_counts_even_where_the_sequence_wraps() {
    for older in [1, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFE, 0xFFFF_FFFF] {
        for newer_by in [1u32, 2, 600] {
            for bank in [0, 1] {
                let flash = flash_with::<4, 0x4000>(&[
                    (1 - bank, 100, record(older, 1, 5, 2)),
                    (bank, 0, record(older.wrapping_add(newer_by), 1, 6, 2)),
                ]);
                let (mut log, _) = Log::open(flash.clone());
                assert_eq!(
                    log.settings().unwrap().node_id,
                    NodeId::new(6),
                    "{older:#x} + {newer_by}"
                );
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
    let old = record(8, 1, 4, 3);
    for (byte, bit) in (0..32).flat_map(|byte| (0..8).map(move |bit| (byte, bit))) {
        let mut new = record(9, 1, 5, 2);
        new[byte] ^= 1 << bit;
        let flash = flash_with::<4, 1024>(&[(0, 0, old), (0, 1, new)]);
        let (mut log, found) = Log::open(flash.clone());
        assert_eq!(found, Found::Interrupted, "byte {byte}, bit {bit}");
        assert_eq!(log.settings().unwrap().node_id, NodeId::new(4));
        assert_eq!(log.store(settings(6)), Ok(()), "after it, not over it");
        assert_eq!(open(&flash), (Some(settings(6)), Found::Complete));
    }
}

#[test]
fn a_record_of_illegal_settings_does_not_count() {
    for wrong in [
        record(9, 1, 0x00, 2),
        record(9, 1, 0x80, 2),
        record(9, 1, 0xFE, 2),
        record(9, 1, 5, 5),
        record(9, 1, 5, 10),
        record(9, 1, 5, 0xFF),
        record(9, 2, 5, 2),
        record(9, 0xFF, 5, 2),
    ] {
        let flash = flash_with::<4, 1024>(&[(0, 0, record(8, 1, 4, 3)), (0, 1, wrong)]);
        assert_eq!(open(&flash).0.unwrap().node_id, NodeId::new(4), "{wrong:02X?}");
    }
}

#[test]
fn a_record_of_a_later_versions_kind_is_skipped_and_left_unchanged() {
    let later = record(9, 2, 5, 2);
    let flash = flash_with::<4, 1024>(&[(0, 0, record(8, 1, 4, 3)), (0, 1, later)]);
    let (mut log, found) = Log::open(flash.clone());
    assert_eq!((log.settings().unwrap().node_id, found), (NodeId::new(4), Found::Interrupted));
    assert_eq!(log.store(settings(6)), Ok(()));
    assert_eq!(flash.content()[PLACE..][BEGUN..][..32], later);
    assert_eq!(open(&flash), (Some(settings(6)), Found::Complete));
    assert_eq!(open(&flash_with::<4, 1024>(&[(0, 0, later)])), (None, Found::Damaged));
}

#[test]
fn unused_bytes_of_a_record_may_have_any_value() {
    let mut later = record(9, 1, 5, 2);
    later[7..10].copy_from_slice(&[0x00, 0xE8, 0x03]);
    let flash = flash_with::<4, 1024>(&[(0, 0, record(8, 1, 4, 3)), (0, 1, sealed(later))]);
    let (settings, found) = open(&flash);
    assert_eq!((settings.unwrap().node_id, found), (NodeId::new(5), Found::Complete));
}

#[test]
fn other_data_is_erased_and_no_damage() {
    let mut random = Random::from_environment();
    let mut contents = vec![vec![0; 0x8000], vec![0x5A; 0x8000]];
    // Another program's data in one bank, the other blank.
    contents.push([vec![0x11; 0x4000], vec![0xFF; 0x4000]].concat());
    contents.push(
        [vec![0xFF; 0x4000 + 409 * PLACE - 1], vec![0xFE; 0x4000 - 409 * PLACE + 1]].concat(),
    );
    contents.push((0..0x8000).map(|_| random.byte()).collect());
    // Records of another layout without a byte of their commit word or CRC.
    for byte in [24, 28] {
        let mut broken = record(9, 1, 5, 2);
        broken[byte] ^= 1;
        contents.push(broken.repeat(1024));
    }
    for content in contents {
        let flash = BoardFlash::with_content(content, 0);
        let (mut log, found) = Log::open(flash.clone());
        assert_eq!((log.settings(), found), (None, Found::OtherData));
        assert_eq!(log.store(settings(1)), Ok(()));
        assert_eq!(open(&flash), (Some(settings(1)), Found::Complete));
    }
}

/// A record in a layout with another number.
fn of_other_layout(sequence: u32) -> [u8; 32] {
    let mut record = record(sequence, 1, 5, 2);
    record[23] = 0xFE;
    sealed(record)
}

/// A record of an earlier version, which refers to parts of the parameters of another record.
fn with_parts_elsewhere(sequence: u32) -> [u8; 32] {
    let mut record = record(sequence, 1, 5, 2);
    record[18..22].copy_from_slice(&[1, 0, 3, 0]);
    sealed(record)
}

#[test]
fn records_of_another_layout_stay_and_nothing_is_stored_beside_them() {
    const E: usize = 1024;
    // Without what precedes and follows a record, as in earlier versions: many, and one.
    let bare = |at: usize, count: usize| {
        let mut content = vec![0xFF; 2 * E];
        let records = (0..count).flat_map(|n| record(n as u32, 1, 5, 2));
        content.splice(at..at + 32 * count, records);
        Flash::<4, E>::with_content(content, 0)
    };
    let ours = |sequence| record(sequence, 1, 4, 3);
    let other = of_other_layout;
    let erased = with_other_bank(ours(8), 2);
    for (flash, node_id) in [
        (bare(0, 64), None),
        (bare(0, 1), None),
        (bare(E, 1), None),
        (bare(2 * E - 32, 1), None),
        (flash_with(&[(0, 0, other(9))]), None),
        (flash_with(&[(1, 3, other(9))]), None),
        // Behind the record that counts, and in the bank that would be erased, also before records of this layout.
        (flash_with(&[(0, 0, erased), (0, 1, other(9))]), Some(4)),
        (flash_with(&[(0, 0, erased), (0, 1, with_parts_elsewhere(9))]), Some(4)),
        (flash_with(&[(0, 0, ours(8)), (1, 0, other(9))]), Some(4)),
        (flash_with(&[(0, 0, ours(8)), (1, 0, other(5)), (1, 1, ours(6))]), Some(4)),
    ] {
        let content = flash.content();
        for _ in 0..3 {
            let (mut log, found) = Log::open(flash.clone());
            let found_id = log.settings().and_then(|settings| settings.node_id);
            assert_eq!((found_id, found), (node_id.and_then(NodeId::new), Found::OtherLayout));
            assert_eq!(log.store(settings(1)), Err(Error::OtherLayout));
            assert!(flash.content() == content && flash.erases() == 0, "it stays");
        }
    }
}

#[test]
fn parameters_that_read_as_a_record_of_another_layout_are_none() {
    let flash = Flash::<4, 1024>::blank(0);
    let (mut log, ..) = open_with_parameters::<40, 4, 1024>(&flash);
    // The place of the first part: its first unit, its sequence, and the parameters from their header on.
    let mut look = [0; 32];
    look[4..8].copy_from_slice(&(25_u32 + 2).to_le_bytes());
    look[8..24].copy_from_slice(&packed(1, 18)[..16]);
    let mut parameters = packed(1, 18);
    parameters[16..].copy_from_slice(&sealed(look)[24..]);
    log.store_with_parameters(settings(0), &parameters).unwrap();
    assert_eq!(flash.content()[2 * PLACE..][..32], sealed(look));
    for n in 1..60 {
        log.store(settings(n)).unwrap();
        let (next, found, how) = open_with_parameters::<40, 4, 1024>(&flash);
        assert_eq!((found, how), ((Some(settings(n)), parameters.clone()), Found::Complete));
        log = next;
    }
    assert!(flash.erases() > 3, "it has moved");
}

#[test]
fn a_log_without_a_valid_record_is_damaged_and_formatted() {
    let flash = BoardFlash::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    for n in 1..100 {
        log.store(settings(n)).unwrap();
    }
    let content = flash.content();
    for broken in BEGUN..BEGUN + 28 {
        let flash = BoardFlash::with_content(content.clone(), 0);
        let places = (0..103).map(|place| place * PLACE + broken);
        places.for_each(|at| flash.corrupt(at, content[at] ^ 1));
        let (mut log, found) = Log::open(flash.clone());
        assert_eq!((log.settings(), found), (None, Found::Damaged), "byte {broken}");
        assert_eq!(log.store(settings(1)), Ok(()));
        assert_eq!(open(&flash), (Some(settings(1)), Found::Complete));
    }
}

/// Difficult flash contents: valid records, records with errors, and noise, in any place.
fn any_content<const E: usize>(random: &mut Random) -> Vec<u8> {
    let mut content = Vec::new();
    let any = random.u32();
    let first = random.pick(&[0, 1, 0x7FFF_FFFF, 0x8000_0000, u32::MAX, any]);
    let places = E / PLACE;
    for at in 0..2 * places {
        if at == places {
            content.resize(E, 0xFF);
        }
        let sequence = first.wrapping_add(random.within(0..1_000) as u32);
        let mut record = record(sequence, random.byte() % 3, random.byte(), random.byte() % 10);
        record = with_other_bank(record, random.byte() % 3);
        let mut place = place::<4>(&record);
        match random.within(0..6) {
            0 => place.fill(0xFF),
            1 => place.fill_with(|| random.byte()),
            2 => place[random.within(0..PLACE as u64) as usize] ^= random.byte(),
            3 => place[PLACE - 4..].fill(0xFF),
            _ => {}
        }
        content.extend(place);
    }
    content.resize(2 * E, 0xFF);
    content
}

#[test]
fn with_any_flash_content_open_ends_and_settings_stored_then_are_found() {
    let mut random = Random::from_environment();
    for _ in 0..5_000 / every(5) {
        let flash = Flash::<4, 640>::with_content(any_content::<640>(&mut random), random.u64());
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
    let flash = Flash::<4, 64>::blank(0);
    let (mut log, _) = Log::open(flash.clone());
    assert_eq!(log.store(settings(1)), Err(Error::Full));
    assert_eq!(open(&flash).0, None);
}
