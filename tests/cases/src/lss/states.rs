//! Switch state global and selective, the inquiries, and what is served in each state (CiA 305).

use super::configured;
use crate::{Bench, Case, Command, Group, Step, ms};

pub const GROUP: Group = Group { name: "LSS states", prepare: configured, cases: CASES };

const CASES: &[Case] = &[
    Case::new("04 01 leads to configuration and 04 00 to waiting, without an answer", |bench| {
        bench.play("waiting; 04 01 = -; configuration; 04 01 = -; configuration")?;
        bench.play("04 00 = -; waiting; 04 00 = -; waiting")
    }),
    Case::new("04 with any other mode changes nothing", |bench| {
        bench.play("04 02 = -; waiting; 04 80 = -; waiting; 04 FF = -; waiting")?;
        bench.play("04 01; 04 02 = -; configuration; 04 80 = -; 04 FF = -; configuration")
    }),
    Case::new(
        "40, 41, 42, 43 with the LSS address are answered 44 and lead to configuration",
        |bench| bench.play("40 V = -; 41 P = -; 42 R = -; 43 S = 44; configuration"),
    ),
    Case::new("A select that differs in one bit is not answered", other_addresses),
    Case::new("40 begins a select again", |bench| {
        bench.play("40 V; 41 P; 40 V; 41 P; 42 R; 43 S = 44; configuration")
    }),
    Case::new("A select in configuration is not answered", |bench| {
        bench.play("04 01; 40 V = -; 41 P = -; 42 R = -; 43 S = -; configuration")
    }),
    Case::new("5A, 5B, 5C and 5D are answered with the LSS address", |bench| {
        bench.play("04 01; 5A = 5A V; 5B = 5B P; 5C = 5C R; 5D = 5D S")
    }),
    Case::new("5E is answered with the active node-ID", |bench| bench.play("04 01; 5E = 5E NN")),
    Case::new(
        "11, 13, 15, 17 and the inquiries are neither answered nor obeyed in waiting",
        |bench| {
            bench.play(
                "11 MM = -; 13 00 04 = -; 15 = -; 17 = -; 5A = -; 5B = -; 5C = -; 5D = -; 5E = -",
            )?;
            // A switch would have silent delays.
            bench.play("15 F4 01 = -; 04 01; 5E = 5E NN; 04 00")?;
            bench.play("reset communication; boot-up NN")
        },
    ),
    Case::new("LSS is served in every NMT state", |bench| {
        NMT_STATES.into_iter().try_for_each(|command| {
            bench.nmt(command)?;
            bench.play("04 00; 40 V; 41 P; 42 R; 43 S = 44; 5E = 5E NN; 11 NN = 11")
        })
    }),
    Case::new("NMT start, stop and enter pre-operational leave configuration alone", |bench| {
        bench.enter()?;
        NMT_STATES.into_iter().try_for_each(|command| {
            bench.nmt(command)?;
            bench.expect_configuring()
        })
    }),
    Case::new("NMT reset communication leads to waiting", |bench| {
        reset(bench, Command::ResetCommunication)
    }),
    Case::new("NMT reset node leads to waiting", |bench| reset(bench, Command::ResetNode)),
    Case::new("A step that differs ends a select", |bench| {
        bench.play("40 V; 41 V; 41 P; 42 R; 43 S = -; waiting")
    }),
];

const NMT_STATES: [Command; 3] = [Command::Start, Command::Stop, Command::EnterPreOperational];

fn other_addresses(bench: &mut Bench) -> Step {
    let address: [u32; 4] = bench.address()?.into();
    for part in 0..4 {
        for bit in [0, 15, 16, 31] {
            let mut other = address;
            other[part] ^= 1 << bit;
            let is_selected = bench.select(other)?;
            bench.check(!is_selected, "another LSS address is not selected")?;
        }
    }
    bench.expect_waiting()
}

fn reset(bench: &mut Bench, command: Command) -> Step {
    bench.play("04 01; configuration")?;
    bench.nmt(command)?;
    // A device that has stored no node-ID sends no boot-up after reset node.
    bench.wait_for(ms(1_000), |frame| frame.cob_id() > 0x700 && frame.data() == [0])?;
    bench.expect_waiting()
}
