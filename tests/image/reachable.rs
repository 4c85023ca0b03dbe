//! A board that is at the right rate stays reachable, whatever the others do.

use emulator::network::Noise;

use crate::rig::*;

/// The length of a frame with eight bytes in bits, and the number of them that a late master may have to wait.
pub const LONG_FRAME_BITS: u64 = 135;
const PATIENCE_FRAMES: u64 = 25;

/// 20 ms or 25 frame times at `bit_rate`, whichever is longer.
pub fn patience(bit_rate: BitRate) -> Time {
    let bits = LONG_FRAME_BITS * PATIENCE_FRAMES;
    Time::from_ms(20).max(Time::from_us(bits * 1000 / u64::from(bit_rate.kbit_per_s())))
}

pub fn pairs() -> impl Iterator<Item = (BitRate, BitRate)> {
    let all = || BitRate::ALL.into_iter();
    all().flat_map(move |from| all().map(move |to| (from, to))).filter(|(from, to)| from != to)
}

pub fn boards(count: u8, heartbeat_ms: u16, bit_rate: BitRate) -> ImageRig {
    let with =
        |number| board_with(number, settings(number, bit_rate).with_heartbeat_ms(heartbeat_ms));
    let mut rig = ImageRig::new(bit_rate, (1..=count).map(with));
    rig.network.record(Recording::Off);
    rig
}

/// Makes the master send `request` once; returns whether the answer `id` comes within `limit`.
pub fn is_answered(
    rig: &mut ImageRig,
    request: &canopen_node::Frame,
    id: u16,
    limit: Time,
) -> bool {
    rig.collect(Time::ZERO);
    rig.queue(request);
    rig.wait_for(limit, |frame| frame.cob_id() == id).is_some()
}

/// Reads the device type of node `id`.
pub fn read(id: u8) -> canopen_node::Frame {
    sdo::request(id, "40 00 10")
}

/// All boards are commanded to switch; the master stays at the old rate.
pub fn activate(rig: &mut ImageRig, to: BitRate, delay_ms: u16) {
    rig.send("04 01");
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

pub fn assert_answers_a_late_master(
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
        let is_answered = is_answered(&mut rig, &read(id), 0x580 + u16::from(id), limit);
        assert!(is_answered, "node {id} does not answer in time: {what}");
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
    let is_answered = is_answered(&mut rig, &frames::request("5E"), 0x7E4, patience(to));
    assert!(is_answered, "no answer in time: {what}");
}

#[test]
fn a_master_that_continues_at_the_old_rate_loses_no_board() {
    for (number, pair) in pairs().enumerate().step_by(every(11)) {
        let id = [1, 5, 16, 32, 64, 100, 127][number % 7];
        let (heartbeat_ms, late_ms) = [(1000, 300), (0, 300), (1000, 3_000)][number % 3];
        assert_waits_for_a_master_that_goes_on(pair, id, heartbeat_ms, late_ms);
    }
    let pair = (BitRate::Kbit125, BitRate::Kbit500);
    let others = [(1000, 29_000), (0, 300), (1000, 3_000), (0, 3_000)];
    for (heartbeat_ms, late_ms) in others.into_iter().step_by(every(2)) {
        assert_waits_for_a_master_that_goes_on(pair, 5, heartbeat_ms, late_ms);
    }
}

/// The time until the master, which only listens, receives a heartbeat of node 1, if within `limit`.
fn heartbeat_time(rig: &mut ImageRig, limit: Time) -> Option<Time> {
    rig.collect(Time::ZERO);
    let from = rig.network.now();
    rig.wait_for(limit, |frame| frame.cob_id() == 0x701).map(|(time, _)| time - from)
}

#[test]
fn a_short_circuit_costs_at_most_100_ms_more_than_it_lasts() {
    for short in [Short::Dominant, Short::Recessive] {
        for bit_rate in [BitRate::Kbit1000, BitRate::Kbit125, BitRate::Kbit20] {
            for span_ms in [200, 1_000, 10_000] {
                let mut rig = boards(1, 100, bit_rate);
                rig.network.run_for(Time::from_ms(300));
                rig.short_circuit(short, Time::from_ms(span_ms));
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
    rig.collect(Time::ZERO);
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
            rig.short_circuit(Short::Dominant, Time::from_ms(short_ms));
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
