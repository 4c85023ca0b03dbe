//! Heartbeat 01..07: the heartbeat producer and consumer (CiA 301, 7.2.8.3.2.2).

use std::time::Duration;

use canopen_node::Frame;

use crate::{Bench, Case, Command, Group, Step, abort, emergency, ms};

pub const GROUP: Group =
    Group { name: "Heartbeat", prepare: |bench| bench.restore(), cases: CASES };

const CASES: &[Case] = &[
    Case::new("1017h takes 0", |bench| {
        bench.needs((0x1017, 0))?;
        set_producer(bench, 0)
    }),
    Case::new("The heartbeat comes every 100 ms", producer),
    Case::new("1017h = 0 ends the heartbeat", no_producer),
    Case::new("1016h refuses a producer that another sub-index has", same_producer_twice),
    Case::new("No emergency while the heartbeats of a producer come in time", in_time),
    Case::new("An emergency when the heartbeats of a producer come too late", too_late),
    Case::new("A missing heartbeat ends NMT state operational, and is signalled", |bench| {
        lost(bench, 127)
    })
    .with_remark("1029h sub 1 is 0, its default: the device enters NMT state pre-operational."),
];

/// The heartbeats of our producer, and the consumer's time, both in ms.
const BEAT: Duration = ms(500);
pub const CONSUMER_MS: u32 = 1_000;
/// The error code of a missing heartbeat.
const LIFE_ERROR: u16 = 0x8130;

/// NMT states, as in a heartbeat.
pub const STOPPED: u8 = 4;
pub const OPERATIONAL: u8 = 5;

/// Writes 1017h.
pub fn set_producer(bench: &mut Bench, interval_ms: u16) -> Step {
    bench.write((0x1017, 0), &interval_ms.to_le_bytes())
}

/// Waits for two heartbeats, which must report this NMT state.
pub fn check_state(bench: &mut Bench, state: u8) -> Step {
    let cob_id = 0x700 + u16::from(bench.node);
    for _ in 0..2 {
        let beat = bench.wait_for(ms(2_000), |frame| frame.cob_id() == cob_id)?;
        let is_right = beat.is_some_and(|(_, frame)| frame.data() == [state]);
        bench.check(is_right, format!("{cob_id:03X} {state:02X}: the heartbeat"))?;
    }
    Ok(())
}

fn own(bench: &mut Bench, span: Duration) -> Step<Vec<(Duration, Frame)>> {
    let cob_id = 0x700 + u16::from(bench.node);
    bench.collect(span, cob_id)
}

fn producer(bench: &mut Bench) -> Step {
    bench.needs((0x1017, 0))?;
    set_producer(bench, 100)?;
    let beats = own(bench, ms(10_000))?;
    bench.check((98..=102).contains(&beats.len()), "100 heartbeats in 10 s")?;
    let is_right = beats.iter().all(|(_, frame)| frame.data() == [127]);
    bench.check(is_right, "7F, pre-operational, in each heartbeat")
}

fn no_producer(bench: &mut Bench) -> Step {
    bench.needs((0x1017, 0))?;
    set_producer(bench, 0)?;
    let beats = own(bench, ms(10_000))?;
    bench.check(beats.is_empty(), "no heartbeat in 10 s")
}

/// The sub-indices of 1016h; the case is skipped if there is none.
pub fn consumers(bench: &Bench) -> Step<Vec<u8>> {
    bench.needs((0x1016, 1))?;
    Ok(bench.eds.object(0x1016).map(|entry| entry.address.1).filter(|sub| *sub > 0).collect())
}

/// A value of 1016h.
pub fn consumer(node: u8, time_ms: u32) -> [u8; 4] {
    (u32::from(node) << 16 | time_ms).to_le_bytes()
}

/// A node-ID for the producer that a sub-index consumes, other than the device's.
pub fn producer_of(bench: &Bench, sub_index: u8) -> u8 {
    let node = sub_index % 126 + 1;
    if node == bench.node { 127 } else { node }
}

fn same_producer_twice(bench: &mut Bench) -> Step {
    let &[first, second, ..] = &consumers(bench)?[..] else {
        return bench.skip("the EDS has only one consumer in 1016h");
    };
    let value = consumer(producer_of(bench, first), CONSUMER_MS);
    bench.write((0x1016, first), &value)?;
    bench.refuses((0x1016, second), &value, &[abort::INCOMPATIBLE, abort::GENERAL])?;
    Ok(())
}

/// Sends `count` heartbeats of a node, pre-operational, one every `interval`; returns the emergency messages.
fn beat(bench: &mut Bench, node: u8, interval: Duration, count: usize) -> Step<Vec<Frame>> {
    let mut messages = Vec::new();
    for _ in 0..count {
        bench.send(0x700 + u16::from(node), &[127])?;
        messages.extend(emergency::messages(bench, interval)?);
    }
    Ok(messages)
}

pub fn is_life_error(message: &Frame) -> bool {
    emergency::code(message) == LIFE_ERROR
}

fn in_time(bench: &mut Bench) -> Step {
    for sub_index in consumers(bench)? {
        let node = producer_of(bench, sub_index);
        bench.write((0x1016, sub_index), &consumer(node, CONSUMER_MS))?;
        bench.nmt(Command::Start)?;
        let messages = beat(bench, node, BEAT, 10)?;
        bench.check(!messages.iter().any(is_life_error), "no emergency message 8130h")?;
        bench.write((0x1016, sub_index), &[0; 4])?;
    }
    Ok(())
}

fn too_late(bench: &mut Bench) -> Step {
    for sub_index in consumers(bench)? {
        let node = producer_of(bench, sub_index);
        bench.write((0x1016, sub_index), &consumer(node, CONSUMER_MS))?;
        // It is monitored from its first heartbeat on.
        let early = emergency::messages(bench, ms(2_000))?;
        bench.check(!early.iter().any(is_life_error), "no emergency before the first heartbeat")?;
        let messages = beat(bench, node, ms(2_000), 3)?;
        let count = messages.iter().filter(|message| is_life_error(message)).count();
        bench.check(count == 3, "an emergency message 8130h for each of three late heartbeats")?;
        bench.write((0x1016, sub_index), &[0; 4])?;
    }
    Ok(())
}

/// Lets the heartbeats of each producer end in NMT state operational: the error leads to this state, and is
/// signalled.
pub fn lost(bench: &mut Bench, state: u8) -> Step {
    bench.needs((0x1017, 0))?;
    for sub_index in consumers(bench)? {
        let node = producer_of(bench, sub_index);
        set_producer(bench, 200)?;
        bench.write((0x1016, sub_index), &consumer(node, CONSUMER_MS))?;
        bench.nmt(Command::Start)?;
        beat(bench, node, BEAT, 5)?;
        check_state(bench, OPERATIONAL)?;
        let messages = emergency::messages(bench, ms(2_000))?;
        // In NMT state stopped there are none.
        let is_signalled = state == STOPPED || messages.iter().any(is_life_error);
        bench.check(is_signalled, "an emergency message 8130h")?;
        check_state(bench, state)?;
        bench.nmt(Command::EnterPreOperational)?;
        bench.write((0x1016, sub_index), &[0; 4])?;
    }
    Ok(())
}
