//! Supervision on the release image: a right rate is kept at no loss of time, and a lost node is found.

use crate::{
    rates_detection::{Traffic, switch_on, takes_part},
    reachable::{
        LONG_FRAME_BITS, assert_answers_a_late_master, boards, is_answered, pairs, patience, read,
    },
    rig::*,
};

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
            assert_answers_a_late_master(pair, 1, heartbeat_ms, 50, Time::from_ms(late_ms));
        }
    }
}

#[test]
fn a_master_that_follows_a_switch_without_delay_50_ms_late_is_answered() {
    for pair in pairs().step_by(every(5)) {
        assert_answers_a_late_master(pair, 1, 1000, 0, Time::from_ms(50));
    }
}

#[test]
fn a_laptop_at_a_wrong_rate_at_power_on_leaves_the_stored_rate() {
    for (number, (home, wrong)) in pairs().enumerate().step_by(every(5)) {
        let heartbeat_ms = [1000, 0][number % 2];
        let mut rig = boards(1, heartbeat_ms, home);
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

/// A board alone with a master at another rate than the stored one, from power-on.
fn alone(heartbeat_ms: u16, stored: BitRate, master: BitRate) -> ImageRig {
    let settings = settings(1, stored).with_heartbeat_ms(heartbeat_ms);
    let mut rig = ImageRig::new(master, [board_with(1, settings)]);
    rig.network.record(Recording::Off);
    rig
}

#[test]
fn a_wrong_stored_rate_is_found_by_a_polling_master_within_1500_ms() {
    for (number, (stored, found)) in pairs().enumerate().step_by(every(5)) {
        let heartbeat_ms = [1000, 0, 100][number % 3];
        let mut rig = alone(heartbeat_ms, stored, found);
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
    let mut rig = boards(1, 1000, BitRate::Kbit125);
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
        let mut rig = alone(0, BitRate::Kbit500, found);
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
        assert!(is_answered(&mut rig, &read(7), 0x587, patience(stored)), "{requests:?}");
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
