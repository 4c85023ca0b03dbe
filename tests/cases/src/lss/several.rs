//! Several devices on one bus: who answers, who is selected, and a bit rate for all (CiA 305).

use canopen_node::{Frame, lss::Address};

use super::{
    Feature, LONG_PATIENCE, NO_NODE_ID, SILENCE,
    bit_rate::{activate, follow, needs_switch, other_rate},
    fastscan::scan,
    identify::Question,
    with,
};
use crate::{Bench, Case, Command, Group, Step, ms};

/// Before each case all devices are in LSS waiting state, without a node-ID.
pub const GROUP: Group = Group { name: "LSS several", prepare, cases: CASES };

const CASES: &[Case] = &[
    Case::new(
        "Who has a serial number between two others? Each range is answered if it holds a device",
        ranges,
    ),
    Case::new("Two devices that differ in one bit are selected one by one", one_bit),
    Case::new("A select switches one device, and the others stay in waiting", |bench| {
        for address in devices(bench) {
            bench.must_select(address)?;
            bench.lss(&[0x5D], &with(0x5D, address.serial_number))?;
            let more = bench.lss_answer(ms(20))?;
            bench.check(more.is_none(), "one answer")?;
        }
        Ok(())
    }),
    Case::new("Equal answers are one frame: 04 01, 5E", |bench| {
        bench.enter()?;
        bench.lss(&[0x5E], &[0x5E, NO_NODE_ID])?;
        let more = bench.lss_answer(ms(50))?;
        bench.check(more.is_none(), "one answer")
    }),
    Case::new("Fastscan finds one device after the other, until none is left", fastscan),
    Case::new("4C is answered until the last device has a node-ID", non_configured),
    Case::new("Each device boots up with the node-ID that it got", |bench| {
        for (address, id) in devices(bench).into_iter().zip(FIRST_ID..) {
            bench.must_select(address)?;
            bench.lss(&[0x11, id], &[0x11])?;
        }
        bench.nmt_to(Command::ResetCommunication, 0)?;
        let mut missing: Vec<_> =
            (0x700 + u16::from(FIRST_ID)..).take(devices(bench).len()).collect();
        while !missing.is_empty() {
            let is_boot_up = |frame: &Frame| frame.cob_id() > 0x700 && frame.data() == [0];
            match bench.wait_for(LONG_PATIENCE, is_boot_up)? {
                Some((_, frame)) => missing.retain(|cob_id| *cob_id != frame.cob_id()),
                None => return bench.fail(format!("boot-ups with the COB-IDs {missing:03X?}")),
            }
        }
        Ok(())
    })
    .with_remark("The device that is left with 04 00 before the reset boots up by then."),
    Case::new(
        "13 to each device one by one, then one 15 to all: all answer at the new bit rate",
        switch_all,
    ),
];

/// The node-ID of the first device.
const FIRST_ID: u8 = 0x11;

fn devices(bench: &Bench) -> Vec<Address> {
    bench.lss.devices.clone()
}

fn prepare(bench: &mut Bench) -> Step {
    let devices = devices(bench);
    if devices.len() < 2 {
        return bench.skip("it needs several devices, by their LSS addresses");
    }
    bench.attach(devices.len())?;
    bench.set_rate(bench.lss.rate)?;
    bench.leave()?;
    bench.restart()?;
    bench.pass(ms(1_000))?;
    for address in devices {
        bench.must_select(address)?;
        bench.lss(&[0x11, NO_NODE_ID], &[0x11])?;
    }
    bench.leave()?;
    bench.nmt_to(Command::ResetCommunication, 0)?;
    bench.pass(ms(100))
}

/// The devices of the same product and revision as the first, by serial number.
fn by_serial(bench: &Bench) -> Vec<Address> {
    let mut all = devices(bench);
    let first = all[0];
    all.retain(|device| Address { serial_number: first.serial_number, ..*device } == first);
    all.sort_by_key(|device| device.serial_number);
    all
}

fn ranges(bench: &mut Bench) -> Step {
    bench.needs_feature(Feature::Identify)?;
    let all = by_serial(bench);
    let [first, .., last] = all[..] else { return bench.skip("it needs devices of one product") };
    let ask = |bench: &mut Bench, serials: (u32, u32)| {
        let is_answered =
            all.iter().any(|device| (serials.0..=serials.1).contains(&device.serial_number));
        Question { serials, ..Question::new(first) }.expect(bench, is_answered)
    };
    for pair in all.windows(2) {
        let (low, high) = (pair[0].serial_number, pair[1].serial_number);
        ask(bench, (low + 1, high - 1))?;
        ask(bench, (low + 1, high))?;
        ask(bench, (low, high - 1))?;
    }
    for triple in all.windows(3) {
        ask(bench, (triple[0].serial_number + 1, triple[2].serial_number - 1))?;
    }
    ask(bench, (0, first.serial_number.saturating_sub(1)))?;
    ask(bench, (last.serial_number.saturating_add(1), u32::MAX))
}

fn one_bit(bench: &mut Bench) -> Step {
    let all = by_serial(bench);
    let differ = |a: &Address, b: &Address| (a.serial_number ^ b.serial_number).count_ones() == 1;
    let pair = all.iter().find_map(|a| Some((*a, *all.iter().find(|b| differ(a, b))?)));
    let Some((a, b)) = pair else {
        return bench.skip("no two serial numbers differ in one bit");
    };
    for address in [a, b, a] {
        bench.must_select(address)?;
        bench.lss(&[0x5D], &with(0x5D, address.serial_number))?;
    }
    if bench.lss.without.contains(&Feature::Fastscan) {
        return Ok(());
    }
    for address in [a, b] {
        bench.leave()?;
        let found = scan(bench, <[u32; 4]>::from(address).map(Some))?;
        bench.check(found.is_some(), "Fastscan finds it by its LSS address")?;
        bench.lss(&[0x5D], &with(0x5D, address.serial_number))?;
    }
    Ok(())
}

fn fastscan(bench: &mut Bench) -> Step {
    bench.needs_feature(Feature::Fastscan)?;
    let mut left: Vec<[u32; 4]> = devices(bench).into_iter().map(Into::into).collect();
    let mut id = FIRST_ID;
    while !left.is_empty() {
        let Some(found) = scan(bench, [None; 4])? else {
            return bench.fail(format!("a device is found: {left:08X?}"));
        };
        bench.check(left.contains(&found), format!("one of {left:08X?} is found"))?;
        bench.lss(&[0x5D], &with(0x5D, found[3]))?;
        bench.lss(&[0x11, id], &[0x11])?;
        bench.leave()?;
        bench.boots_as(id)?;
        left.retain(|address| *address != found);
        id += 1;
    }
    bench.lss(&super::fastscan::BEGIN, SILENCE)
}

fn non_configured(bench: &mut Bench) -> Step {
    bench.needs_feature(Feature::NonConfigured)?;
    for (address, id) in devices(bench).into_iter().zip(FIRST_ID..) {
        bench.lss(&[0x4C], &[0x50])?;
        bench.must_select(address)?;
        bench.lss(&[0x11, id], &[0x11])?;
        bench.leave()?;
        bench.boots_as(id)?;
    }
    bench.lss(&[0x4C], SILENCE)
}

fn switch_all(bench: &mut Bench) -> Step {
    needs_switch(bench)?;
    let new = other_rate(bench);
    for address in devices(bench) {
        bench.must_select(address)?;
        bench.lss(&[0x13, 0, new.index()], &[0x13])?;
    }
    bench.enter()?;
    let t0 = activate(bench, 100)?;
    follow(bench, t0, 100, new)?;
    let mut lost = Vec::new();
    for address in devices(bench) {
        bench.leave()?;
        if !bench.select(address.into())? {
            lost.push(address.serial_number);
        }
    }
    bench.restart()?;
    bench.set_rate(bench.lss.rate)?;
    bench.check(lost.is_empty(), format!("{lost:08X?} answer at {new}"))
}
