//! Own PDO 01..12: rules of PDOs and SYNC that no case of the certifier's tool looks at (CiA 301, 7.2.2 and 7.2.5).

use std::time::Duration;

use super::{EFFECT, INVALID, LATE, Output, sync};
use crate::{
    Bench, Case,
    Command::{EnterPreOperational, Start, Stop},
    Group, Step,
    abort::{GENERAL, INVALID_VALUE, NOT_NOW, TOO_HIGH},
    bench::name,
    emergency, heartbeat, ms,
    pdo::{self, Direction, Pdo},
};

pub const GROUP: Group = Group { name: "Own PDO", prepare: |bench| bench.restore(), cases: CASES };

const CASES: &[Case] = &[
    Case::new(
        "An RPDO has no effect out of NMT operational, and does not wait for it",
        out_of_state,
    ),
    Case::new("An RPDO follows its COB-ID, and has no effect while it is invalid", moved),
    Case::new("An RPDO that is too short is signalled once and not used", |bench| {
        let output = Output::running(bench, 254)?;
        let short = &output.data[..output.data.len() - 1];
        output.send(bench)?;
        for _ in 0..2 {
            expect_codes(bench, &[TOO_SHORT], |bench| {
                output.send_data(bench, short)?;
                output.send_data(bench, short)
            })?;
            output.expect(bench, true, "in spite of RPDOs that are too short")?;
            expect_codes(bench, &[NO_ERROR], |bench| output.send(bench))?;
        }
        output.send_data(bench, &output.before)?;
        output.expect(bench, false, "by an RPDO of the right length")
    }),
    Case::new("An RPDO that is too long is signalled, and its first bytes are used", |bench| {
        let output = Output::running(bench, 254)?;
        let long = [&output.data[..], &[0]].concat();
        if long.len() > 8 {
            return bench.skip("the RPDO has eight bytes");
        }
        expect_codes(bench, &[TOO_LONG], |bench| output.send_data(bench, &long))?;
        output.expect(bench, true, "by an RPDO that is too long")?;
        expect_codes(bench, &[NO_ERROR], |bench| output.send_data(bench, &output.data))
    }),
    Case::new("A SYNC of the wrong length is signalled once and not used", |bench| {
        let output = Output::running(bench, 0)?;
        output.send(bench)?;
        expect_codes(bench, &[SYNC_LENGTH], |bench| {
            bench.sync(&[1])?;
            bench.sync(&[2])
        })?;
        output.expect(bench, false, "by a SYNC of one byte")?;
        expect_codes(bench, &[NO_ERROR], sync)?;
        output.expect(bench, true, "by a SYNC without data")
    }),
    Case::new("An error that ends while another lasts is not signalled", |bench| {
        let output = Output::running(bench, 254)?;
        expect_codes(bench, &[TOO_SHORT], |bench| output.send_data(bench, &[]))?;
        expect_codes(bench, &[SYNC_LENGTH], |bench| bench.sync(&[1]))?;
        expect_codes(bench, &[], sync)?;
        expect_codes(bench, &[NO_ERROR], |bench| output.send(bench))
    }),
    Case::new("1003h has the newest error first, and sub-index 0 takes 0 only", |bench| {
        bench.needs((0x1003, 2))?;
        let output = Output::running(bench, 254)?;
        output.send_data(bench, &[])?;
        bench.pass(EFFECT)?;
        bench.sync(&[1])?;
        bench.pass(EFFECT)?;
        bench.refuses((0x1003, 0), &[1], &[INVALID_VALUE, TOO_HIGH, GENERAL])?;
        for (sub_index, expected) in [(0, 2), (1, SYNC_LENGTH), (2, TOO_SHORT)] {
            let value = bench.number((0x1003, sub_index))? as u16;
            bench.check(value == expected, format!("1003h sub {sub_index} is {expected:04X}h"))?;
        }
        Ok(())
    }),
    Case::new("The inhibit time goes on when other parameters are written", |bench| {
        let (tpdo, cob_id, first) = inhibited(bench)?;
        bench.pass(ms(200))?;
        bench.write(tpdo.transmission_type(), &[255])?;
        let next = bench.wait_for(ms(1_000), |frame| frame.cob_id() == cob_id)?;
        let earliest = first + ms(500).saturating_sub(bench.jitter);
        let is_right = next.is_some_and(|(time, _)| time >= earliest);
        bench.check(is_right, format!("{cob_id:03X} 500 ms after the one before"))
    }),
    Case::new("A new inhibit time counts from the next TPDO on", |bench| {
        let (tpdo, cob_id, _) = inhibited(bench)?;
        let value = tpdo.close(bench)?;
        bench.write(tpdo.inhibit_time(), &10_000_u16.to_le_bytes())?;
        tpdo.set_cob_id(bench, value)?;
        let frames = bench.collect(ms(100), cob_id)?;
        bench.check(frames.len() == 1, format!("{cob_id:03X} at once"))
    }),
    Case::new("A valid PDO takes neither another COB-ID nor another inhibit time", |bench| {
        for (pdo, cob_id) in pdo::valid(bench, &[Direction::Receive, Direction::Transmit])? {
            let (other, codes) = (cob_id ^ 0x100, [NOT_NOW, INVALID_VALUE, GENERAL]);
            bench.refuses(pdo.cob_id(), &other.to_le_bytes(), &codes)?;
            let inhibit_time = pdo.inhibit_time();
            if bench.eds.get(inhibit_time).is_some_and(|entry| entry.can_be_written()) {
                bench.refuses(inhibit_time, &777_u16.to_le_bytes(), &codes)?;
            }
            let value = bench.number(pdo.cob_id())? as u32;
            bench.check(value == cob_id, format!("{} is unchanged", name(pdo.cob_id())))?;
        }
        Ok(())
    }),
    Case::new(
        "An RPDO is late only in NMT operational, and one of the wrong length does not count",
        |bench| {
            let output = Output::running(bench, 254)?;
            bench.needs(output.rpdo.event_timer())?;
            output.rpdo.set_transmission(bench, 254, 200)?;
            output.send(bench)?;
            bench.nmt(EnterPreOperational)?;
            let messages = emergency::messages(bench, ms(500))?;
            bench.check(messages.is_empty(), "no emergency message out of NMT operational")?;
            bench.nmt(Start)?;
            output.send(bench)?;
            bench.pass(ms(100))?;
            output.send_data(bench, &[])?;
            let messages = emergency::messages(bench, ms(120) + bench.jitter)?;
            let is_late = messages.iter().any(|message| emergency::code(message) == LATE);
            bench.check(is_late, "8250h, 200 ms after the last RPDO of the right length")
        },
    ),
    Case::new("A TPDO that waits for its inhibit time holds up no heartbeat", |bench| {
        let (tpdo, ..) = inhibited(bench)?;
        bench.needs((0x1017, 0))?;
        // Its event timer ends within the inhibit time of 500 ms, again and again.
        bench.write(tpdo.event_timer(), &20_u16.to_le_bytes())?;
        heartbeat::set_producer(bench, 50)?;
        let beats = bench.collect(ms(1_000), 0x700 + u16::from(bench.node))?;
        bench.check((18..=21).contains(&beats.len()), "20 heartbeats in a second")
    }),
];

/// Error codes of process data.
const TOO_SHORT: u16 = 0x8210;
const TOO_LONG: u16 = 0x8220;
const SYNC_LENGTH: u16 = 0x8240;
const NO_ERROR: u16 = 0;

/// Expects these error codes of what is sent.
pub fn expect_codes(
    bench: &mut Bench,
    expected: &[u16],
    send: impl FnOnce(&mut Bench) -> Step,
) -> Step {
    let from = bench.seen_len();
    send(bench)?;
    bench.pass(ms(100))?;
    let cob_id = 0x80 + u16::from(bench.node);
    let messages = bench.received_since(from).filter(|frame| frame.cob_id() == cob_id);
    let codes: Vec<u16> = messages.map(|message| emergency::code(&message)).collect();
    bench.check(codes == expected, format!("emergency messages {expected:04X?}"))
}

fn out_of_state(bench: &mut Bench) -> Step {
    let output = Output::running(bench, 254)?;
    for state in [EnterPreOperational, Stop] {
        bench.nmt(state)?;
        output.send(bench)?;
        bench.nmt(Start)?;
        output.expect(bench, false, "by an RPDO out of NMT operational")?;
    }
    output.rpdo.set_transmission(bench, 0, 0)?;
    output.send(bench)?;
    bench.nmt(EnterPreOperational)?;
    bench.nmt(Start)?;
    sync(bench)?;
    output.expect(bench, false, "by an RPDO of the time before")
}

fn moved(bench: &mut Bench) -> Step {
    let mut output = Output::running(bench, 254)?;
    let value = output.rpdo.close(bench)?;
    output.send(bench)?;
    output.expect(bench, false, "by an RPDO that is invalid")?;
    let other = output.cob_id ^ 0x700;
    output.rpdo.set_cob_id(bench, value & !0x7FF & !INVALID | u32::from(other))?;
    output.send(bench)?;
    output.expect(bench, false, "by a frame with the COB-ID before")?;
    output.cob_id = other;
    output.send(bench)?;
    output.expect(bench, true, "by a frame with the new COB-ID")
}

/// A TPDO with an inhibit time of 500 ms, its COB-ID, and when it was sent just now.
fn inhibited(bench: &mut Bench) -> Step<(Pdo, u16, Duration)> {
    let (tpdo, value) = pdo::valid(bench, &[Direction::Transmit])?[0];
    bench.needs(tpdo.inhibit_time())?;
    tpdo.close(bench)?;
    bench.write(tpdo.inhibit_time(), &5_000_u16.to_le_bytes())?;
    tpdo.set_cob_id(bench, value)?;
    tpdo.set_transmission(bench, 254, 0)?;
    bench.nmt(Start)?;
    let cob_id = value as u16 & 0x7FF;
    match bench.collect(ms(50), cob_id)?[..] {
        [(time, _)] => Ok((tpdo, cob_id, time)),
        _ => bench.fail(format!("one {cob_id:03X} at the start")),
    }
}
