//! The release image at moments that are rare: a deadline, a reset, a wrap of the time or a dominant bus in the middle
//! of something else.

use crate::rig::*;

const RATE: BitRate = BitRate::Kbit1000;
const NODE_ID: u8 = 0x40;

#[test]
fn a_listener_finds_the_rate_by_remote_frames_or_29_bit_frames() {
    let stored = settings(NODE_ID, BitRateSetting::Automatic);
    for id in [Id::Standard(0x181), Id::Extended(0x181)] {
        let mut rig = ImageRig::new(RATE, [board_with(0, stored)]);
        rig.collect(Time::from_ms(100));
        let other = rig.network.add_adapter(Adapter::new(bit_per_s(RATE)));
        let frame = Frame { remote: matches!(id, Id::Standard(_)), ..Frame::data(id, &[]) };
        let since = rig.network.now();
        rig.network.send(other, frame);
        rig.network.run_for(Time::from_ms(50));
        let sent: Vec<_> = rig.requested(0, since).map(|(_, frame)| frame.id).collect();
        assert_eq!(sent, [Id::Standard(0x740)], "{frame}");
    }
}

#[test]
fn lss_answers_outlive_a_change_of_the_node_id() {
    for slowdown in [20, 30] {
        let mut rig = slow_node_40(slowdown);
        rig.lss("04 01");
        rig.send("11 41, 5A, 5B, 000: 82 00");
        let sent = rig.collect(Time::from_ms(50)).texts();
        let mut begins: Vec<&str> = sent.iter().map(|text| &text[..7]).collect();
        begins.sort_unstable();
        assert_eq!(begins, ["741: 00", "7E4: 11", "7E4: 5A", "7E4: 5B"], "{slowdown}");
    }
}

#[test]
fn messages_of_frames_lost_in_succession_leave_room_in_the_queue() {
    let mut rig = slow_node_40(200);
    // Each lost frame is an error, but the commands go first.
    for _ in 0..600 {
        rig.send("000: 01 7F");
    }
    rig.collect(Time::from_ms(100));
    assert!(rig.has_logged("CAN: overrun, a received frame was lost"));
    let is_full = rig.has_logged("CAN: the transmit queue is full");
    assert!(!is_full, "{:#?}", log::lines(rig.network.board(0)));
    assert!(answers(&mut rig));
}

#[test]
fn bus_off_may_begin_while_the_indicators_are_set() {
    /// Of the blinking green indicator, whose step ends with the output.
    const RUN: Pin = Pin('D', 12);
    let mut rig = slow_node_40(5);
    let is_lit = |rig: &ImageRig| rig.network.board(0).output(RUN).level == Some(true);
    let mut to_bus_off = Time::ZERO;
    let begin = rig.network.now();
    // The first time only shows how long it takes.
    for before in [None].into_iter().chain((16..48).map(|step| Some(Time::from_ps(500_000 * step))))
    {
        let was_lit = is_lit(&rig);
        while is_lit(&rig) == was_lit {
            rig.network.run_for(Time::from_us(5));
        }
        if let Some(before) = before {
            rig.network.run_for(Time::from_ms(200) - before - to_bus_off);
        }
        let since = rig.network.now();
        rig.queue(&sdo::request(NODE_ID, "40 00 10 00"));
        rig.network.run_for(Time::from_us(140));
        rig.short_circuit(Short::Recessive, Time::from_ms(5));
        let bus_off = rig.did(0, since).find(|event| event.what == What::BusOff);
        to_bus_off = bus_off.expect("it goes bus-off").time - since;
        rig.network.run_for(Time::from_ms(300));
    }
    assert!(rig.bit_rates(0, begin).iter().all(|(_, rate)| *rate == bit_per_s(RATE)));
    rig.ask("04 01, 5E", "5E 40");
}

#[test]
fn a_core_that_is_too_slow_for_the_bus_reports_lost_frames() {
    let mut rig = slow_node_40(150);
    for _ in 0..40 {
        rig.queue(&canopen_node::Frame::new(0x7E5, &[]).expect("a frame"));
    }
    let sent = rig.collect(Time::from_ms(200)).texts();
    assert!(rig.has_logged("CAN: overrun, a received frame was lost"));
    assert!(sent.iter().any(|text| text.starts_with("0C0: 10 81 11")), "{sent:?}");
    assert!(sent.iter().any(|text| text.starts_with("0C0: 00 00 00")), "{sent:?}");
}

#[test]
fn a_request_right_behind_the_loss_of_the_node_id_is_ignored() {
    for (configure, boot_up) in [("11 FF", &SILENCE[..]), ("11 41", &["741: 00"])] {
        let mut rig = slow_node_40(30);
        rig.lss(&format!("04 01, {configure}"));
        rig.send("000: 82 40");
        rig.queue(&sdo::request(0x40, "40 17 10 00"));
        assert_eq!(rig.collect(Time::from_ms(50)).texts(), *boot_up, "{configure}");
    }
}
