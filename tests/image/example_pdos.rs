//! The process data of the example `io` and of the node in the process, which get the same frames.

use canopen_node::{BitRate, Frame};
use emulator::{Time, network::Short};
use testkit::{
    frames,
    image_rig::{ImageRig, flash_with, on_the_wire, settings},
    sdo::{self, Client},
};

use crate::example_pair::{NODE_ID, Pair, message, rig};

/// Without the PDOs of the application, and NMT operational.
fn operational() -> Pair {
    let mut pair = Pair::new();
    for index in [0x1800, 0x1801, 0x1400] {
        pair.ask(message(0x23, index, 1, 0x8000_0000));
    }
    pair.rig.nmt("01 00");
    pair.model.nmt("01 00");
    pair
}

/// Writes a PDO with this COB-ID, transmission type, SYNC start value and mapping.
fn set_pdo(
    pair: &mut Pair,
    index: u16,
    cob_id: u32,
    kind: u32,
    start: Option<u32>,
    mapping: &[u32],
) {
    pair.ask(message(0x23, index, 1, 0x8000_0000 | cob_id));
    pair.ask(message(0x2F, index, 2, kind));
    if let Some(start) = start {
        pair.ask(message(0x2F, index, 6, start));
    }
    pair.ask(message(0x2F, index + 0x200, 0, 0));
    for (at, mapped) in (1..).zip(mapping) {
        pair.ask(message(0x23, index + 0x200, at, *mapped));
    }
    pair.ask(message(0x2F, index + 0x200, 0, mapping.len() as u32));
    pair.ask(message(0x23, index, 1, cob_id));
}

fn pdos_after(pair: &mut Pair, cob_id: u16, data: &[u8]) -> usize {
    pair.exchange(&Frame::new(cob_id, data).expect("a frame"), 0x181..=0x57F)
}

const OUTPUTS: u32 = 0x6200_0108;

#[test]
fn each_kind_of_synchronous_tpdo_follows_its_sync() {
    let mut pair = operational();
    pair.ask(message(0x2F, 0x1019, 0, 10));
    for (kind, start, counts) in [
        (1, 0, [1, 1, 1, 1, 1, 1]),
        (2, 0, [0, 1, 0, 1, 0, 1]),
        (1, 3, [0, 0, 1, 1, 1, 1]),
        (2, 3, [0, 0, 0, 1, 0, 1]),
        (0, 0, [1, 0, 0, 1, 0, 0]),
        (0, 2, [0, 1, 0, 1, 0, 0]),
        (240, 0, [0, 0, 0, 0, 0, 0]),
        (255, 0, [0, 0, 0, 0, 0, 0]),
    ] {
        pair.ask(message(0x2F, 0x6200, 1, 0));
        set_pdo(&mut pair, 0x1802, 0x181, kind, Some(start), &[OUTPUTS]);
        for (counter, count) in (1..).zip(counts) {
            if counter == 4 && kind < 255 {
                pair.ask(message(0x2F, 0x6200, 1, 1));
            }
            assert_eq!(pdos_after(&mut pair, 0x80, &[counter]), count, "{kind} {start} {counter}");
        }
    }
}

#[test]
fn each_rpdo_takes_effect_at_its_time_and_maps_on_dummies() {
    let mut pair = operational();
    set_pdo(&mut pair, 0x1802, 0x181, 255, None, &[OUTPUTS]);
    for (at, kind) in [(0, 255), (1, 254), (2, 0), (3, 240)] {
        let mapping = [&[0x0005_0008; 7][..], &[OUTPUTS]].concat();
        set_pdo(&mut pair, 0x1400 + at, 0x201 + u32::from(at), kind, None, &mapping);
        // The outputs are at most 3.
        for outputs in [1, 2, 5, 3, 0] {
            pdos_after(&mut pair, 0x201 + at, &[9, 9, 9, 9, 9, 9, 9, outputs]);
            pdos_after(&mut pair, 0x80, &[]);
        }
        set_pdo(&mut pair, 0x1400 + at, 0x201 + u32::from(at), kind, None, &[]);
        pdos_after(&mut pair, 0x201 + at, &[1]);
        pdos_after(&mut pair, 0x80, &[]);
        pair.ask(message(0x23, 0x1400 + at, 1, 0x8000_0000));
    }
}

/// Writes these objects of node 40.
fn write(rig: &mut ImageRig, requests: &[[u8; 8]]) {
    for request in requests {
        rig.transmit(on_the_wire(&Frame::new(0x640, request).expect("a frame")));
        let answers = rig.collect(Time::from_ms(5)).0;
        assert!(answers.iter().any(|answer| answer.data()[0] == 0x60), "{request:02X?}");
    }
}

fn is_short_pdo(frame: &&Frame) -> bool {
    frame.cob_id() == 0x0C0 && frame.data()[..2] == [0x10, 0x82]
}

#[test]
fn a_wrong_length_that_repeats_before_its_message_is_sent_is_one_error() {
    let mut rig = rig(&flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]));
    let save = u32::from_le_bytes(*b"save");
    let without_tpdos = [
        message(0x23, 0x1800, 1, 0x8000_0000),
        message(0x23, 0x1801, 1, 0x8000_0000),
        message(0x23, 0x1010, 1, save),
    ];
    write(&mut rig, &without_tpdos);
    // The boot-up, which comes before the error messages, has to wait for these.
    for command in ["82 40", "01 40"] {
        rig.queue(&frames::command(command));
    }
    for len in [0, 1, 0, 1, 2] {
        let frame = Frame::new(0x240, &[1; 2][..len]).expect("a frame");
        rig.queue(&frame);
    }
    let sent = rig.collect(Time::from_ms(20));
    assert_eq!(sent.0.iter().filter(is_short_pdo).count(), 1, "{sent:?}");
    assert_eq!(rig.sdo_client(NODE_ID).number(0x1003, 0), 2, "too short, and too long");
}

#[test]
fn an_error_message_that_is_dropped_is_sent_again() {
    let mut rig = rig(&flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]));
    rig.nmt("01 00");
    rig.transmit(on_the_wire(&Frame::new(0x240, &[]).expect("a frame")));
    rig.network.set_short(Some(Short::Recessive));
    rig.network.run_for(Time::from_ms(5));
    rig.network.set_short(None);
    let sent = rig.collect(Time::from_s(1));
    assert_eq!(sent.0.iter().filter(is_short_pdo).count(), 1, "{sent:?}");
}

#[test]
fn each_restricted_cob_id_is_refused_as_by_the_node_in_the_process() {
    let mut pair = operational();
    for id in [
        0, 0x7F, 0x80, 0x100, 0x101, 0x180, 0x181, 0x580, 0x581, 0x5FF, 0x600, 0x601, 0x67F, 0x680,
        0x6DF, 0x6E0, 0x6FF, 0x700, 0x701, 0x7FF,
    ] {
        for (index, sub_index) in [(0x1403, 1), (0x1803, 1), (0x1005, 0)] {
            pair.ask(message(0x23, index, sub_index, id));
            pair.ask(message(0x40, index, sub_index, 0));
            if sub_index == 1 {
                pair.ask(message(0x23, index, sub_index, id | 0x8000_0000));
            }
        }
    }
}

#[test]
fn each_of_four_tpdos_has_its_event_timer_and_inhibit_time() {
    // In ms: the event timer, the inhibit time, and the period that follows from both.
    for tpdos in [
        [(300, 0, 300), (100, 0, 100), (200, 0, 200), (50, 100, 100)],
        [(0, 0, 0), (0, 100, 0), (0, 0, 0), (50, 0, 50)],
    ] {
        let mut rig = rig(&flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]));
        for (at, (event_ms, inhibit_ms, _)) in (0..).zip(tpdos) {
            let index = 0x1800 + at;
            let requests = [
                message(0x23, index, 1, 0x8000_0000),
                message(0x2F, index + 0x200, 0, 0),
                message(0x23, index + 0x200, 1, OUTPUTS),
                message(0x2F, index + 0x200, 0, 1),
                message(0x2B, index, 3, 10 * inhibit_ms),
                message(0x2B, index, 5, event_ms),
                message(0x23, index, 1, 0x181 + u32::from(at)),
            ];
            write(&mut rig, &requests);
        }
        rig.transmit_command("01 00");
        let sent = rig.collect(Time::from_ms(3_030)).0;
        for (at, (_, _, period_ms)) in (0..).zip(tpdos) {
            let count = sent.iter().filter(|frame| frame.cob_id() == 0x181 + at).count();
            assert_eq!(
                count,
                1 + 3_000_usize.checked_div(period_ms).unwrap_or(0),
                "{period_ms} ms"
            );
        }
    }
}

#[test]
fn a_lost_heartbeat_has_the_effect_that_1029h_demands() {
    for (behaviour, state, after) in
        [(0, "01 00", 0x7F), (0, "80 00", 0x7F), (1, "01 00", 5), (2, "01 00", 4), (2, "80 00", 4)]
    {
        let stored = settings(NODE_ID, BitRate::Kbit1000).with_heartbeat_ms(20);
        let mut rig = rig(&flash_with(&[stored]));
        rig.nmt(state);
        for request in ["23 16 10 01 64 00 0A 00", &format!("2F 29 10 01 {behaviour:02X}")] {
            rig.transmit(on_the_wire(&sdo::request(NODE_ID, request)));
        }
        rig.transmit(on_the_wire(&Frame::new(0x70A, &[5]).expect("a frame")));
        rig.collect(Time::from_ms(150));
        let sent = rig.collect(Time::from_ms(50)).0;
        let last = sent.iter().rfind(|frame| frame.cob_id() == 0x740).expect("a heartbeat");
        assert_eq!(last.data(), [after], "{behaviour} {state}");
    }
}
