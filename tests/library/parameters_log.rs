//! Parameters in the settings log, without power cuts: places written, failing flash, damaged content, older firmware.

use canopen_node::settings::{
    Error, Found, Log,
    parameters::{Packer, Parameter},
};
use testkit::{
    flash::Flash,
    random::{Random, every},
    settings::{Content, open, open_with_parameters, parameters as packed, place, settings},
};

/// The longest parameters, which take three places.
const LEN: usize = 66;
/// A flash with 25 places a bank, of which eight are kept for starts.
type Chip = Flash<4, 1024>;
/// The length of a place, and where its 32 bytes are.
const PLACE: usize = 40;
const CONTENT: usize = 4;
type ParametersLog = Log<Chip, LEN>;

fn content(n: u16) -> Content {
    (Some(settings(n)), packed(n, 60))
}

fn start(flash: &Chip) -> (ParametersLog, Content, Found) {
    open_with_parameters(flash)
}

fn store(log: &mut ParametersLog, (settings, parameters): &Content) -> Result<(), Error> {
    log.store_with_parameters(settings.unwrap(), parameters)
}

/// A log that holds `content(1)`, in the places 2 to 5.
fn with_content_1() -> (ParametersLog, Chip) {
    let flash = Flash::blank(7);
    let (mut log, ..) = start(&flash);
    store(&mut log, &content(1)).unwrap();
    (log, flash)
}

#[test]
fn every_place_has_the_next_sequence_whatever_it_holds() {
    let (mut log, flash) = with_content_1();
    log.store(settings(2)).unwrap();
    store(&mut log, &content(3)).unwrap();
    let bytes = flash.content();
    for (place, sequence) in (0..11).zip(25..) {
        let at = place * PLACE + CONTENT;
        assert_eq!(bytes[at..][..4], u32::to_le_bytes(sequence), "place {place}");
    }
    let ends: Vec<_> = (0..11).map(|place| bytes[place * PLACE + CONTENT + 31]).collect();
    assert_eq!(ends, *b"11PPP11PPP1");
}

#[test]
fn parameters_of_any_length_are_found_again_also_in_the_other_bank() {
    for len in 0..=LEN - 6 {
        let flash = Chip::blank(0);
        let mut last = (None, Vec::new());
        for n in 1..12 {
            let (mut log, found, result) = start(&flash);
            assert_eq!(found, last, "{len} bytes");
            assert!(matches!(result, Found::Complete | Found::Blank));
            last = (Some(settings(n)), packed(n, len));
            assert_eq!(store(&mut log, &last), Ok(()), "the start has made room");
        }
        assert!(len == 0 || flash.erases() > 1, "it has moved");
    }
}

#[test]
fn parameters_that_are_removed_are_gone() {
    let (mut log, flash) = with_content_1();
    let writes = flash.writes();
    assert_eq!(log.store_with_parameters(settings(1), &[]), Ok(()));
    assert_eq!((log.parameters(), flash.writes()), (&[][..], writes + 10));
    assert_eq!(start(&flash).1, (Some(settings(1)), Vec::new()));
}

#[test]
fn parameters_that_the_node_did_not_take_are_replaced_by_the_next_store() {
    // Each takes a part of its own.
    let [first, second, third] = [1, 2, 3].map(|n| packed(n, 18));
    let flash = Chip::blank(7);
    let (mut log, ..) = start(&flash);
    let before = [&first[..], &second].concat();
    assert_eq!(log.store_with_parameters(settings(1), &before), Ok(()));
    let (mut log, _) = ParametersLog::open_with_parameters(flash.clone());
    assert_eq!(log.restore(|parameter| parameter.value[0] == 2), Ok(()));
    assert_eq!(log.parameters(), second);
    let after = [&second[..], &third].concat();
    assert_eq!(log.store_with_parameters(settings(1), &after), Ok(()));
    assert_eq!(start(&flash).1, (Some(settings(1)), after));
}

#[test]
fn bytes_that_read_blank_are_stored_behind_shorter_parameters() {
    let blank = |len: u8| [&[0x00, 0x21, 1, 0x0A, len, 0][..], &vec![0xFF; len.into()]].concat();
    let (mut log, flash) = with_content_1();
    for len in [18, 60] {
        assert_eq!(log.store_with_parameters(settings(1), &blank(len)), Ok(()));
        assert_eq!(start(&flash).1, (Some(settings(1)), blank(len)), "{len} bytes");
    }
}

#[test]
fn a_parameter_that_does_not_fit_into_the_pack_is_left_out() {
    let value = Parameter { index: 0x2100, sub_index: 1, data_type: 0x0A, value: &[1, 2] };
    let mut bytes = [0; 8];
    for (room, len) in [(8, 8), (7, 0)] {
        let mut packer = Packer::new(&mut bytes[..room]);
        assert!(packer.is_empty());
        packer.put(&value);
        assert_eq!((packer.len(), packer.is_empty()), (len, len == 0), "{room} bytes of room");
    }
}

#[test]
fn more_parameters_than_declared_are_refused() {
    let (mut log, flash) = with_content_1();
    let writes = flash.writes();
    assert_eq!(log.store_with_parameters(settings(2), &[0; LEN + 1]), Err(Error::Full));
    assert_eq!(flash.writes(), writes);
    assert_eq!(start(&flash).1, content(1));
}

#[test]
fn parameters_that_do_not_fit_in_the_banks_are_refused_unwritten() {
    let (mut log, flash) = with_content_1();
    for n in 2..8 {
        assert_eq!(store(&mut log, &content(n)), Ok(()));
    }
    let writes = flash.writes();
    assert_eq!(store(&mut log, &content(8)), Err(Error::Full), "a place is left");
    assert_eq!(flash.writes(), writes);
    assert_eq!(log.store(settings(9)), Ok(()), "there is room for a record");
    assert_eq!(start(&flash).1, (Some(settings(9)), content(7).1));
}

#[test]
fn damaged_parameters_cost_themselves_but_not_the_settings() {
    for at in 2 * PLACE..5 * PLACE {
        let value = CONTENT + 4;
        let is_value = (value..value + 24).contains(&(at % PLACE)) && at < 4 * PLACE + value + 18;
        let (_, flash) = with_content_1();
        flash.corrupt(at, flash.content()[at] ^ 0x10);
        let (mut log, found, result) = start(&flash);
        if !is_value {
            assert_eq!((found, result), (content(1), Found::Complete), "byte {at} says nothing");
            continue;
        }
        assert_eq!((found.0, found.1), (Some(settings(1)), Vec::new()), "byte {at}");
        assert_eq!(result, Found::ParametersDamaged);
        assert_eq!(start(&flash.duplicate(0)).2, Found::Complete, "it is reported once");
        assert_eq!(store(&mut log, &content(2)), Ok(()));
        assert_eq!(start(&flash).1, content(2));
    }
}

#[test]
fn a_reference_to_an_impossible_place_is_damage_and_is_not_followed() {
    for (first, len) in [(5, 60), (0xFFFF, 60), (1, 0xFFFE), (0, 0xFF00), (3, 66)] {
        let (_, flash) = with_content_1();
        let mut bytes = flash.content();
        let at = 5 * PLACE;
        let mut record: [u8; 32] = bytes[at + CONTENT..][..32].try_into().unwrap();
        record[10..12].copy_from_slice(&u16::to_le_bytes(first));
        record[12..14].copy_from_slice(&u16::to_le_bytes(len));
        let place = place::<4>(&testkit::settings::sealed(record));
        bytes[at..at + PLACE].copy_from_slice(&place);
        let flash = Chip::with_content(bytes, 0);
        let (_, found, result) = start(&flash);
        assert_eq!(found, (Some(settings(1)), Vec::new()));
        assert_eq!(result, Found::ParametersDamaged, "{len} bytes from place {first}");
    }
}

#[test]
fn firmware_without_parameters_finds_the_settings_of_any_store() {
    let (mut log, flash) = with_content_1();
    assert_eq!(open(&flash.duplicate(0)), (Some(settings(1)), Found::Complete));
    for steps in 1..36 {
        let flash = flash.duplicate(steps);
        let (mut log, ..) = start(&flash);
        flash.cut_power_after(steps as usize);
        assert!(store(&mut log, &content(2)).is_err());
        flash.power_on();
        let (found, _) = open(&flash);
        let is_new = found == Some(settings(2));
        assert!(is_new || found == Some(settings(1)));
        assert!(!is_new || steps == 35, "there is no commit word");
        assert_eq!(open(&flash), (found, Found::Complete), "step {steps}");
        let (mut old, _) = Log::open(flash.clone());
        old.store(settings(5)).unwrap();
        let parameters = if is_new { start(&flash).1.1 } else { content(1).1 };
        assert_eq!(start(&flash).1, (Some(settings(5)), parameters), "its records keep them");
    }
    log.store(settings(3)).unwrap();
    assert_eq!(open(&flash), (Some(settings(3)), Found::Complete));
    assert_eq!(start(&flash).1, (Some(settings(3)), content(1).1), "it has only looked");
}

#[test]
fn with_any_flash_content_a_start_ends_and_what_is_stored_then_is_found() {
    let mut random = Random::from_environment();
    for _ in 0..3_000 / every(3) {
        let (mut log, flash) = with_content_1();
        store(&mut log, &content(2)).unwrap();
        let mut bytes = flash.content();
        for _ in 0..random.within(1..8) {
            let at = random.within(0..bytes.len() as u64) as usize;
            bytes[at] = random.byte();
            if random.one_in(2) {
                // A record that is valid in spite of it.
                let at = (at / PLACE).min(24) * PLACE + CONTENT;
                let record = &mut bytes[at..at + 32];
                let sealed = testkit::settings::sealed((&*record).try_into().unwrap());
                record.copy_from_slice(&sealed);
            }
        }
        let flash = Chip::with_content(bytes, random.u64());
        let (mut log, found, result) = start(&flash);
        assert!(!matches!(result, Found::MediumFailed(_)), "{result:?}");
        assert_eq!(start(&flash.duplicate(0)).1, found, "the result stays the same");
        if result == Found::OtherLayout {
            assert_eq!(store(&mut log, &content(9)), Err(Error::OtherLayout));
            continue;
        }
        assert_eq!(store(&mut log, &content(9)), Ok(()), "the start has made room");
        assert_eq!(start(&flash).1, content(9));
    }
}
