//! The switch of the whole network to another bit rate.

use canopen_node::{BitRate, BitRateSetting};
use emulator::Time;
use example_commissioner::application::State;
use testkit::{
    parallel,
    random::every,
    sdo::Client,
    slave_bus::{Defect, Habits, Happening},
};

use crate::{
    rig::{Rig, address, new_board, plain_board},
    three_real,
};

/// A commissioner and 32 boards, all in the table, at 500 kbit/s.
fn thirty_two() -> Rig {
    let rate = BitRate::Kbit500;
    let boards = (1..=32).map(|number| (new_board(address(1, number), rate), Habits::default()));
    let mut rig = Rig::at(rate, boards);
    rig.settle();
    rig.set_table(&(1..=32).map(|number| Some(address(1, number))).collect::<Vec<_>>());
    assert_eq!(rig.restart(), State::Complete);
    assert_eq!(rig.node_ids(), (1..=32).map(Some).collect::<Vec<_>>());
    rig
}

fn rates(rig: &Rig) -> Vec<BitRate> {
    let mut rates: Vec<_> = rig.slaves.slaves.iter().map(|slave| slave.rig.bit_rate()).collect();
    rates.dedup();
    rates
}

#[test]
fn a_network_of_32_boards_goes_to_another_bit_rate_and_stays_there() {
    let mut rig = thirty_two();
    assert_eq!(rig.switch(250), State::Complete);
    assert_eq!(rates(&rig), [BitRate::Kbit250]);
    for slave in &rig.slaves.slaves {
        let stored = slave.rig.stored().expect("it was asked for");
        assert_eq!(
            (stored.node_id, stored.bit_rate),
            (None, BitRateSetting::Fixed(BitRate::Kbit250))
        );
    }
    assert_eq!(rig.restart_all(), State::Complete);
    assert_eq!(rates(&rig), [BitRate::Kbit250]);
    assert_eq!(rig.number(0x2101, 0), 0);
}

#[test]
fn the_old_bit_rate_is_back_if_a_board_does_not_come() {
    // It has no power from activate bit timing on; it refuses the rate.
    for fault in [None, Some(Defect::Refuses(&[0x13]))] {
        let mut rig = thirty_two();
        rig.slaves.slaves[7].defect = fault;
        rig.order(250);
        if fault.is_none() {
            rig.run_until_request(0x15);
            rig.slaves.happen(7, Happening::PowerOff);
        }
        assert_eq!(rig.settle(), State::TakenBack);
        rig.slaves.happen(7, Happening::PowerOff);
        rig.slaves.happen(7, Happening::PowerOn);
        assert_eq!(rates(&rig), [BitRate::Kbit500]);
        assert!(rig.nothing_is_stored());
        assert_eq!(rig.number(0x2101, 0), 0);
        assert_eq!(rig.restart_all(), State::Complete);
        assert_eq!(rates(&rig), [BitRate::Kbit500]);
    }
}

#[test]
fn nothing_is_switched_while_a_board_is_missing() {
    let mut rig = thirty_two();
    rig.slaves.happen(7, Happening::PowerOff);
    assert_eq!(rig.switch(250), State::TakenBack);
    assert!(!rig.take_requests().contains(&0x15));
    assert_eq!(rates(&rig), [BitRate::Kbit500]);
}

#[test]
fn a_bit_rate_that_is_none_is_refused() {
    let mut rig = Rig::new([]);
    assert_eq!(rig.download(0x2101, 0, &100_u16.to_le_bytes()), Err(0x0609_0030));
    assert_eq!(rig.download(0x2200, 0, &[1; 20]), Err(0x0609_0030));
}

/// The milliseconds from activate bit timing to a power cut of the commissioner, and those without power.
fn short_cuts() -> Vec<(u64, u64)> {
    let starts = [0, 10, 50, 100, 150, 199, 210, 300, 390];
    let lengths = [20, 50, 100, 150, 190];
    let all = starts.into_iter().flat_map(|start| lengths.map(|length| (start, length)));
    all.step_by(every(4)).collect()
}

/// Cuts the power of the commissioner for a moment after activate bit timing; returns the state that it comes to.
fn cut_in_switch(rig: &mut Rig, rate: u16, (start, length): (u64, u64)) -> State {
    rig.order(rate);
    rig.run_until_request(0x15);
    rig.run_for(Time::from_ms(start));
    rig.network.power_off(0);
    rig.run_for(Time::from_ms(length));
    rig.network.power_on(0);
    rig.run_for(Time::from_ms(50));
    rig.settle()
}

#[test]
fn a_moment_without_power_in_a_switch_leaves_the_commissioner_with_all() {
    let cut = |cut: &(u64, u64)| {
        // Boards that search for nobody.
        let boards = (1..=2).map(|number| (plain_board(number), Habits::default()));
        let mut rig = Rig::at(BitRate::Kbit125, boards);
        rig.settle();
        rig.set_table(&[1, 2].map(|number| Some(address(1, number))));
        assert_eq!(rig.restart(), State::Complete);
        assert_eq!(cut_in_switch(&mut rig, 250, *cut), State::Complete, "{cut:?}");
        for _ in 0..2 {
            assert_eq!(rates(&rig), [BitRate::Kbit250], "{cut:?}");
            assert_eq!((rig.node_ids(), rig.number(0x2101, 0)), ([1, 2].map(Some).to_vec(), 0));
            assert_eq!(rig.restart_all(), State::Complete, "{cut:?}");
        }
    };
    parallel::map(&short_cuts(), cut, |_, ()| {});
}

#[test]
fn release_images_meet_again_after_a_moment_without_power_in_a_switch() {
    let mut rig = three_real();
    for (rate, length) in [(250, 20), (500, 50), (250, 100), (500, 150), (250, 190)] {
        assert_eq!(cut_in_switch(&mut rig, rate, (0, length)), State::Complete, "{length} ms");
        let rates: Vec<u32> =
            (0..4).map(|board| rig.network.board(board).chip().can(1).bit_rate()).collect();
        assert_eq!(rates, [u32::from(rate) * 1_000; 4], "{length} ms");
        assert_eq!((rig.number(0x2100, 2), rig.number(0x2101, 0)), (0b111, 0));
    }
}

#[test]
fn a_board_without_power_beside_the_commissioner_stays_with_the_others() {
    for length in [20, 150] {
        let boards = (1..=3).map(|number| (plain_board(number), Habits::default()));
        let mut rig = Rig::at(BitRate::Kbit125, boards);
        rig.settle();
        rig.set_table(&[1, 2, 3].map(|number| Some(address(1, number))));
        rig.restart();
        rig.order(250);
        rig.run_until_request(0x15);
        // The others have received it.
        rig.run_for(Time::from_ms(2));
        rig.network.power_off(0);
        rig.slaves.happen(0, Happening::PowerOff);
        rig.run_for(Time::from_ms(length));
        rig.network.power_on(0);
        rig.slaves.happen(0, Happening::PowerOn);
        rig.run_for(Time::from_ms(50));
        assert_eq!((rig.settle(), rates(&rig)), (State::Complete, vec![BitRate::Kbit250]));
    }
}

#[test]
fn boards_without_power_while_they_store_come_with_the_same_order_again() {
    let boards = (1..=2).map(|number| (plain_board(number), Habits::default()));
    let mut rig = Rig::at(BitRate::Kbit125, boards);
    rig.settle();
    rig.set_table(&[1, 2].map(|number| Some(address(1, number))));
    rig.restart();
    rig.order(250);
    rig.run_until_request(0x17);
    rig.network.power_off(0);
    (0..2).for_each(|slave| rig.slaves.happen(slave, Happening::PowerOff));
    rig.run_for(Time::from_ms(100));
    // It may have power before its boards, and disturbs nobody at another rate.
    rig.network.power_on(0);
    rig.run_for(Time::from_ms(50));
    for _ in 0..100 {
        assert_eq!(rig.rate(), BitRate::Kbit250);
        rig.run_for(Time::from_ms(50));
    }
    assert_eq!(rig.settle(), State::NotStored);
    (0..2).for_each(|slave| rig.slaves.happen(slave, Happening::PowerOn));
    assert_eq!(rates(&rig), [BitRate::Kbit125], "they have not stored it");
    assert_eq!(rig.switch(250), State::Complete);
    assert_eq!(rig.restart_all(), State::Complete);
    assert_eq!(rates(&rig), [BitRate::Kbit250]);
}

#[test]
fn the_commissioner_is_silent_in_both_delays_of_a_switch() {
    let mut rig = Rig::new([new_board(address(1, 1), BitRate::Kbit125)]);
    rig.settle();
    rig.set_table(&[Some(address(1, 1))]);
    rig.restart();
    assert_eq!(rig.download(0x1017, 0, &100_u16.to_le_bytes()), Ok(()));
    rig.order(250);
    rig.run_until_request(0x15);
    let sent = rig.sent.len();
    rig.run_for(Time::from_ms(395));
    assert_eq!(rig.sent.len(), sent, "no heartbeat");
    rig.run_for(Time::from_ms(10));
    assert!(rig.sent.len() > sent);
    assert_eq!(rig.settle(), State::Complete);
}
