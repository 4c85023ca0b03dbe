//! The sessions that the image must pass on every chip.

use std::panic::{self, AssertUnwindSafe};

use canopen_node::{BitRate, BitRateSetting};
use emulator::{
    Time,
    can::{Adapter, Frame, Id},
    chip::ResetCause,
};
use lss_master::Fastscan;

use crate::{
    boards::{Variant, serial_number},
    frames,
    image_rig::{ImageRig, settings},
    power_cut::image::Session as PowerCuts,
    random::Random,
    wire::bit_per_s,
};

/// The time that a node may need to join the rig, or to change to another rate.
pub const AWAY: Time = Time::from_s(3);

/// The time for a rescue, and for a detection on a rig with a frame a second.
const SEARCH: Time = Time::from_s(10);
/// The time for a recovery after a foreign node has left.
const RECOVERY: Time = Time::from_s(5);

const OTHER_RATES: [BitRate; 4] =
    [BitRate::Kbit1000, BitRate::Kbit10, BitRate::Kbit800, BitRate::Kbit250];

/// A session; it panics at the first difference.
pub type Session = fn(&Variant);

/// Runs a part of a session; the error is the message of its panic.
pub fn outcome<T>(session: impl FnOnce() -> T) -> anyhow::Result<T> {
    panic::catch_unwind(AssertUnwindSafe(session)).map_err(|panic| {
        let text = panic.downcast_ref::<String>().cloned();
        let text = text.or(panic.downcast_ref::<&str>().map(ToString::to_string));
        anyhow::Error::msg(text.unwrap_or_default())
    })
}

/// The sessions by name.
pub fn all(quick: bool) -> Vec<(&'static str, Session)> {
    let mut sessions: Vec<(&'static str, Session)> = vec![
        ("boot", boot),
        ("configuration", |variant| configure(variant, 1)),
        ("switch", |variant| switch(variant, &[BitRate::Kbit500, BitRate::Kbit125], 50)),
        ("detection under load", |variant| {
            // 90 %.
            let every_bits = 122 * 10 / 9;
            detect(variant, BitRate::Kbit500, every_bits);
            detect(variant, BitRate::Kbit50, every_bits);
        }),
        ("bus-off", bus_off),
        ("reset", reset),
    ];
    if !quick {
        sessions.push(("configuration of three", |variant| configure(variant, 3)));
        sessions.push(("switch without delay", |variant| switch(variant, &OTHER_RATES, 0)));
        sessions.push(("detection", |variant| {
            // A frame a second.
            detect(variant, BitRate::Kbit1000, 1_000_000);
            detect(variant, BitRate::Kbit125, 125_000);
        }));
        sessions.push(("rescue", rescue));
        sessions.push(("power cuts", cut_power));
    }
    sessions
}

/// A node with a node-ID boots up and sends heartbeats, also without answers.
fn boot(variant: &Variant) {
    let stored = settings(0x40, BitRate::Kbit1000).with_heartbeat_ms(100);
    let mut rig = ImageRig::new(BitRate::Kbit1000, [variant.board(0, Some(stored))]);
    rig.expect("740: 00", AWAY);
    rig.expect("740: 7F", Time::from_ms(110));

    let mut rig = ImageRig::new(BitRate::Kbit125, [variant.board(0, None)]);
    rig.reach("4C", "50", AWAY);
}

/// New boards are found one after the other by Fastscan, get a node-ID and store it.
fn configure(variant: &Variant, boards: u8) {
    let new = (0..boards).map(|number| variant.board(number.into(), None));
    let mut rig = ImageRig::new(BitRate::Kbit125, new);
    for _ in 0..boards {
        rig.reach("4C", "50", AWAY);
    }
    for node_id in 1..=boards {
        let found = rig.carry_out(Fastscan::new()).expect("nobody is found");
        let mut serial_numbers = (0..boards.into()).map(serial_number);
        assert!(serial_numbers.any(|serial| serial == found.serial_number), "{found:X?}");
        rig.ask(&format!("5E, 11 {node_id:02X}, 17"), "5E FF, 11 00, 17 00");
        rig.send("04 00");
        rig.expect(&format!("70{node_id}: 00"), Time::from_ms(20));
    }
    let answers = rig.lss("4C");
    assert!(answers.0.is_empty(), "4C is answered by a configured node: {answers:?}");
}

/// Two nodes are switched from rate to rate and answer at each.
fn switch(variant: &Variant, rates: &[BitRate], delay_ms: u8) {
    let nodes = [1, 2].map(|id| {
        variant.board(id, Some(settings(id as u8, BitRate::Kbit125).with_heartbeat_ms(100)))
    });
    let mut rig = ImageRig::new(BitRate::Kbit125, nodes);
    for id in 1..=2 {
        rig.expect(&format!("70{id}: 7F"), AWAY);
    }
    rig.send("04 01");
    for &rate in rates.iter().filter(|rate| variant.carries(**rate)) {
        rig.ask(&format!("13 00 {:02X}", rate.index()), "13 00");
        rig.send(&format!("15 {delay_ms:02X} 00"));
        rig.network.run_for(Time::from_ms(15 + u64::from(delay_ms)));
        rig.set_master_bit_rate(rate);
        rig.network.run_for(Time::from_ms(u64::from(delay_ms) + 1));
        rig.reach("5A", "5A", AWAY);
        for id in 1..=2 {
            rig.expect(&format!("70{id}: 7F"), AWAY);
        }
    }
}

/// A node that detects the rate joins a bus where two others exchange a frame every `every_bits` bits.
fn detect(variant: &Variant, rate: BitRate, every_bits: u64) {
    let board = variant.board(0, Some(settings(5, BitRateSetting::Automatic)));
    let mut rig = ImageRig::new(rate, [board]);
    let other = rig.network.add_adapter(Adapter::new(bit_per_s(rate)));
    let every = Time::from_ps(every_bits * 1_000_000_000_000 / u64::from(bit_per_s(rate)));
    let until = rig.network.now() + SEARCH;
    let mut count = 0_u64;
    while rig.network.now() < until {
        count += 1;
        let data = count.wrapping_mul(0x9E37_79B9_7F4A_7C15).to_le_bytes();
        rig.network.send(other, Frame::data(Id::Standard(0x181), &data));
        rig.network.run_for(every);
        if rig.collect(Time::ZERO).0.contains(&frames::of_node("705: 00")) {
            return;
        }
    }
    panic!("{} kbit/s is not detected", rate.kbit_per_s());
}

/// A foreign node drives a node bus-off; the node recovers soon after the other has left.
fn bus_off(variant: &Variant) {
    let stored = settings(5, BitRate::Kbit500).with_heartbeat_ms(20);
    let mut rig = ImageRig::new(BitRate::Kbit500, [variant.board(0, Some(stored))]);
    rig.expect("705: 00", AWAY);
    let foreign = rig.add_disturber();
    rig.disturb(foreign, Id::Standard(0x7FF), Time::from_ms(1), Time::from_ms(300));
    rig.send("04 01");
    rig.reach("5E", "5E 05", RECOVERY);
    rig.expect("705: 7F", AWAY);
}

/// NMT reset node and reset communication.
fn reset(variant: &Variant) {
    let mut rig =
        ImageRig::new(BitRate::Kbit500, [variant.board(0, Some(settings(5, BitRate::Kbit500)))]);
    rig.expect("705: 00", AWAY);
    rig.send("000: 82 05");
    rig.expect("705: 00", Time::from_ms(20));
    rig.send("000: 81 05");
    rig.network.allow_reset(0, ResetCause::Software);
    rig.expect("705: 00", AWAY);
}

/// A node with another stored rate joins the bus of the master and a third node that sends.
fn rescue(variant: &Variant) {
    let rates = [BitRate::Kbit125, BitRate::Kbit500];
    let boards = rates.map(|rate| {
        variant.board(rate as usize, Some(settings(rate.index(), rate).with_heartbeat_ms(1000)))
    });
    let mut rig = ImageRig::new(BitRate::Kbit500, boards);
    // A guest speaks only when it is spoken to.
    rig.reach("604: 40 00 10 00 00 00 00 00", "704: 00", SEARCH);
}

/// The power fails in each flash operation of two stores; the next power-ons find the settings from before or after.
fn cut_power(variant: &Variant) {
    let outcome = PowerCuts::Full.run(variant, &mut Random::from_seed(0));
    outcome.unwrap_or_else(|error| panic!("{error:#}"));
}
