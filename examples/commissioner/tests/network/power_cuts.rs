//! Power cuts of each party behind the frames on the bus: after each kind of frame, and as a campaign after each frame.

use std::{collections::BTreeSet, thread};

use canopen_node::{BitRate, BitRateSetting, Frame, lss};
use emulator::Time;
use example_commissioner::application::State;
use testkit::{
    parallel,
    sdo::Client,
    slave_bus::{Habits, Slave},
};

use crate::rig::{Cut, Party, Rig, address, blank, commissioner, plain_board};

const PARTIES: [Party; 3] = [Party::Commissioner, Party::Slave(0), Party::Slave(1)];
/// Shorter than the switch delay, and longer than the switch.
const SPANS: [Time; 2] = [Time::from_ms(20), Time::from_s(1)];

/// A commissioner with the first boards in the table and its flash, a board, and another that searches for nobody.
fn known(table: &[u8]) -> Rig {
    let mut commissioner = commissioner(0, BitRate::Kbit125);
    commissioner.set_flash(0, table);
    let boards = blank([1]).into_iter().chain([plain_board(2)]);
    let boards = boards.map(|board| (board, Habits::default()));
    let mut rig = Rig::of(commissioner, BitRate::Kbit125, boards);
    rig.settle();
    rig.frames.clear();
    rig
}

/// The flash of a commissioner with the first boards in the table.
fn flash_with(boards: u32) -> Vec<u8> {
    let mut rig = Rig::new([]);
    rig.set_table(&(1..=boards).map(|number| Some(address(1, number))).collect::<Vec<_>>());
    rig.network.board(0).flash()
}

/// A cut that is told if what follows from it is wrong.
struct Told(Cut);

impl Drop for Told {
    fn drop(&mut self) {
        if thread::panicking() {
            eprintln!("{:?}", self.0);
        }
    }
}

/// Which cuts are tried.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Cuts {
    /// Behind some frames, each of a party, with a span in turn.
    Some,
    /// Behind each frame, with each span.
    All,
}

/// Cuts the power of each party while `work` is done with so many boards in the table; `end` looks at what becomes of it.
fn cut_power(boards: u32, work: fn(&mut Rig), end: fn(&mut Rig), which: Cuts) {
    let flash = flash_with(boards);
    let mut rig = known(&flash);
    work(&mut rig);
    let moments = match which {
        Cuts::Some => some(&rig.frames),
        Cuts::All => (1..=rig.frames.len()).collect(),
    };
    assert!(moments.len() > 20, "{moments:?}");
    let mut cuts = Vec::new();
    for (number, after) in moments.into_iter().enumerate() {
        let all =
            SPANS.into_iter().flat_map(|span| PARTIES.map(|party| Cut { party, after, span }));
        match which {
            Cuts::Some => cuts.extend(all.cycle().nth(number)),
            Cuts::All => cuts.extend(all),
        }
    }
    println!("{} power cuts behind {} frames", cuts.len(), rig.frames.len());
    let work_with_cut = |cut: &Cut| {
        let told = Told(*cut);
        let mut rig = known(&flash);
        rig.cut = Some(*cut);
        work(&mut rig);
        end(&mut rig);
        drop(told);
    };
    parallel::map(&cuts, work_with_cut, |_, ()| {});
}

/// The numbers of the first frame of each pair of kinds.
fn some(frames: &[Frame]) -> Vec<usize> {
    let kind = |frame: &Frame| match frame.cob_id() {
        lss::REQUEST_COB_ID | lss::RESPONSE_COB_ID => (frame.cob_id(), frame.data()[0]),
        cob_id => (cob_id, 0),
    };
    let mut seen = BTreeSet::new();
    let pairs = frames.windows(2).enumerate();
    let chosen = pairs.filter(|(_, pair)| seen.insert((kind(&pair[0]), kind(&pair[1]))));
    chosen.map(|(number, _)| number + 1).collect()
}

fn take(rig: &mut Rig) {
    rig.press();
}

/// The board has its node-ID, or waits for the button and nothing of it is in the table.
fn expect_both(rig: &mut Rig) {
    if rig.restart() == State::New {
        assert_eq!(rig.node_ids(), [Some(1), None]);
        assert_eq!(rig.table(), [Some(address(1, 1))]);
        rig.press();
    }
    assert_eq!(rig.state(), State::Complete);
    assert_eq!(rig.table(), [1, 2].map(|number| Some(address(1, number))));
    assert_eq!(rig.restart_all(), State::Complete);
    assert_eq!(rig.node_ids(), [Some(1), Some(2)]);
    assert!(rig.nothing_is_stored());
}

#[test]
fn a_power_cut_while_a_board_is_taken_costs_nothing() {
    cut_power(1, take, expect_both, Cuts::Some);
}

#[test]
#[ignore = "a campaign: minutes"]
fn a_power_cut_after_any_frame_while_a_board_is_taken_costs_nothing() {
    cut_power(1, take, expect_both, Cuts::All);
}

fn switch_there_and_back(rig: &mut Rig) {
    rig.switch(250);
    rig.switch(125);
}

/// All are together at one of the two rates, and stay there; the same order again completes what the cut has left.
fn expect_together(rig: &mut Rig) {
    rig.run_for(Time::from_s(2));
    let state = rig.settle();
    let rate = rig.rate();
    if state != State::Complete || rig.slaves.slaves.iter().any(|slave| stored(slave) != rate) {
        assert_eq!(rig.switch(rate.kbit_per_s()), State::Complete, "after {state:?} at {rate}");
    }
    assert_eq!(rig.restart_all(), State::Complete);
    assert_eq!(rig.node_ids(), [1, 2].map(Some));
    assert_eq!((rig.rate(), rig.slaves.rate), (rate, rate));
    for slave in &rig.slaves.slaves {
        assert_eq!(
            (slave.rig.stored().and_then(|stored| stored.node_id), stored(slave)),
            (None, rate)
        );
    }
    assert_eq!(rig.number(0x2101, 0), 0);
}

/// The bit rate at which a slave starts.
fn stored(slave: &Slave) -> BitRate {
    match slave.rig.stored().map(|stored| stored.bit_rate) {
        Some(BitRateSetting::Fixed(rate)) => rate,
        _ => BitRate::Kbit125,
    }
}

#[test]
fn a_power_cut_in_a_switch_parts_nobody_from_the_others() {
    cut_power(2, switch_there_and_back, expect_together, Cuts::Some);
}

#[test]
#[ignore = "a campaign: minutes"]
fn a_power_cut_after_any_frame_of_a_switch_parts_nobody_from_the_others() {
    cut_power(2, switch_there_and_back, expect_together, Cuts::All);
}
