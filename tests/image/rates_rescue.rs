//! Networks of four release images, some of them at another bit rate: the master reaches every node.

use crate::rig::*;

/// The interval at which the master asks the missing nodes.
const POLL: Time = Time::from_ms(100);
/// The limit for the search of a node at a wrong rate.
const SEARCH: Time = Time::from_s(5);

/// Nodes 1 to 4 and the master at `bus`, but node 4 at `of_node_4`.
fn four(bus: BitRate, of_node_4: BitRate, heartbeat_ms: u16) -> ImageRig {
    let with = |number| {
        let bit_rate = if number == 4 { of_node_4 } else { bus };
        board_with(number, settings(number, bit_rate).with_heartbeat_ms(heartbeat_ms))
    };
    ImageRig::new(bus, (1..=4).map(with))
}

/// Makes the master ask all nodes in turn until each has answered.
fn assert_all_reached(rig: &mut ImageRig, limit: Time, what: &str) {
    rig.collect(Time::ZERO);
    let since = rig.network.now();
    let mut missing: Vec<u8> = (1..=4).collect();
    for turn in 0.. {
        if missing.is_empty() {
            break;
        }
        assert!(rig.network.now() < since + limit, "{what}: nodes {missing:?} are not reached");
        if rig.network.adapter_mut(rig.master).unsent() == 0 {
            rig.queue(&sdo::request(missing[turn % missing.len()], "40 00 10 00"));
        }
        for answer in rig.collect(POLL).0 {
            missing.retain(|&id| answer.cob_id() != 0x580 + u16::from(id));
        }
    }
    println!("{what:<62} {:>6} ms", rig.network.now() - since);
}

#[test]
fn a_node_with_another_rate_stored_is_reached_whenever_it_is_switched_on() {
    for (own, bus) in [
        (BitRate::Kbit1000, BitRate::Kbit10),
        (BitRate::Kbit1000, BitRate::Kbit800),
        (BitRate::Kbit800, BitRate::Kbit1000),
        (BitRate::Kbit250, BitRate::Kbit125),
        (BitRate::Kbit125, BitRate::Kbit250),
        (BitRate::Kbit125, BitRate::Kbit1000),
        (BitRate::Kbit10, BitRate::Kbit1000),
        (BitRate::Kbit1000, BitRate::Kbit125),
        (BitRate::Kbit500, BitRate::Kbit20),
        (BitRate::Kbit50, BitRate::Kbit250),
    ] {
        for (heartbeat_ms, is_late) in [(1000, false), (0, false), (1000, true)] {
            let mut rig = four(bus, own, heartbeat_ms);
            if is_late {
                rig.network.power_off(3);
                rig.network.run_for(Time::from_ms(100));
                rig.network.power_on(3);
            }
            let what = format!("{own:?} among {bus:?}, heartbeat {heartbeat_ms}, late: {is_late}");
            assert_all_reached(&mut rig, SEARCH, &what);
        }
    }
}

#[test]
fn an_unstored_switch_ends_at_power_off_and_all_are_at_the_old_rate() {
    let mut rig = four(BitRate::Kbit125, BitRate::Kbit125, 1000);
    rig.lss("04 01, 13 00 02");
    let end = rig.activate(50);
    rig.network.run_until(end + Time::from_ms(50));
    rig.set_master_bit_rate(BitRate::Kbit500);
    rig.network.run_until(end + Time::from_ms(101));
    assert_all_reached(&mut rig, Time::from_s(1), "4 nodes after a switch");
    (0..4).for_each(|board| rig.network.power_off(board));
    rig.set_master_bit_rate(BitRate::Kbit125);
    rig.network.run_for(Time::from_s(2));
    let since = rig.network.now();
    (0..4).for_each(|board| rig.network.power_on(board));
    assert_all_reached(&mut rig, Time::from_s(1), "4 nodes whose power failed before 17");
    for board in 0..4 {
        let rates = rig.bit_rates(board, since);
        assert!(matches!(rates[..], [(_, 125_000)]), "set once: {rates:?}");
    }
}

#[test]
fn a_node_that_switched_alone_comes_back_when_its_trust_of_30_s_is_over() {
    for heartbeat_ms in [1000, 0] {
        let mut rig = four(BitRate::Kbit250, BitRate::Kbit250, heartbeat_ms);
        (0..3).for_each(|board| rig.network.power_off(board));
        rig.lss("04 01, 13 00 00");
        rig.activate(10);
        (0..3).for_each(|board| rig.network.power_on(board));
        let what = format!("1 of 4 switched alone, heartbeat {heartbeat_ms} ms");
        assert_all_reached(&mut rig, Time::from_s(30) + SEARCH, &what);
    }
}
