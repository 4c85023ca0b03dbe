//! The release image on paths that a healthy bus, a patient master and a sound flash do not take. `cargo verify coverage`
//! shows them.

use canopen_node::BitRate;
use emulator::{
    Time,
    board::{self, Board},
    chip::{Access, ChipVariant, ResetCause, StuckBits, Timing, Width},
    network::{Short, What},
};
use firmware::device::DEFAULTS;
use testkit::{
    frames::{self, Frames, SILENCE},
    sdo,
};

use crate::rig::{
    DEFAULT_BIT_RATE, ImageRig, SETTINGS_LENGTH, SETTINGS_OFFSET, blank_board, blank_rig,
    flash_with, image, on_the_wire, part, rig_with, settings,
};

/// The last sector of the settings' flash begins here.
const SECOND_BANK: usize = SETTINGS_LENGTH / 2;

fn node_40(heartbeat_ms: u16) -> ImageRig {
    let mut rig = rig_with(settings(0x40, BitRate::Kbit1000).with_heartbeat_ms(heartbeat_ms));
    rig.collect(Time::from_ms(20));
    rig
}

/// The answers of the SDO server of node 40.
fn sdo(rig: &mut ImageRig, request: &str) -> Frames {
    rig.transmit(on_the_wire(&sdo::request(0x40, request)));
    let frames = rig.collect(Time::from_ms(5)).0;
    Frames(frames.into_iter().filter(|frame| frame.cob_id() == 0x5C0).collect())
}

fn read(rig: &mut ImageRig, object: &str) -> u32 {
    let [answer] = sdo(rig, &format!("40 {object}")).0[..] else {
        panic!("no answer for {object}")
    };
    u32::from_le_bytes(*answer.data().last_chunk().expect("eight bytes"))
}

#[test]
fn each_wrong_sdo_request_has_its_abort_code() {
    let mut rig = node_40(0);
    for (request, answer) in [
        ("2F 03 10 00 05", "80 03 10 00 30 00 09 06"),
        ("2F 03 10 00 00", "60 03 10 00 00 00 00 00"),
        ("2B 17 10 00 64", "60 17 10 00 00 00 00 00"),
        ("22 17 10 00 64", "60 17 10 00 00 00 00 00"),
        ("2F 17 10 00 64", "80 17 10 00 13 00 07 06"),
        ("23 17 10 00 64", "80 17 10 00 12 00 07 06"),
        ("21 17 10 00 01", "80 17 10 00 13 00 07 06"),
        ("21 17 10 00 03", "80 17 10 00 12 00 07 06"),
        ("21 17 10 00 02", "60 17 10 00 00 00 00 00"),
        ("0D 64 00", "80 17 10 00 13 00 07 06"),
        ("20 17 10 00 02", "60 17 10 00 00 00 00 00"),
        ("1B 64 00", "80 17 10 00 00 00 03 05"),
        ("C6 17 10 00 02", "A4 17 10 00 7F 00 00 00"),
        ("81 64 00", "A2 01 7F 00 00 00 00 00"),
        ("D5 FF FF", "80 17 10 00 04 00 04 05"),
        ("A4 08 10 00 80", "80 08 10 00 02 00 04 05"),
        ("23 10 10 01 73 61 76 66", "80 10 10 01 20 00 00 08"),
        ("2F 29 10 01 03", "80 29 10 01 30 00 09 06"),
        ("60", "80 00 00 00 01 00 04 05"),
        ("40 08 10 00", "41 08 10 00 09 00 00 00"),
        ("70", "80 08 10 00 00 00 03 05"),
        ("60", "80 00 00 00 01 00 04 05"),
        ("40 09 10 00", "47 09 10 00 31 2E 30 00"),
        ("E0 12 34 56", "80 12 34 56 01 00 04 05"),
        ("40 00 10 01", "80 00 10 01 11 00 09 06"),
        ("40 FF FF FF", "80 FF FF FF 00 00 02 06"),
        ("40 00 00 00", "80 00 00 00 00 00 02 06"),
        ("2F 01 10 00 00", "80 01 10 00 02 00 01 06"),
    ] {
        assert_eq!(sdo(&mut rig, request).texts(), [format!("5C0: {answer}")], "{request}");
    }
    assert_eq!(sdo(&mut rig, "80 17 10 00"), SILENCE);
}

#[test]
fn the_history_keeps_the_latest_eight_of_ten_errors() {
    let mut rig = node_40(100);
    for _ in 0..5 {
        rig.network.set_short(Some(Short::Recessive));
        rig.network.run_for(Time::from_s(1));
        rig.network.set_short(None);
        rig.collect(Time::from_s(3));
    }
    assert_eq!(read(&mut rig, "03 10 00"), 8);
    for sub_index in 1..=8 {
        let error = read(&mut rig, &format!("03 10 {sub_index:02X}"));
        assert!(matches!(error, 0x8120 | 0x8140), "{error:X}");
    }
}

#[test]
fn a_core_that_is_too_slow_for_the_bus_reports_lost_frames() {
    let of_chip = ChipVariant { slowdown: 150, ..ChipVariant::default() };
    let of_board = board::Settings { chip_variant: of_chip, ..Default::default() };
    let mut board = Board::new(part(), image(), of_board);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(0x40, BitRate::Kbit1000)]));
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    rig.collect(Time::from_ms(100));
    for _ in 0..40 {
        rig.queue(&canopen_node::Frame::new(0x7E5, &[]).expect("a frame"));
    }
    let sent = rig.collect(Time::from_ms(200)).texts();
    assert!(rig.has_logged("CAN: overrun, a received frame was lost"));
    assert!(sent.iter().any(|text| text.starts_with("0C0: 10 81 11")), "{sent:?}");
    assert!(sent.iter().any(|text| text.starts_with("0C0: 00 00 00")), "{sent:?}");
}

#[test]
fn lost_settings_are_the_only_error_until_the_next_store() {
    let mut board = blank_board(0);
    board.set_flash(SETTINGS_OFFSET, &[0; SETTINGS_LENGTH]);
    let mut rig = ImageRig::new(DEFAULT_BIT_RATE, [board]);
    for request in ["04 01", "11 40", "04 00"] {
        rig.lss(request);
    }
    rig.collect(Time::from_ms(50));
    assert_eq!(read(&mut rig, "01 10 00") & 0xFF, 1);
    assert_eq!(read(&mut rig, "03 10 01"), 0x6310);
    rig.lss("04 01");
    rig.lss("17");
    rig.collect(Time::from_ms(50));
    assert_eq!(read(&mut rig, "01 10 00") & 0xFF, 0);
}

#[test]
fn a_detection_that_continues_keeps_its_result() {
    let mut rig = node_40(100);
    for request in ["04 01", "13 00 09"] {
        rig.lss(request);
    }
    rig.transmit_request("15 0A 00");
    rig.network.run_for(Time::from_ms(10));
    rig.set_master_bit_rate(BitRate::Kbit250);
    assert!(rig.is_reached());
    for request in ["04 01", "13 00 09"] {
        rig.lss(request);
    }
    rig.transmit_request("15 0A 00");
    rig.collect(Time::from_ms(100));
    assert!(rig.is_reached());
}

#[test]
fn fastscan_ignores_steps_beyond_32_bits_and_four_parts() {
    let mut rig = blank_rig();
    assert_eq!(rig.lss("51 00 00 00 00 80 00 00"), ["4F"]);
    for bit_check in ["20", "21", "7F"] {
        assert_eq!(rig.lss(&format!("51 00 00 00 00 {bit_check} 00 00")), SILENCE, "{bit_check}");
    }
    assert_eq!(rig.lss("51 00 00 00 00 1F 00 04"), SILENCE, "there is no fifth part");
    assert_eq!(rig.lss("51 00 00 00 00 1F 01 01"), SILENCE, "the first part is awaited");
    assert_eq!(rig.lss("51 00 00 00 00 1F 00 00"), ["4F"]);
}

#[test]
fn of_nmt_commands_during_a_switch_the_reset_of_the_node_counts() {
    for commands in [["01 40", "81 40", "82 40", "01 40"], ["82 40", "01 40", "81 40", "82 40"]] {
        let mut rig = node_40(0);
        rig.lss("04 01");
        rig.transmit_request("15 64 00");
        for command in commands {
            rig.transmit_command(command);
        }
        rig.network.allow_reset(0, ResetCause::Software);
        rig.collect(Time::from_ms(300));
        assert_eq!(rig.network.board(0).resets().len(), 2, "{commands:?}");
    }
}

#[test]
fn a_board_without_a_node_id_does_not_start() {
    let mut rig = blank_rig();
    assert_eq!(rig.nmt("01 00"), SILENCE);
    for request in ["04 01", "11 40"] {
        rig.lss(request);
    }
    assert_eq!(rig.lss("04 00"), ["740: 00"]);
    assert_eq!(rig.collect(Time::from_ms(1_050)), ["740: 7F"]);
}

#[test]
fn error_behaviour_2_stops_the_node_at_bus_off() {
    for state in ["01 00", "80 00"] {
        let mut rig = node_40(100);
        rig.transmit_command(state);
        sdo(&mut rig, "2F 29 10 01 02");
        rig.network.set_short(Some(Short::Recessive));
        rig.network.run_for(Time::from_s(1));
        rig.network.set_short(None);
        let sent = rig.collect(Time::from_s(4)).texts();
        assert_eq!(sent.last().map(String::as_str), Some("740: 04"), "{state}");
    }
}

#[test]
fn bus_off_before_the_first_boot_up_does_not_stop_the_node() {
    let mut rig = blank_rig();
    rig.lss("04 01");
    rig.network.set_short(Some(Short::Recessive));
    rig.queue(&frames::request("5E"));
    rig.network.run_for(Time::from_s(1));
    rig.network.set_short(None);
    rig.collect(Time::from_s(4));
    assert!(rig.is_reached());
}

/// Passes time that the board does not notice but in its count.
fn skip_minutes(rig: &ImageRig, minutes: u32) {
    const TIM2_CNT: u32 = 0x4000_0024;
    let board = rig.network.board(0);
    let counter = Access { address: TIM2_CNT, width: Width::Word, now: board.now(), pc: 0 };
    let count = board.chip().read(counter).expect("a register");
    board.chip().write(counter, count.wrapping_add(minutes * 60_000_000)).expect("a register");
}

#[test]
fn heartbeats_go_on_after_more_than_half_an_hour_without_one() {
    let mut rig = node_40(0);
    skip_minutes(&rig, 40);
    assert_eq!(read(&mut rig, "17 10 00") & 0xFFFF, 0);
    sdo(&mut rig, "2B 17 10 00 14");
    rig.collect(Time::from_ms(20));
    assert_eq!(rig.collect(Time::from_ms(60)).0.len(), 3);
    skip_minutes(&rig, 40);
    assert_eq!(read(&mut rig, "17 10 00") & 0xFFFF, 20);
    rig.collect(Time::from_ms(20));
    assert_eq!(rig.collect(Time::from_ms(60)).0.len(), 3);
}

#[test]
fn a_fast_heartbeat_resumes_once_after_a_pause() {
    let mut rig = node_40(1);
    rig.network.adapter_mut(rig.master).close();
    rig.network.run_for(Time::from_ms(400));
    rig.network.adapter_mut(rig.master).open();
    rig.collect(Time::from_ms(200));
    let sent = rig.collect(Time::from_ms(100)).0.len();
    assert!((99..=101).contains(&sent), "{sent} heartbeats");
}

/// Node 40 on a board with the slowest flash, and with the request to store the heartbeat time just sent.
fn saving() -> ImageRig {
    let mut rig = node_40(0);
    rig.network.board(0).chip().flash_mut().set_timing(Timing::Worst);
    rig.queue(&sdo::request(0x40, "2B 17 10 00 E8 03"));
    rig.queue(&sdo::request(0x40, "23 10 10 01 73 61 76 65"));
    rig
}

#[test]
fn one_save_runs_and_one_waits_and_a_third_is_refused() {
    let mut rig = saving();
    rig.queue(&sdo::request(0x40, "23 10 10 01 73 61 76 65"));
    rig.queue(&sdo::request(0x40, "23 11 10 01 6C 6F 61 64"));
    for _ in 0..3 {
        rig.queue(&sdo::request(0x40, "23 10 10 01 73 61 76 65"));
    }
    let answers = rig.collect(Time::from_ms(50)).texts();
    assert!(answers.contains(&"5C0: 80 11 10 01 21 00 00 08".to_owned()), "{answers:?}");
    let count = |end: &str| answers.iter().filter(|text| **text == format!("5C0: {end}")).count();
    let (done, refused) = (count("60 10 10 01 00 00 00 00"), answers.len() - 1);
    assert!(done >= 2 && refused > done, "{answers:?}");
}

#[test]
fn a_reset_or_a_stop_during_a_save_leaves_it_unanswered_but_done() {
    for (command, delay) in [
        ("02 40", 300),
        ("02 40", 150),
        ("82 40", 300),
        ("82 40", 500),
        ("82 40", 150),
        ("80 40", 300),
    ] {
        let mut rig = saving();
        rig.network.run_for(Time::from_us(delay));
        rig.queue(&frames::command(command));
        rig.collect(Time::from_ms(50));
        rig.power_cycle(0);
        rig.collect(Time::from_ms(20));
        assert_eq!(read(&mut rig, "17 10 00"), 1000, "{command} after {delay} us");
    }
}

#[test]
fn a_save_to_a_protected_flash_is_aborted() {
    let mut rig = node_40(0);
    rig.network.board(0).chip().flash_mut().protect_sectors(0b110);
    sdo(&mut rig, "2B 17 10 00 E8 03");
    assert_eq!(sdo(&mut rig, "23 10 10 01 73 61 76 65"), ["5C0: 80 10 10 01 00 00 06 06"]);
}

/// CRC-32 of IEEE 802.3.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32| if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
    !bytes
        .iter()
        .fold(u32::MAX, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), |crc, _| step(crc)))
}

/// The content of the settings' flash with one record, whose kind, node-ID and bit rate are these.
fn one_record(kind: u8, node_id: u8, bit_rate: u8) -> Vec<u8> {
    let mut record = [0xFF; 32];
    record[..7].copy_from_slice(&[9, 0, 0, 0, kind, node_id, bit_rate]);
    record[8..10].copy_from_slice(&[0, 0]);
    let crc = crc32(&record[..24]);
    record[24..28].copy_from_slice(&crc.to_le_bytes());
    record[28..].copy_from_slice(b"LSS1");
    let mut content = vec![0xFF; SETTINGS_LENGTH];
    content[..32].copy_from_slice(&record);
    content
}

/// The node-ID of a board that boots with this content of its flash; FF for none.
fn node_id_with(content: &[u8], rate: BitRate) -> u8 {
    let mut board = blank_board(0);
    board.set_flash(SETTINGS_OFFSET, content);
    let mut rig = ImageRig::new(rate, [board]);
    rig.lss("04 01");
    let answers = rig.lss("5E").0;
    answers.iter().find(|frame| frame.data()[0] == 0x5E).expect("an answer").data()[1]
}

#[test]
fn a_record_counts_only_with_a_known_kind_and_legal_values() {
    assert_eq!(node_id_with(&one_record(1, 0x40, 0), BitRate::Kbit1000), 0x40);
    assert_eq!(node_id_with(&one_record(0, 0xFF, 0xFF), DEFAULT_BIT_RATE), 0xFF);
    for (kind, node_id, bit_rate) in [
        (2, 0x40, 0),
        (0xFF, 0x40, 0),
        (1, 0, 0),
        (1, 0x80, 0),
        (1, 0xFE, 0),
        (1, 0x40, 5),
        (1, 0x40, 10),
    ] {
        let content = one_record(kind, node_id, bit_rate);
        assert_eq!(node_id_with(&content, DEFAULT_BIT_RATE), 0xFF, "{kind} {node_id} {bit_rate}");
    }
    let mut damaged = one_record(1, 0x40, 0);
    damaged[20] = 0;
    assert_eq!(node_id_with(&damaged, DEFAULT_BIT_RATE), 0xFF);
}

#[test]
fn a_board_boots_with_any_damage_to_either_bank() {
    let valid = flash_with(&[settings(0x40, DEFAULT_BIT_RATE)]);
    let (blank, junk) = (vec![0xFF; SECOND_BANK], vec![0x5A; SECOND_BANK]);
    let record = valid[..SECOND_BANK].to_vec();
    for (first, second, node_id) in [
        (&blank, &blank, 0xFF),
        (&blank, &junk, 0xFF),
        (&junk, &blank, 0xFF),
        (&junk, &junk, 0xFF),
        (&record, &blank, 0x40),
        (&record, &junk, 0x40),
        (&blank, &record, 0x40),
        (&junk, &record, 0x40),
        (&record, &record, 0x40),
    ] {
        let content = [first.as_slice(), second].concat();
        assert_eq!(node_id_with(&content, DEFAULT_BIT_RATE), node_id);
    }
}

#[test]
fn a_board_whose_flash_fails_at_the_start_still_has_its_settings() {
    let mut content = flash_with(&[settings(0x40, BitRate::Kbit1000)]);
    // A store that was cut off after its first word.
    content[160..164].copy_from_slice(&[5, 2, 0, 0]);
    for stuck in [192, 192 + 28] {
        let mut board = blank_board(0);
        board.set_flash(SETTINGS_OFFSET, &content);
        // The next two places.
        for offset in [SETTINGS_OFFSET + stuck, SETTINGS_OFFSET + stuck + 32] {
            let bits = StuckBits { offset, mask: 0b1001, value: 0b1001 };
            board.chip().flash_mut().add_stuck_bits(bits);
        }
        let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
        assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
        assert!(rig.has_logged("the flash failed, a store may fail too"));
    }
}

#[test]
fn a_new_board_with_a_weak_supply_answers_and_stores() {
    let mut board = blank_board(0);
    board.set_supply(2_500);
    let mut rig = ImageRig::new(DEFAULT_BIT_RATE, [board]);
    assert!(rig.has_logged("the supply is below 2.7 V, which the clock needs"));
    assert_eq!(rig.lss("4C"), ["50"]);
    rig.lss("04 01");
    assert_eq!(rig.lss("11 05"), ["11 00"]);
    assert_eq!(rig.lss("17"), ["17 00"]);
    rig.power_cycle(0);
    rig.collect(Time::from_s(1));
    assert_eq!(rig.lss("04 01"), SILENCE);
    assert_eq!(rig.lss("5E"), ["5E 05"]);
}

#[test]
fn a_board_recovers_from_bus_off_at_a_slow_rate() {
    let mut rig = rig_with(settings(0x40, BitRate::Kbit20).with_heartbeat_ms(300));
    rig.collect(Time::from_ms(50));
    rig.network.set_short(Some(Short::Recessive));
    rig.network.run_for(Time::from_s(8));
    rig.network.set_short(None);
    rig.collect(Time::from_s(4));
    assert!(rig.did(0, Time::ZERO).any(|event| event.what == What::BusOff));
    assert!(rig.has_logged("CAN: recovered from bus-off"));
    assert!(rig.collect(Time::from_s(1)).texts().contains(&"740: 7F".to_owned()));
}

#[test]
fn of_the_heartbeats_that_a_full_bus_delays_one_remains() {
    let mut rig = node_40(20);
    let urgent = canopen_node::Frame::new(0x001, &[0x55; 8]).expect("a frame");
    for command in ["01 40", "02 40"] {
        (0..800).for_each(|_| rig.queue(&urgent));
        rig.queue(&frames::command(command));
    }
    while rig.network.adapter_mut(rig.master).unsent() > 0 {
        rig.network.run_for(Time::from_ms(1));
    }
    let sent = rig.collect(Time::from_ms(1)).texts();
    let heartbeats: Vec<_> = sent.iter().filter(|text| text.starts_with("740")).collect();
    assert_eq!(heartbeats, ["740: 7F"]);
    let sent = rig.collect(Time::from_ms(21)).texts();
    assert!(sent.contains(&"740: 04".to_owned()), "{sent:?}");
}

#[test]
fn settings_are_saved_and_defaults_restored_in_operational() {
    let mut rig = node_40(0);
    rig.transmit_command("01 40");
    sdo(&mut rig, "2B 17 10 00 14");
    for (request, answer) in [
        ("23 10 10 01 73 61 76 65", "60 10 10 01 00 00 00 00"),
        ("23 11 10 01 6C 6F 61 65", "80 11 10 01 20 00 00 08"),
        ("23 11 10 01 6C 6F 61 64", "60 11 10 01 00 00 00 00"),
    ] {
        assert_eq!(sdo(&mut rig, request).texts(), [format!("5C0: {answer}")], "{request}");
    }
    let restore = sdo::request(0x40, "23 11 10 01 6C 6F 61 64");
    (0..8).for_each(|_| rig.queue(&restore));
    let sent = rig.collect(Time::from_ms(50)).texts();
    let confirmed = sent.iter().filter(|text| *text == "5C0: 60 11 10 01 00 00 00 00");
    assert_eq!(confirmed.count(), 8, "{sent:?}");
    rig.power_cycle(0);
    rig.collect(Time::from_ms(50));
    assert_eq!(read(&mut rig, "17 10 00"), u32::from(DEFAULTS.heartbeat_ms));
}

#[test]
fn a_request_right_behind_the_loss_of_the_node_id_is_ignored() {
    for (configure, boot_up) in [("11 FF", &SILENCE[..]), ("11 41", &["741: 00"])] {
        let of_chip = ChipVariant { slowdown: 30, ..ChipVariant::default() };
        let of_board = board::Settings { chip_variant: of_chip, ..Default::default() };
        let mut board = Board::new(part(), image(), of_board);
        board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(0x40, BitRate::Kbit1000)]));
        let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
        rig.collect(Time::from_ms(100));
        for request in ["04 01", configure] {
            rig.lss(request);
        }
        rig.queue(&frames::command("82 40"));
        rig.queue(&sdo::request(0x40, "40 17 10 00"));
        assert_eq!(rig.collect(Time::from_ms(50)).texts(), *boot_up, "{configure}");
    }
}
