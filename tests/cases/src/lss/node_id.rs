//! Configure node-ID, and the way of a node-ID from pending to active and persistent (CiA 305).

use super::{Feature, NO_NODE_ID, configured, other_id, unconfigured, with_stored_values};
use crate::{Bench, Case, Group, Step, ms};

pub const GROUP: Group = Group { name: "LSS node-ID", prepare: configured, cases: CASES };

const CASES: &[Case] = &[
    Case::new("1 to 127 and 255 (none) are accepted", |bench| {
        bench.enter()?;
        (1..=127).chain([NO_NODE_ID]).try_for_each(|id| bench.lss(&[0x11, id], &[0x11]))
    }),
    Case::new("0 and 128 to 254 are refused with 1", |bench| {
        bench.enter()?;
        [0].into_iter().chain(128..=254).try_for_each(|id| bench.lss(&[0x11, id], &[0x11, 1]))
    }),
    Case::new("A refused node-ID leaves the pending one alone", |bench| {
        bench.play(
            "04 01; 11 MM = 11; 11 00 = 11 01; 11 80 = 11 01; reset communication; boot-up MM",
        )
    }),
    Case::new(
        "A pending node-ID changes nothing: 5E and the COB-IDs are those of the active one",
        |bench| {
            let has_sdo = bench.has_sdo()?;
            bench.play("04 01; 11 MM = 11; 5E = 5E NN")?;
            if has_sdo {
                bench.number((0x1000, 0))?;
            }
            Ok(())
        },
    ),
    Case::new(
        "Reset communication makes the pending node-ID active: the boot-up has the new COB-ID",
        |bench| bench.play("04 01; 11 MM = 11; reset communication; boot-up MM; 04 01; 5E = 5E MM"),
    ),
    Case::new("04 00 makes a changed node-ID not active: it waits for a reset", |bench| {
        bench.play("04 01; 11 MM = 11; 04 00")?;
        let boot_up = bench.wait_for(ms(500), |frame| frame.data() == [0])?;
        bench.check(boot_up.is_none(), "no boot-up")?;
        bench.play("reset communication; boot-up MM")
    }),
    Case::new(
        "04 00 after the first node-ID makes it active: the device boots up by itself",
        |bench| {
            unconfigured(bench)?;
            bench.play("04 01; 11 NN = 11; 5E = 5E FF; 04 00; boot-up NN; 04 01; 5E = 5E NN")
        },
    ),
    Case::new("Reset communication with 255 pending ends communication, not LSS", |bench| {
        bench.play("04 01; 11 FF = 11; reset communication")?;
        let frame = bench.wait_for(ms(1_500), |_| true)?;
        bench.check(frame.is_none(), "no frame within 1.5 s")?;
        bench.play("04 01; 5E = 5E FF")
    }),
    Case::new("The SDO server has the COB-IDs of the new node-ID", sdo),
    Case::new("Reset node brings the stored node-ID back, pending and active", |bench| {
        let stored = bench.begin_alone()?;
        bench.play("11 MM = 11")?;
        bench.restart()?;
        bench.expect_active(stored)?;
        bench.play("reset communication")?;
        bench.pass(ms(100))?;
        bench.expect_active(stored)
    }),
    Case::new("17 stores the pending node-ID: reset node makes it active", |bench| {
        with_stored_values(bench, |bench| {
            store(bench, other_id(bench.node), |bench| bench.restart())
        })
    }),
    Case::new("17 stores the pending node-ID for the next power-on", |bench| {
        with_stored_values(bench, |bench| store(bench, other_id(bench.node), power_cycle))
    }),
    Case::new("A node-ID that is not stored is lost with the power", |bench| {
        let stored = bench.begin_alone()?;
        bench.play("11 MM = 11")?;
        power_cycle(bench)?;
        bench.expect_active(stored)
    }),
    Case::new("255 can be stored: the device has no node-ID after a start", |bench| {
        with_stored_values(bench, |bench| store(bench, NO_NODE_ID, |bench| bench.restart()))
    }),
];

fn power_cycle(bench: &mut Bench) -> Step {
    bench.cut_power(ms(500))
}

fn sdo(bench: &mut Bench) -> Step {
    bench.needs_feature(Feature::Sdo)?;
    if !bench.has_sdo()? {
        return bench.skip("no SDO server answers: if the device has none, run `--without sdo`");
    }
    let (old, new) = (bench.node, other_id(bench.node));
    bench.play("04 01; 11 MM = 11; reset communication; boot-up MM")?;
    for (node, is_answered) in [(new, true), (old, false)] {
        bench.pass(ms(0))?;
        bench.send(0x600 + u16::from(node), &[0x40, 0, 0x10, 0, 0, 0, 0, 0])?;
        let answer = bench.wait_for(ms(300), |frame| frame.cob_id() >> 7 == 0x580 >> 7)?;
        let cob_id = 0x580 + u16::from(node);
        let is_right = answer.is_some_and(|(_, frame)| frame.cob_id() == cob_id) == is_answered;
        bench.check(is_right, format!("an answer from node {new} and none from node {old}"))?;
    }
    Ok(())
}

/// Stores a node-ID, starts the device again by `start`, and expects the node-ID to be active.
fn store(bench: &mut Bench, id: u8, start: impl Fn(&mut Bench) -> Step) -> Step {
    bench.lss(&[0x11, id], &[0x11])?;
    bench.play("17 = 17; 04 00")?;
    start(bench)?;
    bench.expect_active(id)
}
