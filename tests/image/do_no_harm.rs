//! Supervision on the release image: a right rate is kept at no loss of time, and a lost node is found.

use crate::{
    rates_detection::{Traffic, switch_on, takes_part},
    rig::*,
};

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

/// A board with node-ID 1, and the master at `master`.
fn board(heartbeat_ms: u16, stored: BitRate, master: BitRate) -> ImageRig {
    let settings = settings(1, stored).with_heartbeat_ms(heartbeat_ms);
    let mut rig = ImageRig::new(master, [board_with(1, settings)]);
    rig.network.record(Recording::Off);
    rig
}

/// Reads the device type of node `id`.
fn read(id: u8) -> canopen_node::Frame {
    sdo::request(id, "40 00 10")
}

/// Makes the master read the device type of node `id` once; returns whether the answer comes in time.
fn is_answered(rig: &mut ImageRig, id: u8, rate: BitRate) -> bool {
    rig.collect(Time::ZERO);
    rig.queue(&read(id));
    rig.wait_for(patience(rate), |frame| frame.cob_id() == 0x580 + u16::from(id)).is_some()
}

/// The board is commanded to switch; the master stays at the old rate, and follows late.
fn assert_answers_a_late_master(
    (from, to): (BitRate, BitRate),
    heartbeat_ms: u16,
    delay_ms: u16,
    late_ms: u64,
) {
    let mut rig = board(heartbeat_ms, from, from);
    rig.send("04 01");
    rig.queue(&frames::request(&format!("13 00 {:02X}", to.index())));
    rig.network.run_for(Time::from_ms(50));
    let [low, high] = delay_ms.to_le_bytes();
    rig.queue(&frames::request(&format!("15 {low:02X} {high:02X}")));
    // A heartbeat at the new rate may destroy the end of the frame for the master, which then repeats it.
    let frame = rig.bit_time() * LONG_FRAME_BITS;
    rig.network.run_for(frame + Time::from_ms(2 * u64::from(delay_ms) + late_ms));
    rig.set_master_bit_rate(to);
    let what = format!("{from:?} to {to:?}, heartbeat {heartbeat_ms} ms, {late_ms} ms late");
    assert!(is_answered(&mut rig, 1, to), "no answer in time: {what}");
}

fn assert_within(limit: Time, time: Option<Time>, what: &str) {
    println!("{what}: {time:?}");
    assert!(time.is_some_and(|time| time < limit), "{what}: {time:?}");
}

/// Makes the master read the device type of node 1 every 20 ms until it answers; returns the time taken.
fn reach(rig: &mut ImageRig, limit: Time) -> Option<Time> {
    rig.poll_until(&read(1), limit, |frame| frame.cob_id() == 0x581)
}

#[test]
fn a_late_masters_first_request_is_answered_at_every_pair_of_rates() {
    for (number, pair) in pairs().enumerate().step_by(every(5)) {
        for late_ms in [20, 200, 2000] {
            let heartbeat_ms = [1000, 0][number % 2];
            assert_answers_a_late_master(pair, heartbeat_ms, 50, late_ms);
        }
    }
}

#[test]
fn a_master_that_follows_without_delay_50_ms_late_or_30_s_late_is_answered() {
    for pair in pairs().step_by(every(5)) {
        assert_answers_a_late_master(pair, 1000, 0, 50);
    }
    assert_answers_a_late_master((BitRate::Kbit125, BitRate::Kbit500), 1000, 100, 29_900);
}

#[test]
fn a_laptop_at_a_wrong_rate_at_power_on_leaves_the_stored_rate() {
    for (number, (home, wrong)) in pairs().enumerate().step_by(every(5)) {
        let heartbeat_ms = [1000, 0][number % 2];
        let mut rig = board(heartbeat_ms, home, home);
        rig.network.adapter_mut(rig.master).close();
        rig.network.power_off(0);
        let laptop = rig.network.add_adapter(Adapter::new(bit_per_s(wrong)));
        rig.network.run_for(Time::from_ms(10));
        rig.network.power_on(0);
        for _ in 0..30 {
            rig.network.send(laptop, Frame::data(Id::Standard(0x123), &[0x55; 8]));
            rig.network.run_for(Time::from_ms(100));
        }
        rig.network.adapter_mut(laptop).close();
        rig.network.adapter_mut(rig.master).open();
        let time = reach(&mut rig, Time::from_s(2));
        let limit = Time::from_ms(100) + patience(home);
        assert_within(limit, time, &format!("{home:?}, laptop {wrong:?}"));
    }
}

#[test]
fn a_wrong_stored_rate_is_found_by_a_polling_master_within_1500_ms() {
    for (number, (stored, found)) in pairs().enumerate().step_by(every(5)) {
        let heartbeat_ms = [1000, 0, 100][number % 3];
        let mut rig = board(heartbeat_ms, stored, found);
        let time = reach(&mut rig, Time::from_s(10));
        let what = format!("{stored:?} stored, {found:?}, heartbeat {heartbeat_ms} ms");
        assert_within(Time::from_ms(1500), time, &what);
    }
}

#[test]
fn a_board_without_a_node_id_is_found_at_any_rate_within_1500_ms() {
    for (stored, found) in pairs().step_by(every(5)) {
        let board = match stored {
            DEFAULT_BIT_RATE => blank_board(0),
            _ => board_with(0, settings(0xFF, stored)),
        };
        let mut rig = ImageRig::new(found, [board]);
        rig.network.record(Recording::Off);
        let is_answer = |frame: &canopen_node::Frame| frame.cob_id() == 0x7E4;
        let time = rig.poll_until(&frames::request("4C"), Time::from_s(10), is_answer);
        assert_within(Time::from_ms(1500), time, &format!("{stored:?} stored, {found:?}"));
    }
}

#[test]
fn a_board_that_missed_a_switch_is_found_after_its_power_was_switched() {
    let mut rig = board(1000, BitRate::Kbit125, BitRate::Kbit125);
    assert!(reach(&mut rig, Time::from_ms(200)).is_some(), "proven");
    rig.set_master_bit_rate(BitRate::Kbit500);
    assert_eq!(reach(&mut rig, Time::from_s(10)), None, "it stays");
    assert_eq!(rig.network.board(0).chip().can(1).bit_rate(), 125_000);
    rig.network.power_off(0);
    rig.network.run_for(Time::from_ms(10));
    rig.network.power_on(0);
    assert!(reach(&mut rig, Time::from_ms(1500)).is_some());
}

#[test]
fn a_guest_stores_its_stored_rate_unless_13_or_15_has_set_another() {
    let found = BitRate::Kbit125;
    for (requests, stored) in [
        (&["04 01", "11 07", "17"][..], BitRate::Kbit500),
        (&["04 01", "11 07", "15 00 00", "17"], found),
    ] {
        let mut rig = board(0, BitRate::Kbit500, found);
        assert!(reach(&mut rig, Time::from_ms(1500)).is_some());
        for request in requests {
            rig.queue(&frames::request(request));
            rig.network.run_for(Time::from_ms(50));
        }
        rig.network.power_off(0);
        rig.set_master_bit_rate(stored);
        rig.network.power_on(0);
        rig.network.run_for(Time::from_ms(50));
        let rate = rig.network.board(0).chip().can(1).bit_rate();
        assert_eq!(rate, bit_per_s(stored), "{requests:?}");
        assert!(is_answered(&mut rig, 7, stored), "{requests:?}");
    }
}

/// The time from joining the bus until a board at a wrong stored rate takes part at `found`, in this traffic.
fn time_until_found(
    node_id: u8,
    (stored, found): (BitRate, BitRate),
    traffic: fn(&mut ImageRig, BitRate) -> Traffic,
    limit: Time,
) -> Option<Time> {
    let mut rig = ImageRig::new(found, [board_with(0, settings(node_id, stored))]);
    rig.network.power_off(0);
    rig.network.adapter_mut(rig.master).close();
    let mut traffic = traffic(&mut rig, found);
    traffic.run_for(&mut rig, Time::from_ms(10));
    let on = switch_on(&mut rig);
    while rig.network.now() < on + limit {
        traffic.run_for(&mut rig, Time::from_ms(1));
        let (mut rates, rate) = (takes_part(&rig, on), bit_per_s(found));
        if let Some((time, _)) = rates.find(|(_, taken)| *taken == rate) {
            let (came, _) = rig.bit_rates(0, on)[0];
            return Some(time - came);
        }
    }
    None
}

/// Whether a node at `stored` may miss each heartbeat at `found`: it lasts less than five of the node's bits.
fn may_not_notice((stored, found): (BitRate, BitRate)) -> bool {
    u32::from(found.kbit_per_s()) * 2 >= u32::from(stored.kbit_per_s()) * 25
}

#[test]
fn a_wrong_stored_rate_is_found_within_5_s_by_one_heartbeat_a_second() {
    for node_id in [1, 0xFF] {
        for pair in pairs().filter(|&pair| !may_not_notice(pair)).step_by(every(5)) {
            let time = time_until_found(node_id, pair, Traffic::sparse, Time::from_s(8));
            assert_within(Time::from_s(5), time, &format!("{node_id:02X}: stored, found {pair:?}"));
        }
    }
}

#[test]
fn a_wrong_stored_rate_is_found_in_100_ms_under_load_or_a_turn_later() {
    for (stored, found) in pairs() {
        let time = time_until_found(0xFF, (stored, found), Traffic::dense, Time::from_s(2));
        // The frames at 10 kbit/s are so long that a stay ends before the search has come to that rate.
        let turn =
            Time::from_us(30_000 + 18 * LONG_FRAME_BITS * 1000 / u64::from(stored.kbit_per_s()));
        let limit = Time::from_ms(100) + if found == BitRate::Kbit10 { turn } else { Time::ZERO };
        assert_within(limit, time, &format!("{stored:?} stored, {found:?} found"));
    }
}

/// How a master is noticed.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Notice {
    /// A heartbeat a second.
    Sparse,
    /// A request to the board every 20 ms.
    Polls,
}

/// The errors that another node counts while a board at a wrong rate searches, and then while it is a guest for 3 s.
fn errors_of_others((stored, found): (BitRate, BitRate), notice: Notice) -> [u64; 2] {
    let mut rig = board(100, stored, found);
    rig.network.power_off(0);
    let other = rig.network.add_adapter(Adapter::new(bit_per_s(found)));
    rig.network.run_for(Time::from_ms(10));
    rig.network.power_on(0);
    let mut next = rig.network.now();
    let mut run = |rig: &mut ImageRig, span: Time, is_over: fn(&ImageRig, u32) -> bool| {
        let end = rig.network.now() + span;
        while rig.network.now() < end && !is_over(rig, bit_per_s(found)) {
            if rig.network.now() >= next && rig.network.adapter_mut(rig.master).unsent() == 0 {
                let (frame, every_ms) = match notice {
                    Notice::Sparse => (Frame::data(Id::Standard(0x705), &[0x05]), 1_000),
                    Notice::Polls => (on_the_wire(&read(1)), 20),
                };
                next = rig.network.now() + Time::from_ms(every_ms);
                rig.network.send(rig.master, frame);
            }
            rig.network.run_for(Time::from_us(500));
        }
        rig.network.adapter_mut(other).errors()
    };
    let is_silent = |rig: &ImageRig, _| rig.network.board(0).chip().can(1).is_silent();
    let is_guest = |rig: &ImageRig, rate| {
        let chip = rig.network.board(0).chip();
        !chip.can(1).is_silent() && chip.can(1).bit_rate() == rate
    };
    let begin = run(&mut rig, Time::from_s(20), is_silent);
    let found_at = run(&mut rig, Time::from_s(20), is_guest);
    let end = run(&mut rig, Time::from_s(3), |_, _| false);
    assert!(is_guest(&rig, bit_per_s(found)), "{stored:?} stored, {found:?}: it stays");
    [found_at - begin, end - found_at]
}

#[test]
fn others_count_at_most_200_errors_a_search_and_none_of_a_guest() {
    for (stored, found) in pairs().step_by(every(5)) {
        // A slower node may not notice a heartbeat: it is over before a bit is sampled twice.
        let is_noticed = stored.kbit_per_s() >= 50 || found.kbit_per_s() <= 125;
        for notice in [Notice::Polls, Notice::Sparse] {
            if is_noticed || notice == Notice::Polls {
                let [search, guest] = errors_of_others((stored, found), notice);
                let what = format!("{stored:?} stored, {found:?}, {notice:?}: {search}, {guest}");
                println!("{what}");
                assert!(search <= 200 && guest == 0, "{what}");
            }
        }
    }
}
