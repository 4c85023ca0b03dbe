//! Activate bit timing (CiA 305) with the release image: the times at which boards fall silent, switch and send again.

use crate::rig::*;

/// The time in which a board handles a request.
const PROCESSING: Time = Time::from_us(100);
/// The accuracy of the switch delay.
const ACCURACY: Time = Time::from_us(20);

/// Nodes 1 and 2 at `bit_rate`, in configuration state.
fn two_boards(bit_rate: BitRate, heartbeat_ms: u16) -> ImageRig {
    let boards = [1, 2].map(|number| {
        board_with(number, settings(number, bit_rate).with_heartbeat_ms(heartbeat_ms))
    });
    let mut rig = ImageRig::new(bit_rate, boards);
    rig.transmit_request("04 01");
    rig
}

fn configure(rig: &mut ImageRig, to: BitRate) {
    rig.transmit_request(&format!("13 00 {:02X}", to.index()));
    rig.network.run_for(Time::from_ms(2) + rig.bit_time() * 160);
}

/// Runs the bus until the boards switch, and switches the master with them.
fn switch_master(rig: &mut ImageRig, at: Time, to: BitRate) {
    rig.network.run_until(at);
    rig.set_master_bit_rate(to);
}

/// The time at which the request that ends at `t0` is valid for the boards, which sample its last bit but one at 85 %:
/// they count from there.
fn valid(rig: &ImageRig, t0: Time) -> Time {
    let rate = rig.network.trace().iter().find_map(|event| match event.what {
        What::Frame { bit_rate, .. } if event.time == t0 => Some(bit_rate),
        _ => None,
    });
    let bit_ps = 1_000_000_000_000 / u64::from(rate.expect("the request"));
    t0.saturating_sub(Time::from_ps(bit_ps * 115 / 100))
}

/// Checks the silence after the request that ends at `t0`, and the switch of all boards.
pub fn assert_switched(rig: &ImageRig, t0: Time, delay: Time, to: BitRate) {
    let valid = valid(rig, t0);
    let broken = rig.sent_by_boards(t0 + PROCESSING).find(|sent| sent.start < valid + delay * 2);
    assert!(broken.is_none(), "{broken:#?}");
    for board in 0..rig.network.boards().len() {
        let rates = rig.bit_rates(board, t0);
        let [(time, bit_rate)] = rates.as_slice() else { panic!("one switch, not {rates:?}") };
        assert_eq!(*bit_rate, bit_per_s(to));
        assert!(*time >= valid + delay, "{time} is {} early", valid + delay - *time);
        let late = *time - (valid + delay);
        assert!(late < ACCURACY, "{time} is {late} late");
    }
}

/// Both boards are in configuration state and at the master's bit rate.
fn assert_both_answer(rig: &mut ImageRig) {
    let request = rig.transmit_request("11 80");
    rig.collect(Time::from_ms(1) + rig.bit_time() * 160);
    let refusal = on_the_wire(&frames::request("11 01")).data;
    for board in [0, 1] {
        let answers = rig.did(board, request).chain(rig.did(1 - board, request)).any(|event| {
            match &event.what {
                What::Frame { frame, also, .. } => {
                    let senders = [&[event.source], also.as_slice()].concat();
                    frame.data == refusal && senders.contains(&Source::Board(board))
                }
                _ => false,
            }
        });
        assert!(answers, "board {board} does not answer");
    }
}

#[test]
fn boards_are_silent_at_once_switch_after_one_delay_and_send_after_two() {
    let mut rig = two_boards(BitRate::Kbit125, 10);
    configure(&mut rig, BitRate::Kbit500);
    let t0 = rig.activate(50);
    let delay = Time::from_ms(50);
    switch_master(&mut rig, t0 + delay, BitRate::Kbit500);
    rig.network.run_until(t0 + delay * 4);
    assert_switched(&rig, t0, delay, BitRate::Kbit500);
    let end = valid(&rig, t0) + delay * 2;
    for board in [0, 1] {
        let times: Vec<_> = rig.requested(board, t0 + PROCESSING).map(|(time, _)| time).collect();
        assert!(end <= times[0] && times[0] < end + ACCURACY, "a heartbeat at once: {}", times[0]);
        assert!(times.windows(2).all(|pair| pair[1] - pair[0] > Time::from_ms(8)), "no burst");
    }
}

#[test]
fn without_a_delay_boards_switch_and_send_at_once() {
    let mut rig = two_boards(BitRate::Kbit1000, 20);
    for to in [BitRate::Kbit250, BitRate::Kbit1000, BitRate::Kbit500] {
        configure(&mut rig, to);
        let t0 = rig.activate(0);
        rig.set_master_bit_rate(to);
        rig.network.run_for(Time::from_ms(3));
        assert_switched(&rig, t0, Time::ZERO, to);
        for board in [0, 1] {
            let (time, heartbeat) = rig.requested(board, t0).next().expect("a heartbeat");
            // After a switch, which takes time too.
            let late = time - t0;
            assert!(
                late < ACCURACY * 2 && heartbeat.payload() == [0x7F],
                "{heartbeat}, {late} late"
            );
        }
        assert_both_answer(&mut rig);
    }
}

#[test]
fn the_longest_delay_is_kept_to_20_us_and_the_watchdog_is_quiet() {
    let mut rig = two_boards(BitRate::Kbit1000, 100);
    configure(&mut rig, BitRate::Kbit20);
    let t0 = rig.activate(0xFFFF);
    let delay = Time::from_ms(0xFFFF);
    switch_master(&mut rig, t0 + delay, BitRate::Kbit20);
    rig.network.run_until(t0 + delay * 2 + Time::from_ms(20));
    assert_switched(&rig, t0, delay, BitRate::Kbit20);
    for board in [0, 1] {
        let (time, _) = rig.requested(board, t0 + PROCESSING).next().expect("a heartbeat");
        assert!(time < t0 + delay * 2 + ACCURACY, "{time}");
    }
}

#[test]
fn requests_within_the_silence_are_never_answered_and_change_nothing() {
    let mut rig = two_boards(BitRate::Kbit250, 0);
    configure(&mut rig, BitRate::Kbit1000);
    rig.collect(Time::ZERO);
    let t0 = rig.activate(30);
    let delay = Time::from_ms(30);
    let ignored = ["11 05", "5A", "17", "13 00 02", "04 00", "15 00 00"];
    ignored.iter().for_each(|request| _ = rig.transmit_request(request));
    switch_master(&mut rig, t0 + delay, BitRate::Kbit1000);
    rig.network.run_for(ACCURACY);
    ignored.iter().for_each(|request| _ = rig.transmit_request(request));
    assert!(rig.network.now() < t0 + delay * 2);
    rig.network.run_until(t0 + delay * 4);
    assert_switched(&rig, t0, delay, BitRate::Kbit1000);
    assert_eq!(rig.collect(Time::ZERO), SILENCE);
    assert_both_answer(&mut rig);
    rig.network.power_off(1);
    assert_eq!(rig.lss("5E, 04 00"), ["5E 01"]);
    assert_eq!(rig.nmt("82 00"), ["701: 00"], "11 05 was ignored");
}

#[test]
fn a_frame_that_waits_for_the_bus_when_the_silence_begins_is_never_sent() {
    // In bits: a heartbeat is due every 100 and takes less than 60, the request takes more than 100.
    let rate = BitRate::Kbit10;
    let mut rig = rig_with(settings(1, rate).with_heartbeat_ms(10));
    let other = rig.network.add_adapter(Adapter::new(bit_per_s(rate)));
    rig.transmit_request("04 01");
    configure(&mut rig, BitRate::Kbit1000);
    rig.collect(Time::from_ms(200));
    rig.next_frame();
    let bits = |bits| Time::from_us(100) * bits;
    rig.network.run_for(bits(5));
    let request = on_the_wire(&frames::request("15 32 00"));
    rig.network.send(rig.master, request);
    rig.network.run_for(bits(50));
    let urgent = Frame::data(Id::Standard(0x001), &[0x55; 8]);
    (0..3).for_each(|_| rig.network.send(other, urgent));
    rig.network.run_for(bits(100));
    let t0 = rig.sent(Time::ZERO).find(|sent| sent.frame == request).expect("the request").end;

    let delay = Time::from_ms(50);
    switch_master(&mut rig, t0 + delay, BitRate::Kbit1000);
    rig.network.adapter_mut(other).set_bit_rate(1_000_000);
    rig.network.run_until(t0 + delay * 3 + Time::from_ms(5));
    assert_switched(&rig, t0, delay, BitRate::Kbit1000);
    assert!(!rig.sent_by_boards(t0).any(|sent| sent.start < t0 + delay));
    let (requested, heartbeat) =
        rig.requested(0, Time::ZERO).filter(|(time, _)| *time < t0).last().expect("a heartbeat");
    assert!(requested > t0 - bits(100), "it waited");
    let aborted = rig.did(0, requested).find_map(|event| match event.what {
        What::Aborted { frame, .. } => Some((event.time, frame)),
        _ => None,
    });
    assert!(aborted.is_some_and(|(time, frame)| time < t0 + PROCESSING && frame == heartbeat));
    let sent_later = rig.sent_by_boards(t0).count();
    assert_eq!(sent_later, rig.requested(0, t0).count(), "only frames requested later");
}

#[test]
fn an_answer_not_sent_before_the_request_for_silence_is_dropped() {
    let mut rig = two_boards(BitRate::Kbit1000, 0);
    configure(&mut rig, BitRate::Kbit250);
    let from = rig.network.now();
    for request in ["5A", "5B", "5C", "15 14 00"] {
        let request = on_the_wire(&frames::request(request));
        rig.network.send(rig.master, request);
    }
    rig.network.run_for(Time::from_ms(5));
    let of_master = |sent: &Sent| sent.by == Source::Adapter(rig.master);
    let t0 = rig.sent(from).filter(of_master).last().expect("the requests").end;
    let delay = Time::from_ms(20);
    switch_master(&mut rig, t0 + delay, BitRate::Kbit250);
    rig.network.run_until(t0 + delay * 4);
    assert!(rig.sent_by_boards(from).filter(|sent| sent.start < t0).count() >= 2);
    assert_eq!(rig.sent_by_boards(t0 + PROCESSING).count(), 0);
}

/// The watchdog, which resets a board after 2 s in which a task hangs, checks too: the rig expects no reset.
#[test]
fn a_board_without_an_idle_bus_at_the_new_rate_joins_when_there_is_one() {
    let mut rig = rig_with(settings(1, BitRate::Kbit500));
    let other = rig.network.add_adapter(Adapter::new(500_000));
    rig.transmit_request("04 01");
    configure(&mut rig, BitRate::Kbit10);
    let t0 = rig.activate(10);
    let delay = Time::from_ms(10);
    while rig.network.now() < t0 + Time::from_ms(2_500) {
        while rig.network.adapter_mut(other).unsent() < 8 {
            rig.network.send(other, Frame::data(Id::Standard(0x001), &[0; 8]));
        }
        rig.network.run_for(Time::from_ms(1));
    }
    assert_switched(&rig, t0, delay, BitRate::Kbit10);
    let has_joined =
        |rig: &ImageRig| rig.did(0, t0 + delay).any(|event| event.what == What::InitializationLeft);
    assert!(!has_joined(&rig), "eleven recessive bits never came");
    rig.network.adapter_mut(other).close();
    rig.set_master_bit_rate(BitRate::Kbit10);
    rig.collect(Time::from_ms(5));
    assert!(has_joined(&rig));
    assert_eq!(rig.lss("5E"), ["5E 01"]);
}
