//! The example `io` and the node in the process, asked the same: objects with every kind of value, right and wrong
//! transfers, and parameters that fill the settings log or are damaged.

use canopen_node::{BitRate, Frame};
use emulator::{
    Time,
    board::{self, Board},
    chip::{ChipVariant, Part},
};
use testkit::{
    frames::{self, Frames},
    image::example,
    image_rig::{ImageRig, SETTINGS_OFFSET, flash_with, on_the_wire, settings},
    random::Random,
    sdo::{self, Client},
    sdo_messages::{block_download, block_upload, download, upload},
};

use crate::example_pair::{NODE_ID, Pair, message, rig};

/// The objects, but those that a store or a chip decides: 1010h, 1011h, 1018h, 6401h. The last one does not exist.
fn indices() -> impl Iterator<Item = u16> {
    let single = [0x1000, 0x1001, 0x1003, 0x1005, 0x1008, 0x1014, 0x1016, 0x1017, 0x1029];
    let pdos = [0x1400, 0x1600, 0x1800, 0x1A00].into_iter().flat_map(|first| first..=first + 4);
    let of_application = [0x2100, 0x2101, 0x6000, 0x6200, 0x6426, 0xFFFF];
    single.into_iter().chain(pdos).chain(of_application)
}

/// Numbers that are a limit of some object, and entries of mappings, legal ones and others.
const VALUES: [u32; 30] = [
    0,
    1,
    2,
    3,
    9,
    64,
    65,
    240,
    241,
    253,
    254,
    255,
    0x80,
    0x181,
    0x580,
    0x701,
    0x7FF,
    0x800,
    0x4000_0081,
    0x8000_0181,
    0xA000_0000,
    u32::MAX,
    0x6000_0108,
    0x6200_0108,
    0x6401_0110,
    0x6200_0110,
    0x2100_0008,
    0x0005_0008,
    0x0007_0020,
    0x1F00_0108,
];
const DOMAIN: u16 = 0x2102;
/// Commands of every service, some of them in no place of any transfer.
const COMMANDS: [u8; 26] = [
    0x00, 0x01, 0x0F, 0x11, 0x20, 0x21, 0x22, 0x40, 0x60, 0x70, 0x80, 0x81, 0xA0, 0xA1, 0xA2, 0xA3,
    0xA4, 0xC0, 0xC1, 0xC2, 0xC4, 0xC6, 0xD0, 0xD1, 0xE0, 0xFF,
];

/// A transfer by one of the services to or from an object.
fn transfer(random: &mut Random, indices: &[u16]) -> Vec<[u8; 8]> {
    let address = (random.pick(indices), random.pick(&[0, 1, 1, 2, 3, 3, 4, 5, 6, 8, 9]));
    let (index, sub_index) = address;
    let value = random.pick(&VALUES);
    let data: Vec<u8> = match random.within(0..3) {
        0 => value.to_le_bytes()[..random.pick(&[1, 2, 4])].to_vec(),
        1 => random.bytes::<8>().to_vec(),
        _ => vec![0x41; random.within(1..19) as usize],
    };
    let (blocks, segments) = (random.pick(&[1, 1, 2]), random.within(0..4) as u8);
    match random.within(0..9) {
        // One, two and four bytes; the size that fits is one of them.
        0..4 => [0x2F, 0x2B, 0x23, 0x40]
            .map(|command| message(command, index, sub_index, value))
            .to_vec(),
        4 => download(address, &data),
        5 => block_download(address, &data),
        6 => upload(address, segments),
        7 => block_upload(address, random.pick(&[0, 1, 2, 127, 128]), blocks, segments),
        _ => configure_pdo(random),
    }
}

/// The requests that change the mapping of a PDO, and read it.
fn configure_pdo(random: &mut Random) -> Vec<[u8; 8]> {
    let pdo = random.pick(&[0x1400, 0x1800]) + random.within(0..5) as u16;
    let of_kind = |entry: &&u32| **entry > 0x1_0000 && **entry >> 30 != 2;
    let entries: Vec<u32> =
        VALUES.iter().filter(of_kind).copied().chain([0x1001_0008, 0]).collect();
    let mapping: Vec<u32> = match random.within(0..3) {
        0 => vec![random.pick(&entries); random.within(0..10) as usize],
        _ => (0..random.within(0..10)).map(|_| random.pick(&entries)).collect(),
    };
    let mut requests = vec![message(0x23, pdo, 1, 0x8000_0123), message(0x2F, pdo + 0x200, 0, 0)];
    requests.extend((1..).zip(&mapping).map(|(at, entry)| message(0x23, pdo + 0x200, at, *entry)));
    let number = if random.one_in(4) { random.within(0..11) } else { mapping.len() as u64 };
    requests.push(message(0x2F, pdo + 0x200, 0, number as u32));
    requests.extend([0x123, 0x124, 0x4000_0123].map(|cob_id| message(0x23, pdo, 1, cob_id)));
    requests.extend((0..10).map(|sub_index| message(0x40, pdo + 0x200, sub_index, 0)));
    requests
}

/// Half of the transfers have a fault: a message is lost, doubled, changed, or another request comes in between.
fn with_fault(random: &mut Random, mut transfer: Vec<[u8; 8]>) -> Vec<[u8; 8]> {
    let at = random.within(0..transfer.len() as u64) as usize;
    match random.within(0..10) {
        0 => _ = transfer.remove(at),
        1 => transfer.insert(at, transfer[at]),
        2 => transfer[at][0] = random.pick(&COMMANDS),
        // Not in the index: the identity of the board is not that of the model.
        3 => transfer[at][random.pick(&[0, 3, 4, 5, 7])] ^= 1 << random.within(0..8),
        4 => transfer.insert(at, message(0x40, 0x1017, 0, 0)),
        _ => {}
    }
    transfer
}

#[test]
fn random_transfers_right_and_wrong_are_answered_as_by_the_node_in_the_process() {
    let mut random = Random::from_environment();
    let indices: Vec<u16> = indices().chain([DOMAIN, 0x2101, 0x2101, 0x2101]).collect();
    let mut pair = Pair::new();
    for _ in 0..6_000 {
        let transfer = transfer(&mut random, &indices);
        for request in with_fault(&mut random, transfer) {
            pair.ask(request);
        }
        pair.say("80");
    }
}

#[test]
fn a_save_by_each_service_is_confirmed_by_it() {
    let mut pair = Pair::new();
    for transfer in [
        &["23 10 10 01 73 61 76 65"][..],
        &["2B 17 10 00 64", "21 10 10 01 04", "07 73 61 76 65"],
        &["2B 17 10 00 65", "C2 10 10 01 04", "81 73 61 76 65", "CD"],
        &["21 10 10 01 04", "07 73 61 76 66", "C2 10 10 01 04", "81 73 61 76 66", "CD"],
    ] {
        transfer.iter().for_each(|request| pair.say(request));
    }
}

#[test]
fn each_lss_command_is_answered_as_by_the_node_in_the_process() {
    /// Those whose answer depends on the identity, which differs, and the switch of the bit rate.
    const LEFT_OUT: [u8; 6] = [0x15, 0x51, 0x5A, 0x5B, 0x5C, 0x5D];
    let mut pair = Pair::with(&flash_with(&[settings(0xFF, BitRate::Kbit1000)]));
    for begin in [&["04 00"][..], &["04 01"], &["04 01", "11 41"]] {
        for command in (0..=u8::MAX).filter(|command| !LEFT_OUT.contains(command)) {
            let request = format!("{command:02X} 01 01");
            for request in begin.iter().chain([&request.as_str()]) {
                pair.exchange(&frames::request(request), 0x7E4..=0x7E4);
            }
        }
    }
}

#[test]
fn a_client_that_falls_silent_in_a_transfer_gets_an_abort() {
    let mut rig = rig(&flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]));
    for begin in [
        &["40 08 10 00"][..],
        &["21 01 21 03 08"],
        &["A4 08 10 00 7F 00"],
        &["A4 02 21 00 02 00", "A3"],
        &["C2 02 21 00 A0 86 01 00"],
        &["C2 02 21 00 A0 86 01 00", "01 00 9E 3C DA 78 17 B5"],
        &["C2 01 21 03 03", "81 61 62 63"],
    ] {
        for request in begin {
            rig.transmit(on_the_wire(&sdo::request(NODE_ID, request)));
            rig.collect(Time::from_ms(2));
        }
        let sent = rig.collect(Time::from_s(3)).0;
        let is_timeout = |frame: &Frame| {
            frame.cob_id() == 0x5C0
                && frame.data()[..1] == [0x80]
                && frame.data()[4..] == [0, 0, 4, 5]
        };
        assert_eq!(sent.iter().filter(|frame| is_timeout(frame)).count(), 1, "{begin:?}: {sent:?}");
    }
}

#[test]
fn a_client_may_confirm_a_block_while_it_is_sent() {
    // The slow core leaves the bus to the client after two segments.
    let of_chip = ChipVariant { slowdown: 10, ..ChipVariant::default() };
    let of_board = board::Settings { chip_variant: of_chip, ..Default::default() };
    let mut board = Board::new(Part::Stm32f407, example(), of_board);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]));
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    rig.collect(Time::from_ms(50));
    rig.transmit(on_the_wire(&sdo::request(NODE_ID, "A4 02 21 00 7F 00")));
    rig.collect(Time::from_ms(2));
    rig.transmit(on_the_wire(&sdo::request(NODE_ID, "A3")));
    let (_, first) = rig.next_frame();
    rig.queue(&sdo::request(NODE_ID, "A2 02 7F"));
    let (_, second) = rig.next_frame();
    let (_, third) = rig.next_frame();
    let number = |frames: &Frames| frames.0[0].data()[0];
    assert_eq!((number(&first), number(&second), number(&third)), (1, 2, 1), "it goes on behind");
    assert_ne!(first.0[0].data()[1..], third.0[0].data()[1..]);
    rig.transmit(on_the_wire(&sdo::request(NODE_ID, "80 02 21 00")));
    rig.collect(Time::from_ms(5));
}

#[test]
fn parameters_survive_a_move_to_the_other_bank_by_the_hundreds_of_saves() {
    let mut rig = rig(&flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]));
    let mut client = rig.sdo_client(NODE_ID);
    assert!(client.download(0x2101, 3, b"inspector no. 16").is_ok());
    let mut last = 0;
    for delta in 0_u32..400 {
        assert!(client.download(0x6426, 1, &delta.to_le_bytes()).is_ok());
        if client.download(0x1010, 1, b"save").is_err() {
            break;
        }
        last = delta;
    }
    assert!(last > 20, "{last} saves");
    for _ in 0..2 {
        rig.power_cycle(0);
        rig.collect(Time::from_ms(50));
        let mut client = rig.sdo_client(NODE_ID);
        assert_eq!(client.number(0x6426, 1), last);
        assert_eq!(client.upload(0x2101, 3), Ok(b"inspector no. 16".to_vec()));
    }
}

#[test]
fn damaged_parameters_are_defaults_and_the_settings_stay() {
    const DEFAULT: u32 = 5;
    const SAVED: u32 = 7;
    let flash = |rig: &ImageRig| {
        rig.network.board(0).flash()[SETTINGS_OFFSET as usize..][..0x8000].to_vec()
    };
    let mut saving = rig(&flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]));
    let before = flash(&saving);
    let mut client = saving.sdo_client(NODE_ID);
    assert!(client.download(0x6426, 1, &SAVED.to_le_bytes()).is_ok());
    assert!(client.download(0x1010, 1, b"save").is_ok());
    let saved = flash(&saving);
    let mut defaults = 0;
    let written: Vec<usize> =
        (0..saved.len()).filter(|&at| saved[at] != before[at]).step_by(11).collect();
    for &at in &written {
        let mut content = saved.clone();
        content[at] ^= 0x10;
        let mut rig = rig(&content);
        let delta = rig.sdo_client(NODE_ID).number(0x6426, 1);
        assert!(matches!(delta, DEFAULT | SAVED), "{delta} with byte {at} damaged");
        defaults += usize::from(delta == DEFAULT);
        rig.sdo_client(NODE_ID).download(0x1010, 1, b"save").expect("a save");
        rig.power_cycle(0);
        rig.collect(Time::from_ms(50));
        assert_eq!(rig.sdo_client(NODE_ID).number(0x6426, 1), delta, "byte {at} damaged");
    }
    // The numbers and marks of the records decide nothing.
    assert!(defaults * 4 > written.len() * 3, "{defaults} of {}", written.len());
}

#[test]
fn an_rpdo_that_is_too_short_or_out_of_range_changes_nothing() {
    let mut rig = rig(&flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]));
    rig.nmt("01 40");
    // Of a longer one the mapped bytes count.
    for (data, outputs) in [(&[1][..], 1), (&[], 1), (&[2, 9], 2), (&[4], 2), (&[3], 3)] {
        rig.transmit(on_the_wire(&Frame::new(0x240, data).expect("a frame")));
        rig.collect(Time::from_ms(20));
        assert_eq!(rig.sdo_client(NODE_ID).number(0x6200, 1), outputs, "{data:?}");
    }
}
