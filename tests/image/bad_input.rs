//! The release image with a damaged flash, and on a bus without nodes or with a short circuit.

use std::fs;

use testkit::{cargo::workspace, settings::record};

use crate::rig::*;

#[test]
fn other_data_in_the_flash_is_erased_without_an_emergency() {
    let mut random = Random::from_environment();
    let contents = [vec![0; 0x8000], (0..0x8000).map(|_| random.byte()).collect()];
    for content in contents {
        let mut rig = ImageRig::new(DEFAULT_BIT_RATE, [board_with_flash(&content)]);
        let log = rig.log(0);
        let what = "other data found, erased; using the defaults";
        assert!(log.iter().any(|line| line.level == "info" && line.text == what), "{log:#?}");
        assert_eq!(rig.lss("4C, 04 01, 11 04"), ["50", "11 00"]);
        assert_eq!(rig.lss("04 00"), ["704: 00"], "no emergency message");
        assert_eq!(rig.sdo_client(4).number(0x1001, 0), 0);
    }
}

/// A probe resets the chip by SYSRESETREQ.
#[test]
fn the_log_after_the_first_flash_is_the_one_that_the_page_shows() {
    let mut board = blank_board(0);
    board.reset(ResetCause::Software);
    while board.now() < Time::from_s(2) {
        board.run_until(Time::from_s(2));
    }
    let log = log::lines(&board).into_iter();
    let logged: Vec<_> =
        log.map(|line| format!("{:<6}{}", line.level.to_uppercase(), line.text)).collect();
    let page = fs::read_to_string(workspace().join("docs/first-board.md")).expect("it is there");
    let shown: Vec<_> = page.lines().filter(|line| line.starts_with("INFO  ")).collect();
    assert_eq!(logged, shown);
}

#[test]
fn a_damaged_flash_boots_the_default_settings_and_logs_why() {
    let log = flash_with(&[settings(0x40, BitRate::Kbit1000), settings(4, BitRate::Kbit1000)]);
    // The node-ID in each record, a bit rate, a sequence.
    for byte in [9, 10, 4] {
        let mut damaged = log.clone();
        damaged[..0x4000 / PLACE * PLACE].chunks_mut(PLACE).for_each(|place| place[byte] ^= 0x80);
        let mut rig = ImageRig::new(DEFAULT_BIT_RATE, [board_with_flash(&damaged)]);
        let log = rig.log(0);
        let why = "the settings in the flash are damaged; using the defaults";
        assert!(log.iter().any(|line| line.level == "error" && line.text == why), "{log:#?}");
        assert_eq!(rig.lss("4C, 04 01, 11 04"), ["50", "11 00"]);
        assert_eq!(
            rig.lss("04 00"),
            ["704: 00", "084: 10 63 01 00 00 00 00 00"],
            "an emergency message once there is a node-ID"
        );
        let errors = |rig: &mut ImageRig| {
            [(0x1001, 0), (0x1003, 1)]
                .map(|(index, sub_index)| rig.sdo_client(4).number(index, sub_index))
        };
        assert_eq!(errors(&mut rig), [1, 0x6310]);
        rig.ask("04 01, 17", "17 00");
        rig.collect(Time::from_ms(50));
        assert_eq!(errors(&mut rig)[0], 0);
        rig.power_cycle(0);
        assert_eq!(rig.collect(Time::from_ms(20)), ["704: 00"]);
    }
}

#[test]
fn settings_in_the_layout_of_another_version_stay_and_the_log_says_so() {
    // Without what precedes and follows each record, as in earlier versions.
    let content: Vec<u8> = (0..1024).flat_map(|n| record(n, 1, 5, 2)).collect();
    let mut rig = ImageRig::new(DEFAULT_BIT_RATE, [board_with_flash(&content)]);
    let log = rig.log(0);
    let why = "the flash holds settings of another version: load that version, or erase them";
    assert!(log.iter().any(|line| line.level == "error" && line.text == why), "{log:#?}");
    assert_eq!(rig.lss("04 01, 11 04, 17"), ["11 00", "17 02"]);
    assert_eq!(rig.lss("04 00"), ["704: 00", "084: 10 63 01 00 00 00 00 00"]);
    let flash = rig.network.board(0).flash();
    assert!(flash[SETTINGS_OFFSET as usize..][..SETTINGS_LENGTH] == content);
}

#[test]
fn after_a_torn_last_record_the_board_uses_the_one_before_and_logs_it() {
    let old = settings(0x40, BitRate::Kbit1000);
    let mut flash = flash_with(&[old, settings(0x04, BitRate::Kbit1000)]);
    let places = || flash[..0x4000].chunks_exact(PLACE);
    let last = places().rposition(|place| place != [0xFF; PLACE]).expect("a record");
    // Neither its CRC nor what follows.
    flash[PLACE * last + 28..][..12].fill(0xFF);
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board_with_flash(&flash)]);
    assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
    let log = log::lines(rig.network.board(0));
    let why = "a store was interrupted or its record is unknown; using the settings before it";
    assert!(log.iter().any(|line| line.level == "warn" && line.text == why), "{log:#?}");
}

#[test]
fn a_board_alone_on_the_bus_keeps_its_rate_and_answers_a_late_master() {
    let just_switched_on = (0..12).map(|step| (true, 50, Time::from_ms(50 + 60 * step)));
    // 35 s are longer than a switch is trusted.
    for (is_new, heartbeat_ms, span) in just_switched_on.chain([(false, 500, Time::from_s(35))]) {
        let mut rig = node_40(heartbeat_ms);
        let from = rig.network.now();
        if is_new {
            rig.restart_unattended();
        }
        rig.network.adapter_mut(rig.master).close();
        rig.network.run_for(span);
        assert!(rig.did(0, from).any(|event| matches!(event.what, What::Error { .. })));
        assert!(!rig.did(0, from).any(|event| event.what == What::BusOff), "only error passive");
        rig.network.adapter_mut(rig.master).open();
        rig.send("04 01, 5E");
        let sent = rig.collect(Time::from_ms(20));
        assert!(sent.texts().iter().any(|text| text.starts_with("7E4: 5E 40")), "{sent:?}");
        assert!(sent.0.len() < 20, "only the waiting frames: {sent:?}");
        assert_eq!(rig.bit_rates(0, from).len(), usize::from(is_new), "set at the start only");
    }
}

#[test]
fn a_board_that_is_driven_bus_off_recovers_and_reports_it() {
    for (bit_rate, short, recovery) in [
        (BitRate::Kbit500, Time::from_ms(100), Time::from_s(1)),
        (BitRate::Kbit20, Time::from_s(8), Time::from_s(4)),
    ] {
        let mut rig = rig_with(settings(0x40, bit_rate).with_heartbeat_ms(100));
        rig.lss("04 01");
        let from = rig.network.now();
        rig.short_circuit(Short::Recessive, short);
        assert!(rig.did(0, from).any(|event| event.what == What::BusOff));
        let sent = rig.collect(recovery).texts();
        for expected in ["740: 7F", "0C0: 40 81 11", "0C0: 00 00 00"] {
            assert!(sent.iter().any(|text| text.starts_with(expected)), "{expected}: {sent:?}");
        }
        assert!(answers(&mut rig));
        assert!(rig.has_logged("CAN: bus-off"));
        assert!(rig.has_logged("CAN: recovered from bus-off"));
    }
}

#[test]
fn a_board_that_was_left_alone_reports_error_passive_and_its_end_once() {
    let mut rig = rig_with(settings(0x40, BitRate::Kbit500).with_heartbeat_ms(100));
    rig.collect(Time::from_ms(50));
    for span in [Time::from_ms(300), Time::from_s(5)] {
        rig.network.adapter_mut(rig.master).close();
        rig.network.run_for(span);
        rig.network.adapter_mut(rig.master).open();
        let mut sent = rig.collect(Time::from_s(2)).texts();
        sent.retain(|text| text.starts_with("0C0"));
        assert_eq!(sent, ["0C0: 20 81 11 00 00 00 00 00", "0C0: 00 00 00 00 00 00 00 00"]);
    }
}
