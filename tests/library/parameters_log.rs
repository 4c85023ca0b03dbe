//! Parameters in the settings log, without power cuts: places written, failing flash, damaged content, older firmware.

use canopen_node::settings::{Error, Found, Log, parameters};
use testkit::{
    flash::Flash,
    random::Random,
    settings::{Content, open, open_with_parameters, parameters as packed, settings},
};

/// The longest parameters, which take three places of 32 bytes.
const LEN: usize = 66;
/// A flash with room for 16 places a bank.
type Chip = Flash<4, 512>;
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
    for (place, sequence) in (0..11).zip(16..) {
        assert_eq!(bytes[place * 32..][..4], u32::to_le_bytes(sequence), "place {place}");
    }
    let ends: Vec<_> = (0..11).map(|place| bytes[place * 32 + 31]).collect();
    assert_eq!(ends, *b"E1PPP11PPP1");
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
fn parameters_up_to_the_capacity_of_a_bank_can_be_stored_after_every_start() {
    const CAPACITY: usize = parameters::capacity(512, 4);
    let flash = Chip::blank(0);
    let mut last = (None, Vec::new());
    for n in 1..20 {
        let (mut log, found, _) = open_with_parameters::<CAPACITY, 4, 512>(&flash);
        assert_eq!(found, last);
        last = (Some(settings(n)), packed(n, CAPACITY - 6));
        assert_eq!(log.store_with_parameters(settings(n), &last.1), Ok(()), "store {n}");
    }
    assert_eq!(packed(1, CAPACITY - 6).len(), CAPACITY);
}

#[test]
fn parameters_that_are_removed_are_gone() {
    let (mut log, flash) = with_content_1();
    let writes = flash.writes();
    assert_eq!(log.store_with_parameters(settings(1), &[]), Ok(()));
    assert_eq!((log.parameters(), flash.writes()), (&[][..], writes + 8));
    assert_eq!(start(&flash).1, (Some(settings(1)), Vec::new()));
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
    for n in 2..7 {
        assert_eq!(store(&mut log, &content(n)), Ok(()));
    }
    let writes = flash.writes();
    assert_eq!(store(&mut log, &content(7)), Err(Error::Full), "three places are left");
    assert_eq!(flash.writes(), writes);
    assert_eq!(log.store(settings(8)), Ok(()), "there is room for a record");
    assert_eq!(start(&flash).1, (Some(settings(8)), content(6).1));
}

#[test]
fn damaged_parameters_cost_themselves_but_not_the_settings() {
    for at in 2 * 32..5 * 32 {
        let is_value = (4..28).contains(&(at % 32)) && at < 4 * 32 + 4 + 18;
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
        let mut record: [u8; 32] = bytes[160..192].try_into().unwrap();
        record[10..12].copy_from_slice(&u16::to_le_bytes(first));
        record[12..14].copy_from_slice(&u16::to_le_bytes(len));
        bytes[160..192].copy_from_slice(&testkit::settings::sealed(record));
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
    for steps in 1..32 {
        let flash = flash.duplicate(steps);
        let (mut log, ..) = start(&flash);
        flash.cut_power_after(steps as usize);
        assert!(store(&mut log, &content(2)).is_err());
        flash.power_on();
        let (found, _) = open(&flash);
        let is_new = found == Some(settings(2));
        assert!(is_new || steps < 31 && found == Some(settings(1)));
        assert!(!is_new || steps >= 30, "there is no CRC");
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
    for _ in 0..3_000 {
        let (mut log, flash) = with_content_1();
        store(&mut log, &content(2)).unwrap();
        let mut bytes = flash.content();
        for _ in 0..random.within(1..8) {
            let at = random.within(0..bytes.len() as u64) as usize;
            bytes[at] = random.byte();
            if random.one_in(2) {
                // A record that is valid in spite of it.
                let record = &mut bytes[at / 32 * 32..][..32];
                let sealed = testkit::settings::sealed((&*record).try_into().unwrap());
                record.copy_from_slice(&sealed);
            }
        }
        let flash = Chip::with_content(bytes, random.u64());
        let (mut log, found, result) = start(&flash);
        assert!(!matches!(result, Found::MediumFailed(_)), "{result:?}");
        assert_eq!(start(&flash.duplicate(0)).1, found, "the result stays the same");
        assert_eq!(store(&mut log, &content(9)), Ok(()), "the start has made room");
        assert_eq!(start(&flash).1, content(9));
    }
}
