//! Supervision on the release image: a right rate is kept at no loss of time, and a lost node is found.

use emulator::{
    Time,
    can::{Adapter, Frame, Id},
    network::{AdapterId, Event, Noise, Recording, Short, What},
};
use lss_slave::BitRate;
use testkit::{
    frames,
    image_rig::{ImageRig, bit_per_s, board_with, on_the_wire, settings},
};

/// The silent bit of CAN_BTR (RM0090, 32.9.2).
const SILM: u32 = 1 << 31;
/// The length of a frame with eight bytes in bits, and the number of them that a late master may have to wait.
const LONG_FRAME_BITS: u64 = 135;
const PATIENCE_FRAMES: u64 = 25;

/// 20 ms or 25 frame times at `bit_rate`, whichever is longer.
fn patience(bit_rate: BitRate) -> Time {
    let bits = LONG_FRAME_BITS * PATIENCE_FRAMES;
    Time::from_ms(20).max(Time::from_us(bits * 1000 / u64::from(bit_rate.kbit_per_s())))
}

fn pairs() -> impl Iterator<Item = (BitRate, BitRate)> {
    let all = || BitRate::ALL.into_iter();
    all().flat_map(move |from| all().map(move |to| (from, to))).filter(|(from, to)| from != to)
}

fn boards(count: u8, heartbeat_ms: u16, bit_rate: BitRate) -> ImageRig {
    let with =
        |number| board_with(number, settings(number, bit_rate).with_heartbeat_ms(heartbeat_ms));
    let mut rig = ImageRig::new(bit_rate, (1..=count).map(with));
    rig.network.record(Recording::Off);
    rig
}

/// Makes the master send `request` once; returns the time from its start to the answer `id`, if it comes within
/// `limit`.
fn answer_time(rig: &mut ImageRig, request: Frame, id: u16, limit: Time) -> Option<Time> {
    while rig.network.receive(rig.master).is_some() {}
    let from = rig.network.now();
    rig.network.send(rig.master, request);
    while rig.network.now() < from + limit {
        let left = (from + limit).saturating_sub(rig.network.now());
        let (time, frame) = rig.network.run_until_received(rig.master, left)?;
        if frame.id == Id::Standard(id) {
            return Some(time - from);
        }
    }
    None
}

/// Makes the master send `request` every 20 ms until the answer `id` comes; returns the time taken.
fn reach(rig: &mut ImageRig, request: Frame, id: u16, limit: Time) -> Option<Time> {
    let from = rig.network.now();
    while rig.network.now() < from + limit {
        if rig.network.adapter_mut(rig.master).unsent() == 0 {
            rig.network.send(rig.master, request);
        }
        if rig
            .network
            .run_until_received(rig.master, Time::from_ms(20))
            .is_some_and(|(_, frame)| frame.id == Id::Standard(id))
        {
            return Some(rig.network.now() - from);
        }
    }
    None
}

fn inquire_node_id() -> Frame {
    on_the_wire(&frames::request("5E"))
}

/// Reads the device type of node `id`.
fn read(id: u8) -> Frame {
    Frame::data(Id::Standard(0x600 + u16::from(id)), &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0])
}

/// All boards are commanded to switch; the master stays at the old rate.
fn activate(rig: &mut ImageRig, to: BitRate, delay_ms: u16) {
    rig.queue(&frames::request("04 01"));
    let configure = frames::request(&format!("13 00 {:02X}", to.index()));
    rig.queue(&configure);
    rig.network.run_for(Time::from_ms(50));
    let [low, high] = delay_ms.to_le_bytes();
    let activate = frames::request(&format!("15 {low:02X} {high:02X}"));
    rig.queue(&activate);
    // A heartbeat at the new rate may destroy the end of the frame for the master, which then repeats it.
    let frame = rig.bit_time() * LONG_FRAME_BITS;
    rig.network.run_for(frame);
}

fn assert_answers_a_late_master(
    (from, to): (BitRate, BitRate),
    count: u8,
    heartbeat_ms: u16,
    delay_ms: u16,
    late: Time,
) {
    let mut rig = boards(count, heartbeat_ms, from);
    activate(&mut rig, to, delay_ms);
    rig.network.run_for(Time::from_ms(2 * u64::from(delay_ms)) + late);
    rig.set_master_bit_rate(to);
    let what = format!("{from:?} to {to:?}, {count} boards, heartbeat {heartbeat_ms} ms, {late}");
    let limit = patience(to);
    for id in 1..=count {
        let time = answer_time(&mut rig, read(id), 0x580 + u16::from(id), limit);
        assert!(time.is_some(), "node {id} does not answer in time: {what}");
    }
}

#[test]
fn a_late_masters_first_request_is_answered_at_every_pair_of_rates() {
    for (number, pair) in pairs().enumerate() {
        for late_ms in [20, 200, 2000] {
            let heartbeat_ms = [1000, 0][number % 2];
            assert_answers_a_late_master(pair, 1, heartbeat_ms, 50, Time::from_ms(late_ms));
        }
    }
}

#[test]
fn a_master_that_follows_a_switch_without_delay_50_ms_late_is_answered() {
    for pair in pairs() {
        assert_answers_a_late_master(pair, 1, 1000, 0, Time::from_ms(50));
    }
}

#[test]
fn several_boards_answer_a_master_that_is_up_to_30_s_late() {
    let pair = (BitRate::Kbit125, BitRate::Kbit500);
    for (count, late_ms) in [(2, 300), (4, 29_900), (8, 5_000)] {
        assert_answers_a_late_master(pair, count, 1000, 100, Time::from_ms(late_ms));
    }
}

/// The master continues at the old rate, with a SYNC every 100 ms, and follows `late_ms` after the switch.
fn assert_waits_for_a_master_that_goes_on(
    (from, to): (BitRate, BitRate),
    id: u8,
    heartbeat_ms: u16,
    late_ms: u64,
) {
    let board = board_with(id, settings(id, from).with_heartbeat_ms(heartbeat_ms));
    let mut rig = ImageRig::new(from, [board]);
    rig.network.record(Recording::Off);
    activate(&mut rig, to, 100);
    let until = rig.network.now() + Time::from_ms(200 + late_ms);
    while rig.network.now() < until {
        rig.network.send(rig.master, Frame::data(Id::Standard(0x080), &[]));
        rig.network.run_for(Time::from_ms(100));
    }
    rig.set_master_bit_rate(to);
    let what =
        format!("{from:?} to {to:?}, node {id}, heartbeat {heartbeat_ms} ms, {late_ms} ms late");
    let time = answer_time(&mut rig, inquire_node_id(), 0x7E4, patience(to));
    assert!(time.is_some(), "no answer in time: {what}");
}

#[test]
fn a_master_that_continues_at_the_old_rate_loses_no_board() {
    for (number, pair) in pairs().enumerate() {
        let id = [1, 5, 16, 32, 64, 100, 127][number % 7];
        let (heartbeat_ms, late_ms) = [(1000, 300), (0, 300), (1000, 3_000)][number % 3];
        assert_waits_for_a_master_that_goes_on(pair, id, heartbeat_ms, late_ms);
    }
    let pair = (BitRate::Kbit125, BitRate::Kbit500);
    for (heartbeat_ms, late_ms) in [(0, 300), (0, 3_000), (1000, 3_000), (1000, 29_000)] {
        assert_waits_for_a_master_that_goes_on(pair, 5, heartbeat_ms, late_ms);
    }
}

/// A laptop at another rate, which repeats a frame or sends one from time to time.
fn plug_in_laptop(rig: &mut ImageRig, bit_rate: BitRate) -> AdapterId {
    rig.network.add_adapter(Adapter::new(bit_per_s(bit_rate)))
}

#[test]
fn a_laptop_at_a_wrong_rate_at_power_on_leaves_the_stored_rate() {
    for (number, (home, wrong)) in pairs().enumerate() {
        let heartbeat_ms = [1000, 0][number % 2];
        let mut rig = boards(1, heartbeat_ms, home);
        rig.network.adapter_mut(rig.master).close();
        rig.network.power_off(0);
        let laptop = plug_in_laptop(&mut rig, wrong);
        rig.network.run_for(Time::from_ms(10));
        rig.network.power_on(0);
        rig.expect_reset(0, emulator::chip::ResetCause::PowerOn);
        for _ in 0..30 {
            rig.network.send(laptop, Frame::data(Id::Standard(0x123), &[0x55; 8]));
            rig.network.run_for(Time::from_ms(100));
        }
        rig.network.adapter_mut(laptop).close();
        rig.network.adapter_mut(rig.master).open();
        let time = reach(&mut rig, read(1), 0x581, Time::from_s(2));
        let limit = Time::from_ms(100) + patience(home);
        assert!(time.is_some_and(|time| time <= limit), "{home:?}, laptop {wrong:?}: {time:?}");
    }
}

/// A board alone with a master at another rate than the stored one, from power-on.
fn alone(heartbeat_ms: u16, stored: BitRate, master: BitRate) -> ImageRig {
    let settings = settings(1, stored).with_heartbeat_ms(heartbeat_ms);
    let mut rig = ImageRig::new(master, [board_with(1, settings)]);
    rig.network.record(Recording::Off);
    rig
}

#[test]
fn a_wrong_stored_rate_is_found_by_a_polling_master_within_1500_ms() {
    for (number, (stored, found)) in pairs().enumerate() {
        let heartbeat_ms = [1000, 0, 100][number % 3];
        let mut rig = alone(heartbeat_ms, stored, found);
        let time = reach(&mut rig, read(1), 0x581, Time::from_s(10));
        let what = format!("{stored:?} stored, {found:?}, heartbeat {heartbeat_ms} ms: {time:?}");
        println!("{what}");
        assert!(time.is_some_and(|time| time <= Time::from_ms(1500)), "{what}");
    }
}

#[test]
fn a_board_that_missed_a_switch_is_found_after_its_power_was_switched() {
    let mut rig = boards(1, 1000, BitRate::Kbit125);
    assert!(reach(&mut rig, read(1), 0x581, Time::from_ms(200)).is_some(), "proven");
    rig.set_master_bit_rate(BitRate::Kbit500);
    assert_eq!(reach(&mut rig, read(1), 0x581, Time::from_s(10)), None, "it stays");
    assert_eq!(rig.network.board(0).chip().can(1).bit_rate(), 125_000);
    rig.network.power_off(0);
    rig.network.run_for(Time::from_ms(10));
    rig.network.power_on(0);
    rig.expect_reset(0, emulator::chip::ResetCause::PowerOn);
    assert!(reach(&mut rig, read(1), 0x581, Time::from_ms(1500)).is_some());
}

/// A board whose stored rate no other node uses, found by a polling master at another one.
fn rescued(home: BitRate, found: BitRate) -> ImageRig {
    let mut rig = alone(0, home, found);
    assert!(reach(&mut rig, read(1), 0x581, Time::from_ms(1500)).is_some());
    rig
}

#[test]
fn activation_without_configuration_after_a_rescue_keeps_the_rate_in_use() {
    let mut rig = rescued(BitRate::Kbit500, BitRate::Kbit125);
    for request in ["04 01", "15 0A 00"] {
        rig.queue(&frames::request(request));
        rig.network.run_for(Time::from_ms(100));
    }
    let time = answer_time(&mut rig, inquire_node_id(), 0x7E4, patience(BitRate::Kbit125));
    assert!(time.is_some());
}

#[test]
fn a_guest_stores_its_stored_rate_unless_13_or_15_has_set_another() {
    let found = BitRate::Kbit125;
    for (requests, stored) in [
        (&["04 01", "11 07", "17"][..], BitRate::Kbit500),
        (&["04 01", "11 07", "15 00 00", "17"], found),
    ] {
        let mut rig = rescued(BitRate::Kbit500, found);
        for request in requests {
            rig.queue(&frames::request(request));
            rig.network.run_for(Time::from_ms(50));
        }
        rig.network.power_off(0);
        rig.set_master_bit_rate(stored);
        rig.network.power_on(0);
        rig.expect_reset(0, emulator::chip::ResetCause::PowerOn);
        rig.network.run_for(Time::from_ms(50));
        let time = answer_time(&mut rig, read(7), 0x587, patience(stored));
        assert!(time.is_some(), "{requests:?}");
    }
}

/// The time until the master, which only listens, receives a heartbeat of node 1, if within `limit`.
fn heartbeat_time(rig: &mut ImageRig, limit: Time) -> Option<Time> {
    while rig.network.receive(rig.master).is_some() {}
    let from = rig.network.now();
    while rig.network.now() < from + limit {
        let left = (from + limit).saturating_sub(rig.network.now());
        let (time, frame) = rig.network.run_until_received(rig.master, left)?;
        if frame.id == Id::Standard(0x701) {
            return Some(time - from);
        }
    }
    None
}

#[test]
fn a_short_circuit_costs_at_most_100_ms_more_than_it_lasts() {
    for short in [Short::Dominant, Short::Recessive] {
        for bit_rate in [BitRate::Kbit1000, BitRate::Kbit125, BitRate::Kbit20] {
            for span_ms in [200, 1_000, 10_000] {
                let mut rig = boards(1, 100, bit_rate);
                rig.network.run_for(Time::from_ms(300));
                rig.network.set_short(Some(short));
                rig.network.run_for(Time::from_ms(span_ms));
                rig.network.set_short(None);
                let time = heartbeat_time(&mut rig, Time::from_s(2));
                // A plain slave needs the time of a recovery, 1408 bits.
                let plain = rig.bit_time() * 1408 + rig.bit_time() * LONG_FRAME_BITS;
                let limit = Time::from_ms(150) + plain;
                let what = format!("{short:?} for {span_ms} ms at {bit_rate:?}: {time:?}");
                assert!(time.is_some_and(|time| time <= limit), "{what}");
            }
        }
    }
}

/// A board with a heartbeat every 100 ms, which has been acknowledged.
fn proven_board() -> ImageRig {
    let mut rig = boards(1, 100, BitRate::Kbit125);
    rig.network.run_for(Time::from_ms(1_500));
    while rig.network.receive(rig.master).is_some() {}
    rig
}

/// The times without a heartbeat while `disturb` is repeated for 20 s. Heartbeats of a plain slave are up to 155 ms
/// apart.
fn gaps(mut rig: ImageRig, disturb: impl Fn(&mut ImageRig)) -> Vec<Time> {
    let mut heard = rig.network.now();
    let end = heard + Time::from_s(20);
    let mut gaps = Vec::new();
    while rig.network.now() < end {
        disturb(&mut rig);
        while let Some((time, frame)) = rig.network.receive(rig.master) {
            if frame.id == Id::Standard(0x701) {
                gaps.push(time - heard);
                heard = time;
            }
        }
    }
    gaps.push(rig.network.now() - heard);
    gaps.retain(|&gap| gap > Time::from_ms(200));
    gaps
}

#[test]
fn a_flapping_short_circuit_does_not_silence_a_proven_board() {
    for (short_ms, free_ms) in [(20, 40), (20, 200), (40, 40)] {
        let gaps = gaps(proven_board(), |rig| {
            rig.network.set_short(Some(Short::Dominant));
            rig.network.run_for(Time::from_ms(short_ms));
            rig.network.set_short(None);
            rig.network.run_for(Time::from_ms(free_ms));
        });
        assert!(gaps.is_empty(), "{short_ms} ms every {} ms: {gaps:?}", short_ms + free_ms);
    }
}

#[test]
fn lasting_noise_does_not_silence_a_proven_board() {
    for ms in [5, 20, 100] {
        let mut rig = proven_board();
        let (mean_interval, length) = (Time::from_ms(ms), Time::from_us(10));
        rig.network.set_noise(Some(Noise { seed: 3, mean_interval, length }));
        let gaps = gaps(rig, |rig| rig.network.run_for(Time::from_ms(100)));
        assert!(gaps.is_empty(), "a pulse every {ms} ms: {gaps:?}");
    }
}

/// Two other nodes at `bit_rate`, which send once a second or without pause.
fn others(rig: &mut ImageRig, bit_rate: BitRate) -> [AdapterId; 2] {
    [(); 2].map(|()| rig.network.add_adapter(Adapter::new(bit_per_s(bit_rate))))
}

/// The time from joining the bus until a board at a wrong stored rate takes part at `found`, with a frame every
/// `period`.
fn time_until_found(
    node_id: u8,
    (stored, found): (BitRate, BitRate),
    period: Time,
    limit: Time,
) -> Option<Time> {
    let mut rig = ImageRig::new(found, [board_with(0, settings(node_id, stored))]);
    rig.network.power_off(0);
    rig.network.adapter_mut(rig.master).close();
    let others = others(&mut rig, found);
    rig.network.run_for(Time::from_ms(10));
    rig.network.power_on(0);
    rig.expect_reset(0, emulator::chip::ResetCause::PowerOn);
    let on = rig.network.now();
    rig.network.run_for(period);
    let mut count = 0_u64;
    while rig.network.now() < on + limit {
        if rig.network.adapter_mut(others[0]).unsent() == 0 {
            let heartbeat = Frame::data(Id::Standard(0x705), &[0x05]);
            let long = Frame::data(
                Id::Standard(0x185),
                &count.wrapping_mul(0x9E37_79B9_7F4A_7C15).to_le_bytes(),
            );
            rig.network.send(others[0], if period < Time::from_ms(100) { long } else { heartbeat });
            count += 1;
        }
        rig.network.run_for(period);
        let frame = rig.bit_time() * LONG_FRAME_BITS;
        rig.network.run_for(frame);
        let takes_part = |event: &Event| match event.what {
            What::BitTiming { btr, bit_rate } => btr & SILM == 0 && bit_rate == bit_per_s(found),
            _ => false,
        };
        if let Some(event) = rig.did(0, on).find(|event| takes_part(event)) {
            let came = rig.did(0, on).find(|event| matches!(event.what, What::BitTiming { .. }));
            return came.map(|came| event.time - came.time);
        }
    }
    None
}

/// Whether a node at `stored` may miss a heartbeat at `found`: it is over before a bit is sampled twice.
fn may_not_notice((stored, found): (BitRate, BitRate)) -> bool {
    stored.kbit_per_s() < 50 && found.kbit_per_s() > 125
}

#[test]
fn a_wrong_stored_rate_is_found_within_5_s_by_one_heartbeat_a_second() {
    for node_id in [1, 0xFF] {
        for pair in pairs().filter(|&pair| !may_not_notice(pair)) {
            let time = time_until_found(node_id, pair, Time::from_ms(1000), Time::from_s(8));
            let what = format!("node {node_id:02X}: stored, found {pair:?}: {time:?}");
            println!("{what}");
            assert!(time.is_some_and(|time| time <= Time::from_s(5)), "{what}");
        }
    }
}

#[test]
fn a_wrong_stored_rate_is_found_in_250_ms_under_load() {
    for (stored, found) in pairs() {
        // A bus load of 90 %.
        let period = Time::from_us(13_500 / u64::from(found.kbit_per_s()));
        let time = time_until_found(0xFF, (stored, found), period, Time::from_s(2));
        let what = format!("{stored:?} stored, {found:?} found: {time:?}");
        println!("{what}");
        assert!(time.is_some_and(|time| time < Time::from_ms(250)), "{what}");
    }
}
