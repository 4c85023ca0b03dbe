//! Devices without a node-ID: identify non-configured remote slave (4C, 50) and Fastscan (51, 4F) of CiA 305.

use super::{Feature, SILENCE, configured, padded, unconfigured, with};
use crate::{Bench, Case, Group, Step, ms};

pub const UNCONFIGURED: Group = Group {
    name: "LSS unconfigured",
    prepare: unconfigured,
    cases: &[
        Case::new("5E is answered FF", |bench| bench.play("04 01; 5E = 5E FF")),
        Case::new("4C is answered 50, in waiting and configuration", |bench| {
            bench.needs_feature(Feature::NonConfigured)?;
            bench.play("4C = 50; 04 01; 4C = 50")
        }),
        Case::new("4C is not answered by a device with a node-ID", |bench| {
            bench.needs_feature(Feature::NonConfigured)?;
            configured(bench)?;
            bench.play("4C = -; 04 01; 4C = -")
        }),
        Case::new("4C is not answered once a node-ID is pending", |bench| {
            bench.needs_feature(Feature::NonConfigured)?;
            bench.play("04 01; 11 NN = 11; 4C = -")
        }),
        Case::new("Selected by its LSS address, the device gets a node-ID and boots up", |bench| {
            bench.play("40 V; 41 P; 42 R; 43 S = 44; 11 NN = 11; 04 00; boot-up NN")
        }),
        Case::new("Without a node-ID the device sends nothing and has no SDO server", |bench| {
            bench.pass(ms(0))?;
            bench.say([0x40, 0x00, 0x10, 0, 0, 0, 0, 0])?;
            let frame = bench.wait_for(ms(1_500), |_| true)?;
            bench.check(frame.is_none(), "no frame within 1.5 s")
        }),
    ],
};

pub const GROUP: Group = Group {
    name: "LSS Fastscan",
    prepare: |bench| {
        bench.needs_feature(Feature::Fastscan)?;
        unconfigured(bench)
    },
    cases: CASES,
};

const CASES: &[Case] = &[
    Case::new("BitCheck 80h is answered 4F, as often as it comes", |bench| {
        bench
            .play("51 00 00 00 00 80 = 4F; 51 00 00 00 00 80 = 4F; 51 00 00 00 00 80 = 4F; waiting")
    }),
    Case::new("A device with a node-ID, active or only pending, takes no part", |bench| {
        bench.play(
            "04 01; 11 NN = 11; 51 00 00 00 00 80 = -; 04 00; boot-up NN; 51 00 00 00 00 80 = -",
        )
    }),
    Case::new("A device in configuration takes no part", |bench| {
        bench.play("04 01; 51 00 00 00 00 80 = -")
    }),
    Case::new(
        "A scan without any knowledge finds the LSS address and ends in configuration",
        |bench| expect_found(bench, 0),
    ),
    Case::new("Parts that are known take one request each", |bench| expect_found(bench, 4)),
    Case::new("Vendor-ID and product code are known, the rest is found", |bench| {
        expect_found(bench, 2)
    }),
    Case::new("A step that differs is not answered, and the scan goes on", |bench| {
        let [vendor, ..]: [u32; 4] = bench.address()?.into();
        bench.lss(&BEGIN, &[0x4F])?;
        bench.lss(&step(!vendor, 31, 0, 0), SILENCE)?;
        bench.lss(&step(!vendor, 0, 0, 1), SILENCE)?;
        bench.lss(&step(vendor, 31, 0, 0), &[0x4F])
    }),
    Case::new("The bits from BitCheck upwards count, and no others", |bench| {
        let [vendor, ..]: [u32; 4] = bench.address()?.into();
        bench.lss(&BEGIN, &[0x4F])?;
        [31, 16, 15, 1].into_iter().try_for_each(|bit| {
            let lower = (1 << bit) - 1;
            bench.lss(&step(vendor ^ lower, bit, 0, 0), &[0x4F])?;
            bench.lss(&step(vendor ^ 1 << bit, bit, 0, 0), SILENCE)
        })
    }),
    Case::new("A step for another part than the awaited one is not answered", |bench| {
        bench.lss(&BEGIN, &[0x4F])?;
        bench.play("51 P 00 01 02 = -; 51 V 00 00 01 = 4F; 51 V 00 00 01 = -; 51 P 00 01 02 = 4F")
    }),
    Case::new(
        "BitCheck 20h to 7Fh and from 81h, Sub and Next above 3 are not answered",
        out_of_range,
    ),
    Case::new("A match with Next 9 and a step with Sub 9 do no harm", |bench| {
        bench.lss(&BEGIN, &[0x4F])?;
        // An answer to the first is among the cases with values out of range.
        bench.play("51 V 00 00 09; 51 00 00 00 00 00 09 00; 51 00 00 00 00 1F FF FF; 04 00")?;
        expect_found(bench, 4)
    }),
    Case::new("A scan for an absent device selects none", |bench| {
        let mut known = <[u32; 4]>::from(bench.address()?).map(Some);
        known[3] = known[3].map(|serial| serial ^ 1);
        let found = scan(bench, known)?;
        bench.check(found.is_none(), "the last step is not answered")?;
        bench.expect_waiting()
    }),
    Case::new("BitCheck 80h begins the scan again", |bench| {
        bench.play("51 00 00 00 00 80 = 4F; 51 V 00 00 01 = 4F; 51 00 00 00 00 80 = 4F")?;
        bench.play("51 P 00 01 02 = -; 51 V 00 00 01 = 4F; 51 P 00 01 02 = 4F")
    }),
    Case::new("A match of some bits does not end the scan, whatever Next is", |bench| {
        bench.play("51 00 00 00 00 80 = 4F; 51 V 00 00 01 = 4F; 51 P 01 01 00 = 4F; waiting")
    }),
];

/// The beginning of a scan.
pub const BEGIN: [u8; 8] = [0x51, 0, 0, 0, 0, 0x80, 0, 0];

/// A step of a scan.
pub fn step(number: u32, bit: u8, sub: u8, next: u8) -> [u8; 8] {
    let mut request = padded(&with(0x51, number));
    request[5..].copy_from_slice(&[bit, sub, next]);
    request
}

/// Sends a step; returns whether somebody answers.
fn is_match(bench: &mut Bench, request: [u8; 8]) -> Step<bool> {
    let span = bench.quiet();
    match bench.ask_lss(&request, span)? {
        None => Ok(false),
        Some([0x4F, 0, 0, 0, 0, 0, 0, 0]) => Ok(true),
        Some(_) => bench.fail("Fastscan is answered 4F and zeros"),
    }
}

/// Looks for a device, whose known parts need not be found.
pub fn scan(bench: &mut Bench, known: [Option<u32>; 4]) -> Step<Option<[u32; 4]>> {
    if !is_match(bench, BEGIN)? {
        return Ok(None);
    }
    let mut found = [0; 4];
    for (sub, part) in (0..).zip(known) {
        let mut number = part.unwrap_or(0);
        if part.is_none() {
            for bit in (0..32).rev() {
                if !is_match(bench, step(number, bit, sub, sub))? {
                    number |= 1 << bit;
                }
            }
        }
        if !is_match(bench, step(number, 0, sub, (sub + 1) % 4))? {
            return Ok(None);
        }
        found[usize::from(sub)] = number;
    }
    Ok(Some(found))
}

/// Looks for the device, of whose LSS address the first `known` parts are known.
fn expect_found(bench: &mut Bench, known: usize) -> Step {
    let address: [u32; 4] = bench.address()?.into();
    let mut parts = [None; 4];
    for (part, number) in parts.iter_mut().zip(address).take(known) {
        *part = Some(number);
    }
    let found = scan(bench, parts)?;
    bench.check(found == Some(address), format!("{address:08X?} is found"))?;
    bench.lss(&[0x5D], &with(0x5D, address[3]))
}

fn out_of_range(bench: &mut Bench) -> Step {
    let [vendor, ..]: [u32; 4] = bench.address()?.into();
    bench.lss(&BEGIN, &[0x4F])?;
    for bit in [0x20, 0x3F, 0x7F, 0x81, 0xFF] {
        bench.lss(&step(vendor, bit, 0, 0), SILENCE)?;
    }
    for number in [4, 5, 0x80, 0xFF] {
        bench.lss(&step(vendor, 0, number, 0), SILENCE)?;
        bench.lss(&step(vendor, 0, 0, number), SILENCE)?;
    }
    bench.lss(&step(vendor, 31, 0, 0), &[0x4F])
}
