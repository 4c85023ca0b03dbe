//! What CiA 305 leaves open, or where its texts differ: the decisions of the LSS slave of this repository.
//!
//! `docs/conformance.md` has the reasons. A device that decides otherwise does not violate CiA 305.

use super::{
    Feature, RESPONSE_COB_ID, SILENCE,
    bit_rate::{activate, follow, needs_switch, other_rate, switched},
    bytes_of, configured,
    identify::Question,
    is_answer, padded, unconfigured, with, with_stored_values,
};
use crate::{Bench, Case, Group, Step, ms};

pub const GROUP: Group = Group {
    name: "LSS further",
    prepare: |bench| {
        bench.needs_feature(Feature::Further)?;
        configured(bench)
    },
    cases: CASES,
};

const CASES: &[Case] = &[
    Case::new("The steps of a select in any order but the ascending are not answered", orders),
    Case::new("Steps of an earlier select do not count", |bench| {
        bench.play("40 V; 41 P; 42 R; 43 S = 44; 04 00; 43 S = -; 40 V = -; 43 S = -")
    }),
    Case::new("04 00 ends a select that has begun", |bench| {
        bench.play("40 V; 41 P; 42 R; 04 00; 43 S = -")
    }),
    Case::new("Two masters: a select and an identify in turn are both answered", |bench| {
        bench.needs_feature(Feature::Identify)?;
        let requests = "46 V; 40 V; 47 P; 41 P; 48 R; 42 R; 49 R; 4A S; 43 S; 4B S";
        at_once(bench, requests, "44; 4F")
    }),
    Case::new("An identify in another order is not answered, nor a second 4B", identify_order),
    Case::new("The revision number is one number: a range may span major revisions", |bench| {
        bench.needs_feature(Feature::Identify)?;
        let address = bench.address()?;
        let major = address.revision_number & 0xFFFF_0000;
        // The minor part of both bounds would exclude it.
        let revisions = (major.saturating_sub(1), major.saturating_add(0x0001_0000));
        Question { revisions, ..Question::new(address) }.expect(bench, true)
    }),
    Case::new("Fastscan: a match with Next before Sub selects, whatever the part", |bench| {
        bench.needs_feature(Feature::Fastscan)?;
        unconfigured(bench)?;
        bench.play("51 00 00 00 00 80 = 4F; 51 V 00 00 01 = 4F; 51 P 00 01 00 = 4F; configuration")
    }),
    Case::new("Fastscan: 04 00 awaits the first part again", |bench| {
        bench.needs_feature(Feature::Fastscan)?;
        unconfigured(bench)?;
        bench.play("51 00 00 00 00 80 = 4F; 51 V 00 00 01 = 4F; 04 00")?;
        bench.play("51 P 00 01 02 = -; 51 V 00 00 01 = 4F")
    }),
    Case::new("13 refuses a bad table or index with 01, and no other code", |bench| {
        bench.needs_feature(Feature::BitTiming)?;
        bench.play("04 01; 13 00 05 = 13 01; 13 00 0A = 13 01; 13 00 FF = 13 01")?;
        bench.play("13 01 00 = 13 01; 13 FF 00 = 13 01")
    }),
    Case::new("A refused 13 leaves the bit rate pending that was accepted before", |bench| {
        needs_switch(bench)?;
        let new = other_rate(bench);
        bench.enter()?;
        bench.lss(&[0x13, 0, new.index()], &[0x13])?;
        bench.refused(&[0x13, 0, 5])?;
        bench.refused(&[0x13, 1, 0])?;
        let t0 = activate(bench, 20)?;
        follow(bench, t0, 20, new)?;
        let answer = bench.play("5E = 5E NN");
        bench.restart()?;
        answer
    }),
    Case::new("15 without 13 keeps both silent delays, and the bit rate", |bench| {
        bench.needs_feature(Feature::Activate)?;
        bench.enter()?;
        activate(bench, 150)?;
        bench.pass(ms(140))?;
        bench.play("5E = -")?;
        bench.pass(ms(200) + 2 * bench.jitter)?;
        bench.play("5E = 5E NN")
    }),
    Case::new("LSS requests in both delays are neither answered nor obeyed", |bench| {
        switched(bench, 200, |bench, t0, new| {
            bench.play("5E = -; 04 00")?;
            bench.pass((t0 + ms(201)).saturating_sub(bench.now()))?;
            bench.set_rate(new)?;
            bench.play("5E = -")?;
            let late = bench.lss_answer(ms(300))?;
            bench.check(late.is_none(), "no late answer")?;
            bench.expect_configuring()
        })
    }),
    Case::new("A device without a node-ID obeys the NMT resets to all", |bench| {
        let stored = bench.begin_alone()?;
        unconfigured(bench)?;
        bench.restart()?;
        bench.expect_active(stored)?;
        unconfigured(bench)?;
        bench.play("04 01; 11 NN = 11; reset communication; boot-up NN")
    }),
    Case::new("04 01, 5A, 5B, 5C, 5D, 5E without a pause are all answered in order", |bench| {
        at_once(bench, "04 01; 5A; 5B; 5C; 5D; 5E", "5A V; 5B P; 5C R; 5D S; 5E NN")
    }),
    Case::new("40, 41, 42, 43 and 5E without a pause are answered 44 and 5E", |bench| {
        at_once(bench, "40 V; 41 P; 42 R; 43 S; 5E", "44; 5E NN")
    }),
    Case::new("04 00 right behind a request is obeyed", |bench| {
        bench.enter()?;
        at_once(bench, "5E; 04 00", "5E NN")?;
        bench.expect_waiting()
    }),
    Case::new("Requests behind 17 are answered, though the store may be running", |bench| {
        with_stored_values(bench, |bench| {
            bench.play("11 NN = 11; 04 01")?;
            at_once(bench, "17; 5A; 17", "17; 17; 5A V")
        })
    })
    .with_remark("The order of the answers is open."),
    Case::new("An answer takes at most 1 ms, that to a store at most 20 ms", |bench| {
        bench.enter()?;
        for request in [0x5A, 0x5B, 0x5C, 0x5D, 0x5E, 0x11] {
            measure(bench, &[request, bench.node], 1)?;
        }
        with_stored_values(bench, |bench| {
            bench.play("11 MM = 11")?;
            measure(bench, &[0x17], 20)
        })
    }),
    Case::new(
        "A device whose stored bit rate nobody else uses finds that of the others",
        |bench| {
            bench.needs_feature(Feature::Rescue)?;
            needs_switch(bench)?;
            with_stored_values(bench, |bench| {
                bench.lss(&[0x13, 0, other_rate(bench).index()], &[0x13])?;
                bench.play("17 = 17")?;
                bench.restart()?;
                let active = bench.find(ms(5_000))?;
                bench.check(active.is_some(), "an answer at the bit rate of the others within 5 s")
            })
        },
    ),
    Case::new("04 01 and a step that differs end an identify that has begun", |bench| {
        bench.needs_feature(Feature::Identify)?;
        bench.play("46 V; 47 P; 48 R; 49 R; 4A S; 04 01; 4B S = -")?;
        bench.play("46 V; 47 V; 47 P; 48 R; 49 R; 4A S; 4B S = -")
    }),
];

/// Sends requests without a pause, and expects these answers and no other. The answers may have any order if one of
/// them is that to a store.
fn at_once(bench: &mut Bench, requests: &str, expected: &str) -> Step {
    let (node, address) = (bench.node, bench.address()?);
    let bytes = |text: &str| padded(&bytes_of(text.trim(), node, address));
    bench.pass(ms(20))?;
    for request in requests.split(';') {
        bench.request_at_once(&bytes(request))?;
    }
    let span = bench.quiet() * 4;
    let frames = bench.collect(span, RESPONSE_COB_ID)?;
    let mut answers: Vec<_> = frames.iter().map(|(_, frame)| frame.data().to_vec()).collect();
    if requests.contains("17") {
        answers.sort();
    }
    bench.check(answers.into_iter().eq(expected.split(';').map(bytes)), expected)
}

/// All orders of the four steps but the ascending one.
fn orders(bench: &mut Bench) -> Step {
    let address: [u32; 4] = bench.address()?.into();
    for number in 1..256_usize {
        let order = [number >> 6 & 3, number >> 4 & 3, number >> 2 & 3, number & 3];
        let is_permutation = (0..4).all(|part| order.contains(&part));
        if !is_permutation || order == [0, 1, 2, 3] {
            continue;
        }
        bench.leave()?;
        for part in order {
            bench.request_at_once(&with(0x40 + part as u8, address[part]))?;
        }
        let span = bench.quiet();
        let answer = bench.lss_answer(span)?;
        bench.check(answer.is_none(), format!("the parts in the order {order:?} select nobody"))?;
    }
    Ok(())
}

fn identify_order(bench: &mut Bench) -> Step {
    bench.needs_feature(Feature::Identify)?;
    let question = Question::new(bench.address()?);
    let requests = question.requests();
    for swapped in 0..5 {
        let mut order = requests;
        order.swap(swapped, swapped + 1);
        bench.leave()?;
        order.iter().try_for_each(|request| bench.lss(request, SILENCE))?;
    }
    bench.leave()?;
    question.expect(bench, true)?;
    bench.lss(&requests[5], SILENCE)
}

/// Fails if the answer takes more than `limit` ms, besides the frames themselves.
fn measure(bench: &mut Bench, request: &[u8], limit: u64) -> Step {
    let frames = ms(270) / u32::from(bench.lss.rate.kbit_per_s());
    bench.pass(ms(5))?;
    let begin = bench.now();
    bench.request_at_once(request)?;
    let answer = bench.wait_for(ms(1_000), is_answer)?;
    let latest = begin + frames + ms(limit) + bench.jitter;
    let is_in_time = answer.is_some_and(|(time, _)| time <= latest);
    bench.check(is_in_time, format!("an answer to {:02X} within {limit} ms", request[0]))
}
