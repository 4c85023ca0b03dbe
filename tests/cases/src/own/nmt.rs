//! Own NMT 01..07: NMT commands, and the heartbeats that a device watches (CiA 301, 7.2.8 and 7.3.2).

use super::process_data::expect_codes;
use crate::{
    Bench, Case, Command, Group, Step, emergency,
    heartbeat::{
        CONSUMER_MS, OPERATIONAL, STOPPED, check_state, consumer, consumers, is_life_error,
        producer_of, set_producer,
    },
    ms,
};

pub const GROUP: Group = Group {
    name: "Own NMT",
    prepare: |bench| {
        bench.needs((0x1017, 0))?;
        bench.restore()
    },
    cases: CASES,
};

const CASES: &[Case] = &[
    Case::new(
        "An NMT command that is unknown, too short or too long, or for another has no effect",
        no_command,
    ),
    Case::new("A missing heartbeat is over with that of its own node", |bench| {
        let &[first, second, ..] = &consumers(bench)?[..] else {
            return bench.skip("the EDS has only one consumer in 1016h");
        };
        let (node, other) = (watch(bench, first)?, watch(bench, second)?);
        beat(bench, node)?;
        beat(bench, other)?;
        for _ in 0..3 {
            bench.pass(ms(400))?;
            beat(bench, other)?;
        }
        expect_codes(bench, &[], |bench| beat(bench, other))?;
        let register = bench.number((0x1001, 0))?;
        bench.check(register != 0, "an error in 1001h")?;
        expect_codes(bench, &[0], |bench| beat(bench, node))
    }),
    Case::new(
        "A boot-up is the first heartbeat of its node, a frame of two bytes is none",
        |bench| {
            let node = watch_first(bench)?;
            let cob_id = 0x700 + u16::from(node);
            bench.send(cob_id, &[0])?;
            bench.pass(ms(600))?;
            bench.send(cob_id, &[5, 5])?;
            let messages = emergency::messages(bench, ms(600))?;
            bench.check(messages.iter().any(is_life_error), "8130h, a second after the boot-up")
        },
    ),
    Case::new("The state that a missing heartbeat leads to is told at once", |bench| {
        let node = watch_first(bench)?;
        set_producer(bench, 30_000)?;
        bench.nmt(Command::Start)?;
        beat(bench, node)?;
        let cob_id = 0x700 + u16::from(bench.node);
        let frames = bench.collect(ms(1_100) + bench.jitter, cob_id)?;
        let is_told = frames.iter().any(|(_, frame)| frame.data() == [127]);
        bench.check(is_told, format!("{cob_id:03X} 7F within 100 ms"))
    }),
    Case::new("Stopped: a missing heartbeat is signalled when the state ends", |bench| {
        let node = watch_first(bench)?;
        beat(bench, node)?;
        bench.nmt(Command::Stop)?;
        expect_codes(bench, &[], |bench| bench.pass(ms(1_500)))?;
        expect_codes(bench, &[0x8130], |bench| bench.nmt(Command::EnterPreOperational))
    }),
    Case::new("1029h sub 1 = 2: the message that tells the cause leaves all the same", |bench| {
        bench.needs((0x1029, 1))?;
        bench.write((0x1029, 1), &[2])?;
        let node = watch_first(bench)?;
        set_producer(bench, 100)?;
        beat(bench, node)?;
        expect_codes(bench, &[0x8130], |bench| bench.pass(ms(1_500)))?;
        check_state(bench, STOPPED)
    }),
    Case::new("Reset communication ends the watch and its error", |bench| {
        let node = watch_first(bench)?;
        beat(bench, node)?;
        bench.pass(ms(1_500))?;
        expect_codes(bench, &[0], |bench| bench.reset(Command::ResetCommunication))?;
        beat(bench, node)?;
        expect_codes(bench, &[], |bench| bench.pass(ms(1_500)))
    }),
];

fn no_command(bench: &mut Bench) -> Step {
    let (own, other) = (bench.node, if bench.node == 1 { 2 } else { 1 });
    set_producer(bench, 100)?;
    bench.nmt(Command::Start)?;
    let commands = [0, 3, 4, 127, 131, 255].map(|command| vec![command, own]);
    let known = [2, 128, 129, 130];
    let of_others = known.map(|command| vec![command, other]);
    let lengths = [0, 1, 3, 8];
    let of_other_length = known.into_iter().flat_map(|command| {
        lengths.map(|length| [command, own, 0, 0, 0, 0, 0, 0][..length].to_vec())
    });
    let ignored = commands.into_iter().chain(of_others).chain(of_other_length);
    for data in ignored.collect::<Vec<_>>() {
        bench.send(0x000, &data)?;
        bench.pass(ms(10))?;
    }
    check_state(bench, OPERATIONAL)?;
    bench.nmt(Command::Stop)?;
    bench.send(0x000, &[1, other])?;
    bench.send(0x000, &[3, own])?;
    bench.send(0x000, &[1, own, 0])?;
    check_state(bench, STOPPED)
}

/// Has a producer watched by this sub-index of 1016h, for a second; returns its node-ID.
fn watch(bench: &mut Bench, sub_index: u8) -> Step<u8> {
    let node = producer_of(bench, sub_index);
    bench.write((0x1016, sub_index), &consumer(node, CONSUMER_MS))?;
    Ok(node)
}

fn watch_first(bench: &mut Bench) -> Step<u8> {
    let first = consumers(bench)?[0];
    watch(bench, first)
}

/// Sends the heartbeat of a node.
fn beat(bench: &mut Bench, node: u8) -> Step {
    bench.send(0x700 + u16::from(node), &[127])
}
