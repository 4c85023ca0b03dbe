//! What is a request and what is none, and reserved bytes (CiA 305).

use super::{Feature, PATIENCE, REQUEST_COB_ID, SILENCE, configured, padded, with};
use crate::{Bench, Case, Group, Step, ms};

pub const GROUP: Group = Group { name: "LSS frames", prepare: configured, cases: CASES };

const CASES: &[Case] = &[
    Case::new("A request with less than eight bytes is ignored", lengths),
    Case::new("A remote frame is ignored", |bench| {
        ignored(bench, |bench, _| bench.send_remote(REQUEST_COB_ID, 8))
    }),
    Case::new("A frame with a 29-bit identifier is ignored", |bench| {
        ignored(bench, |bench, request| bench.send_extended(REQUEST_COB_ID.into(), request))?;
        // The number whose upper bits are 7E5.
        ignored(bench, |bench, request| bench.send_extended(0x7E5 << 18, request))
    }),
    Case::new("A request with a neighbouring COB-ID is ignored", |bench| {
        for cob_id in [0x7E4, 0x7E6, 0x7E7, 0x7ED, 0x7C5, 0x5E5] {
            ignored(bench, |bench, request| bench.send(cob_id, request))?;
        }
        Ok(())
    }),
    Case::new(
        "Unknown command specifiers, and those of answers, are ignored in both states",
        unknown,
    ),
    Case::new("Reserved bytes of a request do not count", reserved)
        .with_remark("CiA 305 says what a master sends, not what a slave does with other bytes."),
];

/// Sends 04 01 by `send` in waiting, and 5E in configuration: neither may be obeyed.
fn ignored(bench: &mut Bench, send: impl Fn(&mut Bench, &[u8]) -> Step) -> Step {
    bench.leave()?;
    send(bench, &padded(&[0x04, 1]))?;
    bench.expect_waiting()?;
    bench.enter()?;
    let span = bench.quiet();
    bench.pass(span)?;
    send(bench, &padded(&[0x5E]))?;
    let answer = bench.lss_answer(span)?;
    bench.check(answer.is_none(), "no answer")?;
    send(bench, &padded(&[0x04, 0]))?;
    bench.expect_configuring()
}

fn lengths(bench: &mut Bench) -> Step {
    for length in 0..8 {
        ignored(bench, |bench, request| bench.send(REQUEST_COB_ID, &request[..length]))?;
    }
    Ok(())
}

fn unknown(bench: &mut Bench) -> Step {
    let is_service = |command: &u8| {
        let identification = matches!(command, 0x40..=0x43 | 0x46..=0x4C | 0x51);
        identification || matches!(command, 0x04 | 0x11 | 0x13 | 0x15 | 0x17 | 0x5A..=0x5E)
    };
    for (mode, state) in [(0, "waiting"), (1, "configuration")] {
        bench.request(&[0x04, mode])?;
        for command in (0..=0xFF).filter(|command| !is_service(command)) {
            bench.request(&[command, 1 - mode])?;
            let span = ms(10) + bench.jitter;
            let answer = bench.lss_answer(span)?;
            bench.check(answer.is_none(), format!("{command:02X} is not answered in {state}"))?;
        }
        bench.play(state)?;
    }
    Ok(())
}

fn reserved(bench: &mut Bench) -> Step {
    let address: [u32; 4] = bench.address()?.into();
    let full = |bytes: &[u8]| {
        let mut request = [0xFF; 8];
        request[..bytes.len()].copy_from_slice(bytes);
        request
    };
    for (command, number) in (0x40..).zip(address) {
        bench.request(&full(&with(command, number)))?;
    }
    let answer = bench.lss_answer(PATIENCE)?;
    bench.check(answer == Some(padded(&[0x44])), "44 and zeros")?;
    bench.lss(&full(&[0x5A]), &with(0x5A, address[0]))?;
    bench.lss(&full(&[0x5E]), &[0x5E, bench.node])?;
    bench.lss(&full(&[0x11, bench.node]), &[0x11])?;
    if !bench.lss.without.contains(&Feature::BitTiming) {
        bench.lss(&full(&[0x13, 0, bench.lss.rate.index()]), &[0x13])?;
    }
    bench.lss(&full(&[0x04, 0]), SILENCE)?;
    bench.expect_waiting()
}
