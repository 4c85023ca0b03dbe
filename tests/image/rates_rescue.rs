//! Networks of release images with a wrong bit rate in some nodes: the time until the master reaches every node again.

use canopen_node::BitRate;
use emulator::{
    Time,
    can::{Frame, Id},
    network::Recording,
};
use testkit::frames;

use crate::{
    bit_rate::{answers, others, talk, wait_until_acknowledged},
    rig::{DEFAULT_BIT_RATE, ImageRig, blank_board, board_with, on_the_wire, settings},
};

/// The interval at which the master asks a missing node.
const POLL: Time = Time::from_ms(100);
/// The longest allowed absence: the 30 s after which a node on a silent bus tries its own rate again, and a search.
const LIMIT: Time = Time::from_s(40);

/// The master's check of a node: the request, and the COB-ID of the answer.
struct Probe {
    request: Frame,
    answer: Id,
}

/// Asks node `id` for its device type.
fn node(id: u8) -> Probe {
    let sdo = |cob_id: u16| Id::Standard(cob_id + u16::from(id));
    let request = Frame::data(sdo(0x600), &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    Probe { request, answer: sdo(0x580) }
}

/// Asks whether there is a node without a node-ID.
fn unconfigured() -> Probe {
    Probe { request: on_the_wire(&frames::request("4C")), answer: Id::Standard(0x7E4) }
}

fn nodes(count: u8) -> Vec<Probe> {
    (1..=count).map(node).collect()
}

/// Makes the master ask all of them in turn until each has answered; returns the time, `None` if it is over the limit.
fn reach(rig: &mut ImageRig, mut missing: Vec<Probe>, limit: Time) -> Option<Time> {
    let since = rig.network.now();
    while rig.network.receive(rig.master).is_some() {}
    for turn in 0.. {
        if missing.is_empty() {
            break;
        }
        if rig.network.now() > since + limit {
            return None;
        }
        if rig.network.adapter_mut(rig.master).unsent() == 0 {
            let probe = &missing[turn % missing.len()];
            rig.network.send(rig.master, probe.request);
        }
        rig.network.run_for(POLL);
        while let Some((_, frame)) = rig.network.receive(rig.master) {
            missing.retain(|probe| probe.answer != frame.id);
        }
    }
    Some(rig.network.now() - since)
}

/// Prints the time until the master has reached all of them.
fn all_reached(scenario: &str, rig: &mut ImageRig, missing: Vec<Probe>) {
    let span = reach(rig, missing, LIMIT);
    match span {
        Some(span) => println!("{scenario:<62} {:>6.1} s", span.as_ms() as f64 / 1000.0),
        None => panic!("{scenario}: a node is stranded"),
    }
}

/// Nodes 1 to 4, all at this rate, each with a heartbeat.
fn four(bit_rate: BitRate, heartbeat_ms: u16) -> ImageRig {
    let with =
        |number| board_with(number, settings(number, bit_rate).with_heartbeat_ms(heartbeat_ms));
    ImageRig::new(bit_rate, (1..=4).map(with))
}

/// The master switches all nodes in configuration state, and itself, to another rate.
fn switch_over(rig: &mut ImageRig, to: BitRate, is_to_be_stored: bool) {
    const DELAY_MS: u64 = 50;
    rig.transmit_request(&format!("13 00 {:02X}", to.index()));
    rig.network.run_for(Time::from_ms(20));
    if is_to_be_stored {
        rig.transmit_request("17");
        rig.network.run_for(Time::from_ms(50));
    }
    let end = rig.transmit_request(&format!("15 {DELAY_MS:02X} 00"));
    rig.network.run_until(end + Time::from_ms(DELAY_MS));
    rig.set_master_bit_rate(to);
    rig.network.run_until(end + Time::from_ms(2 * DELAY_MS + 1));
}

/// Puts only nodes 1 to 3 into configuration state: node 4 was switched back alone.
fn leave_node_4_out(rig: &mut ImageRig) {
    rig.network.power_off(3);
    rig.transmit_request("04 01");
    rig.network.run_for(Time::from_ms(20));
}

fn power_on_at_any_rate(rig: &mut ImageRig, board: usize) {
    rig.network.power_on(board);
}

#[test]
fn a_node_without_power_during_the_switch_is_reached_after_it() {
    for (from, to) in [
        (BitRate::Kbit125, BitRate::Kbit1000),
        (BitRate::Kbit1000, BitRate::Kbit125),
        (BitRate::Kbit500, BitRate::Kbit20),
        (BitRate::Kbit50, BitRate::Kbit250),
    ] {
        let mut rig = four(from, 1000);
        leave_node_4_out(&mut rig);
        switch_over(&mut rig, to, true);
        power_on_at_any_rate(&mut rig, 3);
        let (from, to) = (from.kbit_per_s(), to.kbit_per_s());
        let scenario = format!("1 of 4 without power while {from} became {to} kbit/s");
        all_reached(&scenario, &mut rig, nodes(4));
    }
}

#[test]
fn a_node_with_another_rate_stored_is_reached() {
    for (stored, bus) in [
        (BitRate::Kbit1000, BitRate::Kbit10),
        (BitRate::Kbit1000, BitRate::Kbit800),
        (BitRate::Kbit800, BitRate::Kbit1000),
        (BitRate::Kbit250, BitRate::Kbit125),
        (BitRate::Kbit125, BitRate::Kbit250),
        (BitRate::Kbit125, BitRate::Kbit1000),
        (BitRate::Kbit10, BitRate::Kbit1000),
    ] {
        for heartbeat_ms in [1000, 0] {
            let with = |number| {
                let bit_rate = if number == 2 { stored } else { bus };
                board_with(number, settings(number, bit_rate).with_heartbeat_ms(heartbeat_ms))
            };
            let mut rig = ImageRig::new(bus, (1..=4).map(with));
            let (stored, bus) = (stored.kbit_per_s(), bus.kbit_per_s());
            let scenario =
                format!("1 of 4 has {stored}, not {bus} kbit/s, heartbeat {heartbeat_ms} ms");
            all_reached(&scenario, &mut rig, nodes(4));
        }
    }
}

/// A board alone with a master at another rate, for all pairs of rates: prints a table of the times until it is
/// reached. If a board is not reached soon, the master changes to the board's rate and must reach it there. Returns
/// their number.
fn alone_with_the_master(node_id: u8, probe: fn() -> Probe) -> usize {
    const SOON: Time = Time::from_s(5);
    let mut count = 0;
    for board in BitRate::ALL {
        print!("{:>5} kbit/s, master at", board.kbit_per_s());
        for master in BitRate::ALL.into_iter().filter(|&master| master != board) {
            let mut rig = ImageRig::new(master, [board_with(0, settings(node_id, board))]);
            rig.network.record(Recording::Latest(10));
            print!(" {}:", master.kbit_per_s());
            match reach(&mut rig, vec![probe()], SOON) {
                Some(span) => print!(" {:.1} s", span.as_ms() as f64 / 1000.0),
                None => {
                    count += 1;
                    rig.set_master_bit_rate(board);
                    let span = reach(&mut rig, vec![probe()], LIMIT);
                    assert!(span.is_some(), "{board:?} with a master at {master:?} is stranded");
                    print!(" at its own");
                }
            }
        }
        println!();
    }
    count
}

#[test]
fn a_lone_board_without_a_node_id_is_reached_at_any_rate() {
    assert_eq!(alone_with_the_master(0xFF, unconfigured), 0);
}

#[test]
fn a_node_that_sits_alone_with_the_master_is_reached_but_at_two_pairs() {
    // At 250 kbit/s with a master at 50, and at 20 with one at 10, its boot-up drives the master bus-off repeatedly
    // before the master is error passive, and so before its request can be received in silence.
    let count = alone_with_the_master(1, || node(1));
    println!("{count} of 56 only at their own rate");
    assert!(count <= 2);
}

#[test]
fn a_node_without_acknowledges_stays_at_its_rate_and_answers_at_once() {
    let bit_rate = BitRate::Kbit125;
    let board = board_with(1, settings(1, bit_rate).with_heartbeat_ms(100));
    let mut rig = ImageRig::new(bit_rate, [board]);
    rig.network.adapter_mut(rig.master).close();
    let since = rig.network.now();
    rig.network.run_for(Time::from_s(60));
    assert_eq!(rig.bit_rates(0, since), [], "missing acknowledges are no reason to listen");
    rig.network.adapter_mut(rig.master).open();
    all_reached("1 node without a neighbour for a minute", &mut rig, nodes(1));
}

#[test]
fn a_network_that_was_without_power_comes_back_at_its_rate() {
    let mut rig = four(BitRate::Kbit125, 1000);
    (0..4).for_each(|board| rig.network.power_off(board));
    rig.network.run_for(Time::from_s(2));
    (0..4).for_each(|board| power_on_at_any_rate(&mut rig, board));
    let since = rig.network.now();
    all_reached("4 nodes whose power failed", &mut rig, nodes(4));
    for board in 0..4 {
        let rates = rig.bit_rates(board, since);
        assert!(matches!(rates[..], [(_, 125_000)]), "set once: {rates:?}");
    }
}

#[test]
fn an_unstored_switch_ends_at_power_off_and_all_are_at_the_old_rate() {
    let mut rig = four(BitRate::Kbit125, 1000);
    rig.transmit_request("04 01");
    switch_over(&mut rig, BitRate::Kbit500, false);
    all_reached("4 nodes after a switch", &mut rig, nodes(4));
    (0..4).for_each(|board| rig.network.power_off(board));
    rig.set_master_bit_rate(BitRate::Kbit125);
    (0..4).for_each(|board| power_on_at_any_rate(&mut rig, board));
    all_reached("4 nodes whose power failed before 17", &mut rig, nodes(4));
}

#[test]
fn a_node_that_switched_alone_comes_back() {
    for heartbeat_ms in [1000, 0] {
        let mut rig = four(BitRate::Kbit250, heartbeat_ms);
        (0..3).for_each(|board| rig.network.power_off(board));
        rig.transmit_request("04 01");
        rig.transmit_request("13 00 00");
        rig.network.run_for(Time::from_ms(5));
        rig.transmit_request("15 0A 00");
        (0..3).for_each(|board| power_on_at_any_rate(&mut rig, board));
        let scenario = format!("1 of 4 switched alone, heartbeat {heartbeat_ms} ms");
        all_reached(&scenario, &mut rig, nodes(4));
    }
}

/// Nodes 1 to 3 switch from 125 to 500 kbit/s; node 4 has proven 125 kbit/s and stays in waiting state.
fn node_4_misses_the_switch(heartbeat_ms: u16) -> ImageRig {
    let mut rig = four(BitRate::Kbit125, heartbeat_ms);
    all_reached("4 nodes before a switch", &mut rig, nodes(4));
    rig.network.power_off(3);
    rig.transmit_request("04 01");
    rig.power_on(3);
    assert!(reach(&mut rig, nodes(4), LIMIT).is_some());
    switch_over(&mut rig, BitRate::Kbit500, true);
    rig
}

#[test]
fn a_node_that_missed_the_switch_is_reached_after_its_power_was_switched() {
    for heartbeat_ms in [1000, 0] {
        let mut rig = node_4_misses_the_switch(heartbeat_ms);
        assert_eq!(reach(&mut rig, nodes(4), Time::from_s(5)), None, "it stays where it was");
        rig.network.power_off(3);
        power_on_at_any_rate(&mut rig, 3);
        let scenario = format!("1 of 4 missed the switch, heartbeat {heartbeat_ms} ms");
        all_reached(&scenario, &mut rig, nodes(4));
    }
}

#[test]
fn a_configured_board_joins_a_busy_network_of_another_rate() {
    for (own, theirs) in [
        (BitRate::Kbit1000, BitRate::Kbit125),
        (BitRate::Kbit500, BitRate::Kbit10),
        (BitRate::Kbit20, BitRate::Kbit250),
        (BitRate::Kbit125, BitRate::Kbit1000),
    ] {
        let board = board_with(0, settings(0x40, own).with_heartbeat_ms(100));
        let mut rig = ImageRig::new(theirs, [board]);
        let others = others(&mut rig, theirs);
        talk(&mut rig, others, Time::from_s(6));
        rig.collect(Time::from_ms(200));
        // A guest that is on a visit to its home misses a request.
        assert!(answers(&mut rig) || answers(&mut rig), "{own:?} among {theirs:?}");
    }
}

#[test]
fn a_new_board_is_found_by_a_master_at_any_rate() {
    for bit_rate in BitRate::ALL.into_iter().filter(|&rate| rate != DEFAULT_BIT_RATE) {
        let mut rig = ImageRig::new(bit_rate, [blank_board(0)]);
        wait_until_acknowledged(&mut rig);
        assert_eq!(rig.lss("4C"), ["50"], "{bit_rate:?}");
    }
}
