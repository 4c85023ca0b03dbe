//! The adapters that people have, as their firmware behaves: each of them commissions a network.

use std::{sync::Arc, time::Duration};

use canopen_node::BitRate;
use testkit::slave_bus::Firmware;

use crate::{
    emulated::{Outcome, run},
    in_process::Wire,
};

const RATE: BitRate = BitRate::Kbit125;

/// Runs `lss` with an adapter that has this firmware.
#[track_caller]
fn lss(wire: &Wire, firmware: Firmware, arguments: &str) -> Outcome {
    let adapter = wire.with_firmware(firmware).expect("it is an adapter");
    run(adapter, &Arc::default(), arguments, |_| ())
}

const ALL: [(&str, Firmware); 11] = [
    ("CANUSB", Firmware::CANUSB),
    ("CANable 1.x, 2.0", Firmware::CANABLE),
    ("answers nothing", Firmware::MUTE),
    ("ESP32, CANable 2.5", Firmware::ESP32),
    ("F00", Firmware::NO_ERRORS),
    ("Arduino", Firmware::ARDUINO),
    ("a short queue", Firmware::SHORT_QUEUE),
    ("line feeds", Firmware::LINE_FEEDS),
    ("FTDI", Firmware::FTDI),
    ("echoes", Firmware::ECHO),
    ("forwards each frame twice", Firmware::DOUBLE),
];

#[test]
fn each_adapter_commissions_a_network() {
    for (name, firmware) in ALL {
        let wire = Wire::new(RATE, &[0xFF, 5, 0xFF]);
        let assigned = lss(&wire, firmware, "assign");
        assert_eq!(assigned.code, 0, "{name}: {}", assigned.error);
        let listed = lss(&wire, firmware, "list");
        assert_eq!((listed.code, listed.text.lines().count()), (0, 4), "{name}: {}", listed.error);
        let switched = lss(&wire, firmware, "set-rate 250");
        assert_eq!(switched.code, 0, "{name}: {}", switched.error);
    }
}

#[test]
fn each_adapter_finds_the_bit_rate_of_a_network() {
    for (name, firmware) in ALL {
        // It sends heartbeats, or it is silent until it is asked.
        for (heartbeat_ms, ask) in [(300, ""), (0, "--ask")] {
            let wire = Wire::with_heartbeat(BitRate::Kbit500, &[5, 6], heartbeat_ms);
            let found = lss(&wire, firmware, &format!("find {ask}"));
            let words = "the network runs at 500 kbit/s, and not at 125 kbit/s";
            assert_eq!(found.code, 0, "{name} {ask}: {}{}", found.text, found.error);
            assert!(found.text.contains(words), "{name} {ask}: {}", found.text);
            assert_eq!(found.text.matches("the network runs").count(), 1, "{name} {ask}");
        }
    }
}

#[test]
fn a_frame_that_finds_the_queue_full_is_sent_when_there_is_room() {
    let wire = Wire::new(RATE, &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10]);
    // They take 60 % of the time, and the tool's frames wait.
    wire.load(60, 100_000, 10);
    let listed = lss(&wire, Firmware::SHORT_QUEUE, "list");
    assert_eq!((listed.code, listed.text.lines().count()), (0, 11), "{}", listed.error);
}

#[test]
fn bit_rates_that_the_adapter_lacks_are_named() {
    let lacks = "this adapter does not have 50 kbit/s, 20 kbit/s, 10 kbit/s";
    let wire = Wire::new(BitRate::Kbit20, &[5, 6]);
    for command in ["find", "find --ask"] {
        let outcome = lss(&wire, Firmware::ESP32, command);
        assert_eq!(outcome.code, 3, "{}", outcome.text);
        assert!(outcome.text.contains(lacks), "{}", outcome.text);
    }
    // Boards do not go where the adapter cannot follow.
    let wire = Wire::new(RATE, &[5, 6]);
    let outcome = lss(&wire, Firmware::ESP32, "set-rate 50");
    assert_eq!(outcome.code, 4);
    assert!(outcome.error.ends_with("refuses 50 kbit/s"), "{}", outcome.error);
    assert_eq!(wire.bit_rates(), [RATE, RATE]);
    assert_eq!(lss(&wire, Firmware::ESP32, "list --bit-rate 20").code, 4);
}

#[test]
fn what_a_person_must_know_of_an_adapter_is_told_once() {
    let wire = Wire::with_heartbeat(RATE, &[5], 300);
    for (firmware, words) in [
        (Firmware::MUTE, Some("answers no SLCAN command within 3 s")),
        (Firmware::ESP32, Some("cannot listen only: at a wrong bit rate it disturbs")),
        (Firmware::CANABLE, None),
        (Firmware::ARDUINO, None),
        (Firmware::CANUSB, None),
    ] {
        let remarks = lss(&wire, firmware, "find").remarks;
        assert_eq!(remarks.len(), words.map_or(0, |_| 1), "{remarks:?}");
        assert!(words.is_none_or(|words| remarks[0].contains(words)), "{remarks:?}");
        assert!(firmware.version.is_some() || remarks[0].contains("slcan:mute@BAUD"));
    }
}

#[test]
fn an_adapter_that_listens_only_never_acknowledges() {
    // A node without another one repeats its frame without end, unless the adapter acknowledges it.
    for (firmware, is_silent) in
        [(Firmware::CANABLE, true), (Firmware::CANUSB, true), (Firmware::ESP32, false)]
    {
        let wire = Wire::new(RATE, &[5]);
        let mut adapter = wire.with_firmware(firmware).expect("it is an adapter");
        adapter.open(RATE, can_bus::adapter::Mode::ListenOnly).expect("it listens");
        assert_eq!(wire.bus().may_send(), !is_silent);
        adapter.open(RATE, can_bus::adapter::Mode::Normal).expect("it is opened");
        assert!(wire.bus().may_send());
        assert!(adapter.receive(Duration::ZERO).is_ok());
    }
}

#[test]
fn the_latency_of_an_adapter_is_measured() {
    let wire = Wire::new(RATE, &[]);
    let adapter = wire.with_firmware(Firmware::FTDI).expect("it is an adapter");
    let latency = adapter.latency().expect("it is known");
    assert!((16..=17).contains(&latency.as_millis()), "{latency:?}");
}

#[test]
fn no_answer_is_lost_among_the_process_data_of_a_running_network() {
    let wire = Wire::new(BitRate::Kbit500, &[1, 0xFF]);
    // 950 PDOs in a second, and answers that come late.
    wire.load(1, 1_053, 40);
    let assigned = lss(&wire, Firmware::FTDI, "assign --bit-rate 500");
    assert_eq!((assigned.code, &*assigned.error), (0, ""));
    assert_eq!(wire.ids(), [1, 2].map(|id| (Some(id), Some(id))));
    let listed = lss(&wire, Firmware::FTDI, "list --bit-rate 500");
    assert_eq!((listed.code, listed.text.lines().count()), (0, 3), "{}", listed.error);
}

#[test]
fn nobody_is_absent_if_messages_of_nodes_were_dropped() {
    let wire = Wire::new(BitRate::Kbit1000, &[1, 0xFF]);
    let mut bus = wire.bus();
    let begin = bus.now();
    let heartbeat = canopen_node::Frame::new(0x77F, &[5]).expect("a frame");
    for at in (begin..begin + 10_000_000).step_by(200) {
        bus.send_from_another_master(at, heartbeat);
    }
    drop(bus);
    let assigned = lss(&wire, Firmware::FTDI, "assign --bit-rate 1000");
    assert_eq!(assigned.code, 1, "{}", assigned.text);
    assert!(assigned.error.contains("it is not known who is there"), "{}", assigned.error);
    assert_eq!(wire.ids()[1], (None, None));
}

#[test]
fn an_adapter_that_repeats_frames_is_named_and_neither_another_master_nor_another_board() {
    const LATE: Firmware = Firmware { latency_ms: 16, ..Firmware::DOUBLE };
    let echoes = "the adapter echoes";
    let doubles = "each frame comes twice, faster than a bus is: the adapter";
    for (firmware, words, rate, boards) in [
        (Firmware::ECHO, echoes, RATE, &[0xFF][..]),
        (Firmware::ECHO, echoes, RATE, &[0xFF, 5, 0xFF]),
        (Firmware::DOUBLE, doubles, RATE, &[5]),
        (Firmware::DOUBLE, doubles, RATE, &[0xFF, 5, 0xFF]),
        (Firmware::DOUBLE, doubles, BitRate::Kbit1000, &[5, 6]),
        (LATE, doubles, RATE, &[5, 6]),
    ] {
        for command in ["list", "assign", "set-rate 250"] {
            let wire = Wire::new(rate, boards);
            let command = format!("{command} --bit-rate {}", rate.kbit_per_s());
            let outcome = lss(&wire, firmware, &command);
            assert_eq!((outcome.code, &*outcome.error), (0, ""), "{words} {boards:?} {command}");
            assert_eq!((outcome.remarks.len(), outcome.twice.len()), (1, 0), "{command}");
            assert!(outcome.remarks[0].contains(words), "{:?}", outcome.remarks);
        }
    }
    // Two boards with one LSS address do the same, if the adapter gathers their frames.
    let listed = lss(&Wire::new(RATE, &[5]), LATE, "list");
    assert_eq!((listed.code, listed.remarks.len()), (1, 0));
    assert!(listed.error.contains("If there is only one, the adapter forwards each frame twice"));
}

#[test]
fn answers_of_two_boards_that_an_adapter_gathers_are_no_repetition() {
    for latency_ms in [2, 3, 4] {
        let gathers = Firmware { latency_ms, gathers: true, ..Firmware::CANUSB };
        let wire = Wire::new(RATE, &[0xFF, 0xFF]);
        // They never answer at the same moment.
        wire.bus().slaves[1].habits.answer_us = 300..301;
        for command in ["list", "assign", "list"] {
            let outcome = lss(&wire, gathers, command);
            assert_eq!((outcome.code, outcome.remarks), (0, vec![]), "{}", outcome.error);
        }
    }
}
