//! Store configuration: 17 (CiA 305).

use super::{
    Feature, LONG_PATIENCE,
    bit_rate::{needs_switch, other_rate},
    configured, with_stored_values,
};
use crate::{Bench, Case, Group, Step, ms};

pub const GROUP: Group = Group {
    name: "LSS store",
    prepare: |bench| {
        bench.needs_feature(Feature::Store)?;
        configured(bench)
    },
    cases: CASES,
};

const CASES: &[Case] = &[
    Case::new("17 is answered 17 00, also when the same values are stored already", |bench| {
        with_stored_values(bench, |bench| {
            bench.lss(&[0x17], &[0x17])?;
            bench.lss(&[0x17], &[0x17])
        })
    }),
    Case::new("17 makes nothing active", |bench| {
        with_stored_values(bench, |bench| {
            let active = bench.reach()?;
            bench.lss(&[0x11, OTHER], &[0x11])?;
            bench.lss(&[0x17], &[0x17])?;
            bench.lss(&[0x5E], &[0x5E, active])
        })
    }),
    Case::new(
        "What 17 00 has confirmed outlasts a cut of the supply right after the answer",
        |bench| {
            with_stored_values(bench, |bench| {
                bench.lss(&[0x11, OTHER], &[0x11])?;
                bench.lss(&[0x17], &[0x17])?;
                bench.cut_power(ms(100))?;
                let active = bench.reach()?;
                bench.check(active == OTHER, format!("5E {OTHER:02X} after power-on"))
            })
        },
    ),
    Case::new("A store that fails is answered 17 02, and the old values stay", failing),
    Case::new("17 stores the pending bit rate: reset node makes it active", |bench| {
        store_rate(bench, |bench| bench.restart())
    }),
    Case::new("17 stores the pending bit rate for the next power-on", |bench| {
        store_rate(bench, |bench| bench.cut_power(ms(500)))
    }),
];

/// A node-ID that no case has stored otherwise.
const OTHER: u8 = 0x53;
/// What only a laboratory can do.
const FAIL: &str = "make a store fail";

fn failing(bench: &mut Bench) -> Step {
    bench.lab(FAIL)?;
    with_stored_values(bench, |bench| {
        let stored = bench.reach()?;
        bench.lss(&[0x11, OTHER], &[0x11])?;
        bench.note("the storage medium fails from here");
        bench.lab(FAIL)?.fail_stores(true);
        let outcome = bench.lss(&[0x17], &[0x17, 2]);
        bench.lab(FAIL)?.fail_stores(false);
        outcome?;
        bench.lss(&[0x5E], &[0x5E, stored])?;
        bench.restart()?;
        let active = bench.reach()?;
        bench.check(active == stored, format!("5E {stored:02X} after reset node"))
    })
}

fn store_rate(bench: &mut Bench, start: fn(&mut Bench) -> Step) -> Step {
    needs_switch(bench)?;
    with_stored_values(bench, |bench| {
        let (old, new) = (bench.lss.rate, other_rate(bench));
        bench.lss(&[0x13, 0, new.index()], &[0x13])?;
        bench.lss(&[0x17], &[0x17])?;
        bench.inquire_node_id()?;
        start(bench)?;
        bench.set_rate(new)?;
        let is_there = bench.find(LONG_PATIENCE)?.is_some();
        bench.check(is_there, format!("an answer at {new}"))?;
        bench.lss(&[0x13, 0, old.index()], &[0x13])?;
        bench.lss(&[0x17], &[0x17])?;
        bench.restart()
    })
}
