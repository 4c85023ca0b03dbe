//! The example `io` with parameters in its flash that another firmware may have written, or that are damaged: it takes
//! and leaves them as the node in the process does.

use canopen_node::{BitRate, settings::Log};
use emulator::{
    Time,
    board::Board,
    chip::{Part, StuckBits},
};
use testkit::{
    flash::BoardFlash,
    image::example,
    image_rig::{ImageRig, SETTINGS_OFFSET, settings},
    random::Random,
    sdo::Client,
    settings::{record, sealed},
};

use crate::example_pair::{NODE_ID, Pair};

/// Codes of the data types.
const U8: u8 = 0x05;
const U32: u8 = 0x07;
const REAL32: u8 = 0x08;
const TEXT: u8 = 0x09;
const I64: u8 = 0x15;
const PDO: u8 = 0x20;

const MOST: usize = 4_000;

/// A parameter as it is packed.
fn parameter(index: u16, sub_index: u8, data_type: u8, value: &[u8]) -> Vec<u8> {
    let [i0, i1] = index.to_le_bytes();
    let [l0, l1] = (value.len() as u16).to_le_bytes();
    [&[i0, i1, sub_index, data_type, l0, l1], value].concat()
}

/// The content of the settings' flash after a store with these parameters.
fn flash_with(parameters: &[u8]) -> Vec<u8> {
    let (mut log, _) = Log::<_, MOST>::open_with_parameters(BoardFlash::blank(0));
    let stored = settings(NODE_ID, BitRate::Kbit1000);
    log.store_with_parameters(stored, parameters).expect("the flash works");
    log.close().content()
}

/// Lets both start with these parameters and save all of their values, and compares the flashes.
fn check(parameters: &[u8]) {
    check_content(&flash_with(parameters));
}

fn check_content(content: &[u8]) {
    let mut pair = Pair::with(content);
    pair.say("23 10 10 01 73 61 76 65");
    let content = pair.model.flash.content();
    let flash = pair.rig.network.board(0).flash();
    let stored = &flash[SETTINGS_OFFSET as usize..][..content.len()];
    let differing = stored.iter().zip(&content).position(|(stored, other)| stored != other);
    assert_eq!(differing, None);
}

/// Values that are stored, and some that are not: index, sub-index, data type and length.
const STORED: [(u16, u8, u8, usize); 16] = [
    (0x1005, 0, U32, 4),
    (0x1005, 0, U32, 4),
    (0x1016, 1, U32, 4),
    (0x1019, 0, U8, 1),
    (0x1029, 1, U8, 1),
    (0x2100, 0, U8, 1),
    (0x2101, 1, REAL32, 4),
    (0x2101, 2, I64, 8),
    (0x2101, 3, TEXT, 16),
    (0x6426, 1, U32, 4),
    (0x0001, 0, U8, 1),
    (0x1000, 0, U32, 4),
    (0x1017, 0, U32, 4),
    (0x2102, 0, 0x0F, 1),
    (0x6200, 1, U8, 1),
    (0x9FFF, 0, U8, 1),
];
/// COB-IDs, legal ones and others, also with the bits for a PDO that is not valid and for one whose COB-ID follows the
/// node-ID.
const COB_IDS: [u32; 26] = [
    0,
    0x7F,
    0x80,
    0x81,
    0xFF,
    0x100,
    0x101,
    0x180,
    0x181,
    0x580,
    0x581,
    0x5FF,
    0x600,
    0x601,
    0x67F,
    0x680,
    0x6DF,
    0x6E0,
    0x6FF,
    0x700,
    0x701,
    0x7FF,
    0x800,
    0x801,
    0x4000_0181,
    0x8000_0101,
];
const OUTPUTS: u32 = 0x6200_0108;
const MAPPED: [u32; 8] = [
    OUTPUTS,
    OUTPUTS,
    0x0007_0020,
    0x6401_0110,
    0x2100_0008,
    0x6200_0110,
    0x6200_0208,
    0x0005_0108,
];

/// A number that a parameter may have, or just not.
fn number(random: &mut Random) -> u32 {
    match random.within(0..4) {
        0 => random.pick(&COB_IDS),
        1 => random.pick(&[1, 2, 3, 8, 9, 240, 241, 254, 255, 256, 0xFFFF, 0x1_0000]),
        // The numbers of nodes and times, and REAL32: NaN, -0.5, 8, 1.5.
        2 => random.pick(&[0x0080_0064, 0x000A_0000, 0x0100_0000, 0x000A_0064]),
        _ => random.pick(&[0x7FC0_0000, 0xBF00_0000, 0x4100_0000, 0x3FC0_0000]),
    }
}

/// The words of a PDO: COB-ID, transmission type, the times of a TPDO and its SYNC start value, and the mapping.
fn pdo(random: &mut Random, is_tpdo: bool) -> Vec<u8> {
    let kind = random.pick(&[0, 240, 241, 253, 254, 255, 255, 255, 256, 0x1_0000]);
    let mut words = vec![random.pick(&COB_IDS), kind];
    if is_tpdo {
        words.extend([random.pick(&[0, 0xFFFF, 0x1_0000]), 0, random.pick(&[0, 240, 241])]);
    }
    let same = random.pick(&MAPPED);
    let is_uniform = random.one_in(2);
    let count = random.within(0..10);
    words.extend((0..count).map(|_| if is_uniform { same } else { random.pick(&MAPPED) }));
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// A parameter that is stored, or one with a fault: an address, a type or a length that does not fit.
fn any_parameter(random: &mut Random) -> Vec<u8> {
    let (index, mut sub_index, mut data_type, mut value) = if random.one_in(2) {
        let is_tpdo = random.one_in(2);
        let first = if is_tpdo { 0x1800 } else { 0x1400 };
        (first + random.within(0..5) as u16, 0, PDO, pdo(random, is_tpdo))
    } else {
        let (index, sub_index, data_type, len) = random.pick(&STORED);
        let bytes = [number(random).to_le_bytes(), random.bytes()].concat().repeat(2);
        (index, sub_index, data_type, bytes[..len].to_vec())
    };
    match random.within(0..10) {
        0 => sub_index += 1,
        1 => data_type = random.pick(&[U32, 0x06, 0x10, U8]),
        2 => value.resize(random.within(0..18) as usize, 0),
        _ => {}
    }
    parameter(index, sub_index, data_type, &value)
}

#[test]
fn stored_parameters_legal_or_not_are_taken_as_by_the_node() {
    let mut random = Random::from_environment();
    for _ in 0..150 {
        let count = random.within(1..30);
        let mut parameters: Vec<u8> = (0..count).flat_map(|_| any_parameter(&mut random)).collect();
        if random.one_in(4) {
            parameters.truncate(random.within(1..parameters.len() as u64) as usize);
        }
        check(&parameters);
    }
}

/// The first place of the bank that holds a record of 32 bytes.
const SECOND_BANK: usize = 0x4000;
const FIRST_RECORD: usize = 0;

/// The content of a flash whose only record refers to these parameters.
fn referring(first: u16, len: u16, crc: u32) -> Vec<u8> {
    let mut record = record(1, 1, NODE_ID, 0, 0);
    record[10..12].copy_from_slice(&first.to_le_bytes());
    record[12..14].copy_from_slice(&len.to_le_bytes());
    record[14..18].copy_from_slice(&crc.to_le_bytes());
    let mut content = vec![0xFF; 2 * SECOND_BANK];
    content[FIRST_RECORD..][..32].copy_from_slice(&sealed(record));
    content
}

#[test]
fn a_record_that_refers_to_nothing_or_beyond_is_read_as_by_the_node() {
    for (first, len, crc) in
        [(0, 0, 0), (0, 24, 0), (0, 1, 0), (1, 24, 0), (0xFFFF, 0xFFFE, 0), (0x8000, 24, 7)]
    {
        let mut content = referring(first, len, crc);
        check_content(&content);
        // With little space behind it, the record moves to the other bank.
        content.copy_within(FIRST_RECORD..FIRST_RECORD + 32, SECOND_BANK - 64);
        content[FIRST_RECORD..][..32].fill(0xFF);
        check_content(&content);
    }
}

/// A flash whose log has just moved to the second bank, with parameters in the first places.
fn moved() -> Vec<u8> {
    let (mut log, _) = Log::<_, MOST>::open_with_parameters(BoardFlash::blank(0));
    let stored = settings(NODE_ID, BitRate::Kbit1000);
    let parameters = parameter(0x6426, 1, U32, &[7, 0, 0, 0]);
    log.store_with_parameters(stored, &parameters).expect("the flash works");
    // The last of these is in the other bank.
    for heartbeat_ms in (0..509).rev() {
        log.store(stored.with_heartbeat_ms(heartbeat_ms)).expect("there is room");
    }
    log.close().content()
}

/// A board with a bit that is stuck at 1.
fn board(content: &[u8], stuck: usize) -> ImageRig {
    let mut board = Board::new(Part::Stm32f407, example(), Default::default());
    board.set_flash(SETTINGS_OFFSET, content);
    let bits = StuckBits { offset: SETTINGS_OFFSET + stuck as u32, mask: 1, value: 1 };
    board.chip().flash_mut().add_stuck_bits(bits);
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    rig.collect(Time::from_ms(50));
    rig
}

#[test]
fn a_bad_bank_is_reported_at_the_start_and_nothing_is_lost() {
    let sound = moved();
    let torn = {
        let end = sound.iter().rposition(|byte| *byte != 0xFF).expect("a record");
        let mut torn = sound.clone();
        torn[end + 1..][..4].fill(0);
        torn
    };
    // The first bit of the last word of the mark.
    for (content, stuck) in [(&sound, 28), (&torn, 28)] {
        let mut rig = board(content, stuck);
        assert_eq!(rig.sdo_client(NODE_ID).number(0x6426, 1), 7);
        let failed = "the flash failed, a store may fail too";
        let log = rig.network.board(0).log();
        assert!(log.iter().any(|line| line.text.starts_with(failed)), "{log:#?}");
    }
}

#[test]
fn a_save_that_fails_at_any_place_leaves_the_old_values() {
    let content = flash_with(&parameter(0x6426, 1, U32, &[7, 0, 0, 0]));
    // The first places hold the mark, the defaults, the parameters, their record and its copy.
    for place in 5.. {
        let mut rig = board(&content, 32 * place + 6);
        let mut client = rig.sdo_client(NODE_ID);
        client.download(0x6426, 1, &[8, 0, 0, 0]).expect("it can be written");
        let is_saved = client.download(0x1010, 1, b"save").is_ok();
        rig.power_cycle(0);
        rig.collect(Time::from_ms(50));
        let expected = if is_saved { 8 } else { 7 };
        assert_eq!(rig.sdo_client(NODE_ID).number(0x6426, 1), expected, "place {place}");
        if is_saved {
            assert!(place > 7, "a save writes several places");
            break;
        }
    }
}

#[test]
fn parameters_that_end_in_the_middle_are_taken_up_to_there() {
    let legal = parameter(0x6426, 1, U32, &[7, 0, 0, 0]);
    let long = parameter(0x2101, 3, TEXT, &[0x41; 3_000]);
    let unfinished = [0x26, 0x64, 1, U32, 0xFF, 0xFF];
    for more in 0..=9 {
        check(&[&legal[..], &long, &legal, &unfinished, &[0; 9][..more]].concat());
        check(&[&legal[..], &[0x26; 9][..more]].concat());
    }
    for len in 1..=5 {
        check(&[0x26; 9][..len]);
    }
    let many = [&legal[..], &parameter(0x2101, 3, TEXT, &[0x42; 16])].concat();
    check(&many.repeat(80));
}
