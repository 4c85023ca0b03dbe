//! The sessions that the image must pass on every chip.

use anyhow::{Context, bail, ensure};
use emulator::{
    Time,
    can::{Adapter, Frame, Id},
    chip::{PowerCut, ResetCause},
};
use lss_master::Fastscan;
use lss_slave::{BitRate, BitRateSetting, NodeId, Settings};

use super::bus::{AWAY, Variant};
use testkit::{boards, image_rig::bit_per_s};

/// The time for a rescue, and for a detection on a bus with a frame a second.
const SEARCH: Time = Time::from_s(10);
/// The time for a recovery after a foreign node has left.
const RECOVERY: Time = Time::from_s(5);

const OTHER_RATES: [BitRate; 4] =
    [BitRate::Kbit1000, BitRate::Kbit10, BitRate::Kbit800, BitRate::Kbit250];

/// The time from 17 to its answer.
const STORE: Time = Time::from_ms(20);

pub type Session = fn(&Variant) -> anyhow::Result<()>;

/// The sessions by name.
pub fn all(quick: bool) -> Vec<(&'static str, Session)> {
    let mut sessions: Vec<(&'static str, Session)> = vec![
        ("boot", boot),
        ("configuration", |variant| configure(variant, 1)),
        ("switch", |variant| switch(variant, &[BitRate::Kbit500, BitRate::Kbit125], 50)),
        ("detection under load", detect_under_load),
        ("bus-off", bus_off),
        ("reset", reset),
    ];
    if !quick {
        sessions.push(("configuration of three", |variant| configure(variant, 3)));
        sessions.push(("switch without delay", |variant| switch(variant, &OTHER_RATES, 0)));
        sessions.push(("detection", detect));
        sessions.push(("rescue", rescue));
        sessions.push(("power cuts", cut_power));
    }
    sessions
}

fn settings(node_id: u8, bit_rate: impl Into<BitRateSetting>, heartbeat_ms: u16) -> Settings {
    Settings::new(bit_rate.into())
        .with_node_id(NodeId::new(node_id))
        .with_heartbeat_ms(heartbeat_ms)
}

/// A node with a node-ID boots up and sends heartbeats, also without answers.
fn boot(variant: &Variant) -> anyhow::Result<()> {
    let stored = settings(0x40, BitRate::Kbit1000, 100);
    let mut bus = variant.bus(BitRate::Kbit1000, [variant.board(0, Some(stored))]);
    bus.hear("740: 00", AWAY)?;
    bus.hear("740: 7F", Time::from_ms(110))?;
    bus.check()?;

    let mut bus = variant.bus(BitRate::Kbit125, [variant.board(0, None)]);
    bus.reach("4C", "50", AWAY)?;
    bus.check()
}

/// New boards are found one after the other by Fastscan, get a node-ID and store it.
fn configure(variant: &Variant, boards: u8) -> anyhow::Result<()> {
    let new = (0..boards).map(|number| variant.board(number.into(), None));
    let mut bus = variant.bus(BitRate::Kbit125, new);
    for _ in 0..boards {
        bus.reach("4C", "50", AWAY)?;
    }
    for node_id in 1..=boards {
        let found = bus.carry_out(Fastscan::new())?.context("nobody is found")?;
        let mut serial_numbers = (0..boards.into()).map(boards::serial_number);
        ensure!(serial_numbers.any(|serial| serial == found.serial_number), "{found:X?}");
        bus.ask("5E", "5E FF")?;
        bus.ask(&format!("11 {node_id:02X}"), "11 00")?;
        bus.ask("17", "17 00")?;
        bus.send("04 00");
        bus.hear(&format!("70{node_id}: 00"), Time::from_ms(20))?;
    }
    ensure!(!bus.is_answered("4C"), "4C is answered by a configured node");
    bus.check()
}

/// Two nodes are switched from rate to rate and answer at each.
fn switch(variant: &Variant, rates: &[BitRate], delay_ms: u8) -> anyhow::Result<()> {
    let nodes = [1, 2].map(|id| variant.board(id, Some(settings(id as u8, BitRate::Kbit125, 100))));
    let mut bus = variant.bus(BitRate::Kbit125, nodes);
    for id in 1..=2 {
        bus.hear(&format!("70{id}: 7F"), AWAY)?;
    }
    bus.send("04 01");
    for &rate in rates {
        bus.ask(&format!("13 00 {:02X}", rate.index()), "13 00")?;
        bus.send(&format!("15 {delay_ms:02X} 00"));
        bus.run_ms(15 + u64::from(delay_ms));
        bus.set_master_rate(rate);
        bus.run_ms(u64::from(delay_ms) + 1);
        bus.reach("5A", "5A", AWAY)?;
        for id in 1..=2 {
            bus.hear(&format!("70{id}: 7F"), AWAY)?;
        }
    }
    bus.check()
}

/// Detection at 90 % load.
fn detect_under_load(variant: &Variant) -> anyhow::Result<()> {
    for rate in [BitRate::Kbit500, BitRate::Kbit50] {
        detect_at(variant, rate, 122 * 10 / 9)?;
    }
    Ok(())
}

/// Detection with a frame a second.
fn detect(variant: &Variant) -> anyhow::Result<()> {
    for rate in [BitRate::Kbit1000, BitRate::Kbit125] {
        detect_at(variant, rate, u64::from(bit_per_s(rate)))?;
    }
    Ok(())
}

/// A node that detects the rate joins a bus where two others exchange a frame every `every_bits` bits.
fn detect_at(variant: &Variant, rate: BitRate, every_bits: u64) -> anyhow::Result<()> {
    let board = variant.board(0, Some(settings(5, BitRateSetting::Automatic, 0)));
    let mut bus = variant.bus(rate, [board]);
    let other = bus.network.add_adapter(Adapter::new(bit_per_s(rate)));
    let every = Time::from_ps(every_bits * 1_000_000_000_000 / u64::from(bit_per_s(rate)));
    let until = bus.network.now() + SEARCH;
    let mut count = 0_u64;
    while bus.network.now() < until {
        count += 1;
        let data = count.wrapping_mul(0x9E37_79B9_7F4A_7C15).to_le_bytes();
        bus.network.send(other, Frame::data(Id::Standard(0x181), &data));
        bus.network.run_for(every);
        while let Some((_, frame)) = bus.network.receive(bus.master) {
            if frame == Frame::data(Id::Standard(0x705), &[0]) {
                return bus.check();
            }
        }
    }
    bail!("{} kbit/s is not detected", rate.kbit_per_s())
}

/// A foreign node drives a node bus-off; the node recovers soon after the other has left.
fn bus_off(variant: &Variant) -> anyhow::Result<()> {
    let mut bus =
        variant.bus(BitRate::Kbit500, [variant.board(0, Some(settings(5, BitRate::Kbit500, 20)))]);
    bus.hear("705: 00", AWAY)?;
    let foreign = bus.network.add_adapter(Adapter::new(333_000));
    bus.network.adapter_mut(bus.master).close();
    for _ in 0..300 {
        bus.network.send(foreign, Frame::data(Id::Standard(0x7FF), &[0xA5; 8]));
        bus.run_ms(1);
    }
    bus.network.adapter_mut(foreign).close();
    bus.network.adapter_mut(bus.master).open();
    bus.send("04 01");
    bus.reach("5E", "5E 05", RECOVERY)?;
    bus.hear("705: 7F", AWAY)?;
    bus.check()
}

/// NMT reset node and reset communication.
fn reset(variant: &Variant) -> anyhow::Result<()> {
    let mut bus =
        variant.bus(BitRate::Kbit500, [variant.board(0, Some(settings(5, BitRate::Kbit500, 0)))]);
    bus.hear("705: 00", AWAY)?;
    bus.send("000: 82 05");
    bus.hear("705: 00", Time::from_ms(20))?;
    bus.send("000: 81 05");
    bus.resets[0].push(ResetCause::Software);
    bus.hear("705: 00", AWAY)?;
    bus.check()
}

/// A node with another stored rate joins the bus of the master and a third node that sends.
fn rescue(variant: &Variant) -> anyhow::Result<()> {
    let rates = [BitRate::Kbit125, BitRate::Kbit500];
    let boards =
        rates.map(|rate| variant.board(rate as usize, Some(settings(rate.index(), rate, 1000))));
    let mut bus = variant.bus(BitRate::Kbit500, boards);
    bus.hear("704: 00", SEARCH)?;
    bus.hear("704: 7F", SEARCH)?;
    bus.check()
}

/// The power fails in each flash operation of a store; the next power-on finds the settings from before or after.
fn cut_power(variant: &Variant) -> anyhow::Result<()> {
    const SEEDS: u64 = 2;
    let old = settings(4, BitRate::Kbit500, 0);
    let mut operation = 0;
    loop {
        for seed in 0..SEEDS {
            let board = variant.board(0, Some(old));
            let mut bus = variant.bus(BitRate::Kbit500, [board]);
            bus.hear("704: 00", AWAY)?;
            // The start may have programmed something.
            let before = bus.network.board(0).chip().flash().operation_times().len() as u64;
            let cut = PowerCut { operation: before + operation, seed };
            bus.network.board(0).chip().flash_mut().cut_power(cut);
            bus.send("04 01");
            bus.ask("11 05", "11 00")?;
            bus.send("17");
            let is_stored = bus.hear("17 00", STORE).is_ok();
            if bus.network.board(0).is_powered() {
                ensure!(is_stored, "17 is not answered");
                ensure!(operation > 0, "no flash operation in a store");
                return bus.check();
            }
            // Twice: settings found once must be found again.
            let mut node_ids = Vec::new();
            for _ in 0..2 {
                bus.network.power_off(0);
                bus.run_ms(10);
                bus.power_on(0);
                bus.run_ms(1_000);
                bus.send("04 01");
                node_ids.push(bus.inquire("5E")? & 0xFF);
            }
            let is_kept = node_ids[0] == node_ids[1] && [4, 5].contains(&node_ids[0]);
            ensure!(
                is_kept,
                "cut in operation {operation}: node-IDs {node_ids:?} at two power-ons"
            );
            bus.check()?;
        }
        operation += 1;
    }
}
