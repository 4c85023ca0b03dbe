//! The example `io` and the node in the process, asked the same: objects with every kind of value, wrong transfers, and
//! parameters that fill the settings log or are damaged.

use emulator::{
    Time,
    board::{self, Board},
    chip::{Part, Readings},
};
use lss_slave::{BitRate, Frame};
use testkit::{
    frames::{self, Frames},
    image::example,
    image_rig::{ImageRig, SETTINGS_OFFSET, flash_with, on_the_wire, settings},
    sdo::{self, Client},
};

use crate::example_pair::{NODE_ID, Pair, message, rig};

/// The objects, but those that a store or a chip decides: 1010h, 1011h, 1018h, 6401h. The last one does not exist.
fn indices() -> impl Iterator<Item = u16> {
    let single = [0x1000, 0x1001, 0x1003, 0x1005, 0x1008, 0x1014, 0x1016, 0x1017, 0x1029];
    let pdos = [0x1400, 0x1600, 0x1800, 0x1A00].into_iter().flat_map(|first| first..=first + 4);
    let of_application = [0x2100, 0x2101, 0x6000, 0x6200, 0x6426, 0xFFFF];
    single.into_iter().chain(pdos).chain(of_application)
}

#[test]
fn each_value_for_each_object_is_answered_as_by_the_node_in_the_process() {
    const VALUES: [u32; 22] = [
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
        0xFFFF_FFFF,
    ];
    const MAPPED: [u32; 8] = [
        0x6000_0108,
        0x6200_0108,
        0x6401_0110,
        0x6200_0110,
        0x2100_0008,
        0x0005_0008,
        0x0007_0020,
        0x1F00_0108,
    ];
    let mut pair = Pair::new();
    for index in indices() {
        for sub_index in [0, 1, 2, 3, 4, 5, 6, 8, 9] {
            for value in VALUES.into_iter().chain(MAPPED) {
                // One, two and four bytes; the size that fits is one of them.
                for command in [0x2F, 0x2B, 0x23] {
                    pair.ask(message(command, index, sub_index, value));
                }
            }
            pair.ask(message(0x40, index, sub_index, 0));
        }
    }
}

#[test]
fn each_mapping_is_accepted_or_refused_as_by_the_node_in_the_process() {
    let mut pair = Pair::new();
    for (pdo, mapped) in [
        (0x1600, &[0x6200_0108; 8][..]),
        (0x1601, &[0x0007_0020, 0x0006_0010, 0x0005_0008, 0x0005_0008]),
        (0x1602, &[0x0007_0020, 0x0007_0020, 0x0005_0008]),
        (0x1603, &[0x6000_0108, 0x6200_0108]),
        (0x1A00, &[0x6401_0110, 0x6401_0110, 0x6401_0110, 0x6401_0110, 0x6000_0108]),
        (0x1A01, &[0x6200_0108, 0, 0x6000_0108]),
        (0x1A02, &[0x6000_0108; 8]),
        (0x1A03, &[0x0005_0008, 0x1001_0008]),
    ] {
        pair.ask(message(0x23, pdo - 0x200, 1, 0x8000_0123));
        for number in [0_u32, 1] {
            pair.ask(message(0x2F, pdo, 0, number));
            for (at, code) in (1..).zip(mapped) {
                pair.ask(message(0x23, pdo, at, *code));
            }
            for number in 0..=9 {
                pair.ask(message(0x2F, pdo, 0, number));
                pair.ask(message(0x40, pdo, 0, 0));
            }
        }
        for sub_index in 0..=9 {
            pair.ask(message(0x40, pdo, sub_index, 0));
        }
        pair.ask(message(0x23, pdo - 0x200, 1, 0x123));
        pair.ask(message(0x23, pdo - 0x200, 1, 0x124));
        pair.ask(message(0x23, pdo - 0x200, 1, 0x4000_0123));
        pair.ask(message(0x2F, pdo, 0, 0));
    }
}

#[test]
fn each_wrong_transfer_is_answered_as_by_the_node_in_the_process() {
    let mut pair = Pair::new();
    for transfer in [
        // Segmented uploads: complete, a wrong toggle bit, a foreign request in between, an abort.
        &["40 08 10 00", "60", "70", "60"][..],
        &["40 08 10 00", "70", "60"],
        &["40 08 10 00", "60", "60", "70"],
        &["40 08 10 00", "40 17 10 00", "60"],
        &["40 08 10 00", "80 08 10 00", "60"],
        &["40 08 10 00", "00 41", "20", "E0", "C0", "C0 02 21 00"],
        &["40 02 21 00", "60", "70", "60", "80 02 21 00"],
        &["40 FF 10 00", "40 08 10 05", "40 00 10 01"],
        // A history without an error.
        &["40 03 10 01", "A4 03 10 01 7F 00", "A4 03 10 00 7F 00"],
        // Segmented downloads to a text: too long, too short, wrong size, no size.
        &["21 01 21 03 03", "00 61 62 63 64 65 66 67", "10", "80 01 21 03"],
        &["21 01 21 03 08", "00 61 62 63 64 65 66 67", "1D 61", "40 01 21 03", "60", "70"],
        &["21 01 21 03 08", "00 61 62 63 64 65 66 67", "11 61"],
        &["21 01 21 03 09", "00 61 62 63 64 65 66 67", "1D 61"],
        &["21 01 21 03 09", "00 61 62 63 64 65 66 67", "0D 61"],
        &["21 01 21 03 11"],
        &[
            "20 01 21 03",
            "00 61 62 63 64 65 66 67",
            "10 61 62 63 64 65 66 67",
            "01 61 62 63 64 65 66 67",
        ],
        &["20 01 21 03", "00 61 62 63 64 65 66 67", "10 61 62 63 64 65 66 67", "0B 61 62"],
        &["20 01 21 03", "0F"],
        &["20 01 21 03", "01 FF FF 00 00 00 00 00"],
        &["21 01 21 02 08", "00 01 02 03 04 05 06 07", "1D 08", "40 01 21 02", "60", "70"],
        &["20 01 21 02", "09 01 02 03"],
        &["20 01 21 02", "00 01 02 03 04 05 06 07", "11 01 02 03 04 05 06 07"],
        &["21 01 21 01 04", "07 00 00 80 3F", "40 01 21 01"],
        &["21 01 21 01 04", "07 00 00 80 40"],
        &[
            "21 01 21 01 05",
            "21 01 21 01 03",
            "22 01 21 01 00 00 80 3F",
            "21 00 10 00 04",
            "21 FF 10 00 04",
        ],
        &["21 17 10 00 02", "0B 0A 00", "21 17 10 00 02", "0D 0A", "20 17 10 00", "09 0A 00 00"],
        &["23 01 21 03 61 62 63 64", "2F 01 21 03 61", "22 01 21 03 61 62 63 64", "40 01 21 03"],
        &["22 02 21 00 00 00 00 00", "23 02 21 00 00 00 00 00", "21 02 21 00 00 00 00 00", "1F"],
        // Block uploads: sizes, the switch of the protocol, too many confirmed, a repeated block, wrong requests.
        &["A4 08 10 00 7F 00", "A3", "A2 02 7F", "A1"],
        &["A0 08 10 00 7F 00", "A3", "A2 00 7F", "A2 01 7F", "A2 02 7F", "A1"],
        &["A4 08 10 00 00 00", "A4 08 10 00 80 00", "A4 08 10 00 7F FF", "60", "70"],
        &[
            "A4 08 10 00 7F 09",
            "A4 17 10 00 7F 04",
            "A4 08 10 00 01 08",
            "A3",
            "A2 01 01",
            "A2 01 01",
            "A1",
        ],
        &["A4 08 10 00 7F 00", "A3", "A2 01 00"],
        &["A4 08 10 00 7F 00", "A3", "A2 03 7F"],
        &["A4 08 10 00 7F 00", "A3", "A2 02 00"],
        &["A4 08 10 00 7F 00", "A3", "A2 02 80"],
        &["A4 08 10 00 7F 00", "A1", "A4 08 10 00 7F 00", "40 17 10 00", "A3"],
        &["A4 08 10 00 7F 00", "A3", "A3", "A4 08 10 00 7F 00", "A3", "A1"],
        &["A4 17 10 00 7F 00", "A3", "A2 01 7F", "A1"],
        &["A4 01 21 03 7F 00", "A3", "A2 01 7F", "A1", "A4 FF 10 00 7F 00", "A4 00 14 00 00 00"],
        &["A4 02 21 00 02 00", "A3", "A2 02 03", "A2 01 02", "A2 02 02", "80 02 21 00"],
        // Block downloads: complete, a wrong CRC, sizes, a lost segment, an abort.
        &["C6 01 21 03 03", "81 61 62 63", "C1"],
        &["C2 01 21 03 03", "81 61 62 63", "D1", "40 01 21 03"],
        &["C2 01 21 03 04", "81 61 62 63", "D1"],
        &["C2 01 21 03 03", "81 61 62 63", "C1"],
        &["C0 01 21 03", "01 61 62 63 64 65 66 67", "82 61 62 63", "D1", "40 01 21 03"],
        &["C0 01 21 03", "02 61", "83 62", "80 01 21 03"],
        &[
            "C0 01 21 03",
            "01 61 62 63 64 65 66 67",
            "02 61 62 63 64 65 66 67",
            "83 61 62 63 64 65 66 67",
            "C1",
        ],
        &["C2 01 21 03 11", "C2 17 10 00 01", "C2 17 10 00 03", "C2 00 10 00 04", "C2 FF 10 00 04"],
        &["C2 17 10 00 02", "81 0A 00", "D5", "C2 17 10 00 02", "81 0A 00", "C1", "A1"],
        &["C2 17 10 00 02", "81 0A 00", "D5 00", "40 17 10 00"],
        // Numbers without an announced length.
        &["20 17 10 00", "0D 0A", "20 17 10 00", "0F", "20 17 10 00", "09 0A 00 00", "40 17 10 00"],
        // No data at all.
        &["C6 01 21 03 00", "81", "DD", "40 01 21 03", "60"],
        &["C4 02 21 00", "81 00 9E 3C DA 78 17 B5", "80 02 21 00"],
        &["C6 02 21 00", "81 01 01 01", "C1", "A3", "A2"],
    ] {
        for request in transfer {
            pair.say(request);
        }
        pair.say("80 00 00 00");
    }
}

#[test]
fn each_command_in_a_transfer_is_answered_as_by_the_node_in_the_process() {
    let mut pair = Pair::new();
    for begin in [
        &[][..],
        &["40 08 10 00"],
        &["21 01 21 03 08"],
        &["A4 08 10 00 7F 00"],
        &["A4 08 10 00 7F 00", "A3"],
        &["A4 08 10 00 01 00", "A3"],
        &["A4 08 10 00 7F 00", "A3", "A2 02 7F"],
        &["C6 01 21 03 03"],
        &["C2 01 21 03 03", "81 61 62 63"],
        &["C6 01 21 03 03", "81 61 62 63"],
        &["C4 02 21 00"],
    ] {
        for command in [
            "00", "01", "0F", "11", "20", "21", "22", "40", "60", "70", "80", "81", "A0", "A1",
            "A2", "A2 01", "A2 01 7F", "A2 01 80", "A2 02 7F", "A3", "C0", "C1", "C2", "D0", "D1",
            "E0", "FF",
        ] {
            begin.iter().for_each(|request| pair.say(request));
            pair.say(command);
            pair.say("80");
            pair.say("80");
        }
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
fn a_text_of_any_length_is_written_and_read_as_by_the_node_in_the_process() {
    let mut pair = Pair::new();
    let read =
        [&["40 01 21 03", "60", "70", "60"][..], &["A4 01 21 03 7F 00", "A3", "A2 00 7F", "80"]];
    let confirm = |len: usize| format!("A2 {:02X} 7F", len.div_ceil(7).max(1));
    for len in [0, 1, 4, 5, 7, 8, 14, 16] {
        let text = [0x41; 16];
        pair.say(&format!("21 01 21 03 {len:02X}"));
        let mut parts = text[..len].chunks(7).peekable();
        let mut toggle = 0;
        loop {
            let part = parts.next().unwrap_or_default();
            let is_last = parts.peek().is_none();
            let command = toggle | (7 - part.len() as u8) << 1 | u8::from(is_last);
            let bytes: String = part.iter().map(|byte| format!(" {byte:02X}")).collect();
            pair.say(&format!("{command:02X}{bytes}"));
            toggle ^= 0x10;
            if is_last {
                break;
            }
        }
        for requests in read {
            requests.iter().for_each(|request| pair.say(request));
        }
        for request in ["A4 01 21 03 7F 00", "A3", &confirm(len), "A1", "80"] {
            pair.say(request);
        }
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
    let of_chip = Readings { slowdown: 10, ..Readings::default() };
    let of_board = board::Settings { chip_readings: of_chip, ..Default::default() };
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
