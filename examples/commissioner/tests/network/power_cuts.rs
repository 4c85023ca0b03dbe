//! Power cuts of each party after each kind of frame of the commissioner.

use std::collections::BTreeSet;

use canopen_node::{BitRate, BitRateSetting, Frame, lss};
use emulator::Time;
use example_commissioner::application::State;
use testkit::{parallel, sdo::Client, slave_bus::Habits};

use crate::rig::{Rig, address, blank, commissioner};

/// A commissioner with the first boards in the table and its flash, and these blank boards.
fn known(table: &[u8], boards: u32) -> Rig {
    let mut commissioner = commissioner(0, BitRate::Kbit125);
    commissioner.set_flash(0, table);
    let boards = blank(1..=boards).into_iter().map(|board| (board, Habits::default()));
    let mut rig = Rig::of(commissioner, BitRate::Kbit125, boards);
    rig.settle();
    rig
}

/// The flash of a commissioner with the first boards in the table.
fn flash_with(boards: u32) -> Vec<u8> {
    let mut rig = Rig::new([]);
    rig.set_table(&(1..=boards).map(|number| Some(address(1, number))).collect::<Vec<_>>());
    rig.network.board(0).flash()
}

/// Cuts the power of a party while `work` is done, at each moment; `end` looks at what becomes of it.
fn at_each_moment(
    known: impl Fn() -> Rig + Sync,
    work: impl Fn(&mut Rig) + Sync,
    cut: impl Fn(&mut Rig, usize) + Sync,
    end: impl Fn(&mut Rig) + Sync,
) {
    let mut rig = known();
    rig.sent.clear();
    work(&mut rig);
    let moments = moments(&rig.sent);
    assert!(moments.len() > 20, "{moments:?}");
    let work_with_cut = |moment: &usize| {
        let mut rig = known();
        rig.sent.clear();
        cut(&mut rig, *moment);
        work(&mut rig);
        end(&mut rig);
    };
    parallel::map(&moments, work_with_cut, |_, ()| {});
}

/// The numbers of frames after which the power is cut: the first of each pair of kinds, and each fourth, or each 24th of a
/// scan.
fn moments(frames: &[Frame]) -> Vec<usize> {
    let kind = |frame: &Frame| match frame.cob_id() {
        lss::REQUEST_COB_ID => (0, frame.data()[0]),
        cob_id => (cob_id, 0),
    };
    let mut seen = BTreeSet::new();
    let pairs = frames.windows(2).enumerate();
    let chosen = pairs.filter(|(number, pair)| {
        let step = if pair[0].data()[0] == 0x51 { 24 } else { 4 };
        seen.insert((kind(&pair[0]), kind(&pair[1]))) || number.is_multiple_of(step)
    });
    chosen.map(|(number, _)| number + 1).collect()
}

fn take(rig: &mut Rig) {
    rig.press();
}

/// The end after a cut: the board has its node-ID, or waits for the button and nothing of it is in the table.
fn expect_both(rig: &mut Rig, state: State) {
    match state {
        State::New => {
            assert_eq!(rig.node_ids(), [Some(1), None]);
            assert_eq!(rig.table(), [Some(address(1, 1))]);
            assert_eq!(rig.press(), State::Complete);
        }
        state => assert_eq!(state, State::Complete),
    }
    assert_eq!(rig.table(), [1, 2].map(|number| Some(address(1, number))));
    assert_eq!(rig.restart_all(), State::Complete);
    assert_eq!(rig.node_ids(), [Some(1), Some(2)]);
    assert!(rig.nothing_is_stored());
}

#[test]
fn power_cuts_of_the_commissioner_while_it_takes_a_board_cost_nothing() {
    let flash = flash_with(1);
    let cut = |rig: &mut Rig, moment| rig.cut_after = moment;
    at_each_moment(
        || known(&flash, 2),
        take,
        cut,
        |rig| {
            let state = rig.restart();
            expect_both(rig, state);
        },
    );
}

#[test]
fn power_cuts_of_a_board_that_is_being_taken_cost_nothing() {
    let flash = flash_with(1);
    let cut = |rig: &mut Rig, moment| rig.cut_slave_after = Some((1, moment));
    at_each_moment(
        || known(&flash, 2),
        take,
        cut,
        |rig| {
            rig.slaves.calm();
            let state = rig.restart();
            expect_both(rig, state);
        },
    );
}

fn switch(rig: &mut Rig) {
    rig.switch(250);
}

/// All are together at one of the two rates, and stay there.
fn expect_together(rig: &mut Rig) {
    assert_eq!(rig.restart_all(), State::Complete);
    assert_eq!(rig.node_ids(), [1, 2].map(Some));
    let rate = BitRateSetting::Fixed(rig.slaves.rate);
    for slave in &rig.slaves.slaves {
        let stored = slave.rig.stored().map(|stored| (stored.node_id, stored.bit_rate));
        let first = (None, BitRateSetting::Fixed(BitRate::Kbit125));
        assert_eq!(stored.unwrap_or(first), (None, rate));
    }
    assert_eq!(rig.number(0x2101, 0), 0);
}

#[test]
fn power_cuts_of_the_commissioner_in_a_switch_leave_all_at_one_bit_rate() {
    let flash = flash_with(2);
    let cut = |rig: &mut Rig, moment| rig.cut_after = moment;
    at_each_moment(
        || known(&flash, 2),
        switch,
        cut,
        |rig| {
            // The cut is longer than the switch. Afterwards it looks for the boards at other rates.
            rig.run_for(Time::from_s(1));
            rig.restart();
            expect_together(rig);
        },
    );
}

#[test]
fn power_cuts_of_a_board_in_a_switch_leave_all_at_one_bit_rate() {
    let flash = flash_with(2);
    let cut = |rig: &mut Rig, moment| rig.cut_slave_after = Some((1, moment));
    at_each_moment(
        || known(&flash, 2),
        switch,
        cut,
        |rig| {
            rig.slaves.calm();
            rig.run_for(Time::from_s(15));
            // The same order again completes what the cut has left.
            if rig.settle() == State::NotStored || rig.slaves.slaves[0].rig.stored().is_some() {
                assert_eq!(rig.switch(250), State::Complete);
            }
            expect_together(rig);
        },
    );
}
