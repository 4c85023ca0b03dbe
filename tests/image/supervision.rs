//! A board at a wrong bit rate beside others: the errors that they count, and its answers as a guest.

use crate::{
    reachable::{pairs, read},
    rig::*,
};

/// How a master is noticed.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Traffic {
    /// A heartbeat a second.
    Sparse,
    /// A request to the board every 20 ms.
    Polls,
}

/// The errors that another node counts while a board at a wrong rate searches, and then while it is a guest for 3 s.
fn errors_of_others((stored, found): (BitRate, BitRate), traffic: Traffic) -> [u64; 2] {
    let settings = settings(1, stored).with_heartbeat_ms(100);
    let mut rig = ImageRig::new(found, [board_with(0, settings)]);
    rig.network.power_off(0);
    let other = rig.network.add_adapter(Adapter::new(bit_per_s(found)));
    rig.network.record(Recording::Off);
    rig.network.run_for(Time::from_ms(10));
    rig.network.power_on(0);
    let mut next = rig.network.now();
    let mut run = |rig: &mut ImageRig, span: Time, is_over: fn(&ImageRig, u32) -> bool| {
        let end = rig.network.now() + span;
        while rig.network.now() < end && !is_over(rig, bit_per_s(found)) {
            if rig.network.now() >= next && rig.network.adapter_mut(rig.master).unsent() == 0 {
                let (frame, every_ms) = match traffic {
                    Traffic::Sparse => (Frame::data(Id::Standard(0x705), &[0x05]), 1_000),
                    Traffic::Polls => (on_the_wire(&read(1)), 20),
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
        for traffic in [Traffic::Polls, Traffic::Sparse] {
            if is_noticed || traffic == Traffic::Polls {
                let [search, guest] = errors_of_others((stored, found), traffic);
                let what = format!("{stored:?} stored, {found:?}, {traffic:?}: {search}, {guest}");
                println!("{what}");
                assert!(search <= 200 && guest == 0, "{what}");
            }
        }
    }
}

/// A board with node-ID 1 that the master, at another rate, has found.
fn found((stored, found): (BitRate, BitRate)) -> ImageRig {
    let settings = settings(1, stored).with_heartbeat_ms(1000);
    let mut rig = ImageRig::new(found, [board_with(0, settings)]);
    rig.network.record(Recording::Latest(1_000));
    let time = rig.poll_until(&read(1), Time::from_s(2), |frame| frame.cob_id() == 0x581);
    assert!(time.is_some(), "{stored:?} stored, {found:?}");
    rig
}

#[test]
fn requests_every_5_s_are_answered_the_first_perhaps_when_repeated() {
    for pair in pairs().step_by(every(5)) {
        let mut rig = found(pair);
        for _ in 0..3 {
            let next = rig.network.now() + Time::from_s(5);
            rig.network.run_until(next);
            let is_answered = (0..2).any(|_| {
                rig.collect(Time::ZERO);
                if rig.network.adapter_mut(rig.master).unsent() == 0 {
                    rig.queue(&read(1));
                }
                rig.wait_for(Time::from_s(1), |frame| frame.cob_id() == 0x581).is_some()
            });
            assert!(is_answered, "{pair:?}");
        }
    }
}

/// The board at the second rate of each pair stores a node-ID after a pause in the session.
fn pause_in_sessions(pairs: impl Iterator<Item = (BitRate, BitRate)>) {
    for pair in pairs {
        let mut rig = found(pair);
        rig.send("04 01");
        rig.ask("11 07", "11 00");
        rig.network.run_for(Time::from_s(60));
        rig.ask("17", "17 00");
        println!("{pair:?}");
    }
}

#[test]
fn a_session_with_a_guest_may_pause_for_60_s() {
    pause_in_sessions(pairs().step_by(9));
}

#[test]
#[ignore = "takes 40 s of CPU time; `.ci/run chips` runs it"]
fn a_session_with_a_guest_may_pause_for_60_s_at_each_pair_of_rates() {
    pause_in_sessions(pairs());
}
