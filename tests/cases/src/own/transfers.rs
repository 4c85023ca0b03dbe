//! Own SDO 01..18: rules of segmented and block transfer that no case of the certifier's tool looks at (CiA 301, 7.2.4).

use testkit::sdo_messages::{initiate, segment};

use crate::{
    Address, Bench, Case, Group, Step,
    abort::*,
    bench::{abort_code, name},
    eds::{Entry, Kind},
    ms,
    sdo::{block_upload, find},
};

pub const GROUP: Group = Group {
    name: "Own SDO",
    prepare: |bench| {
        bench.needs(HEARTBEAT)?;
        bench.restore()?;
        bench.write(HEARTBEAT, &[0, 0])
    },
    cases: CASES,
};

const CASES: &[Case] = &[
    Case::new("An expedited download without its size has that of the object", |bench| {
        let answer = bench.ask(initiate(0x22, HEARTBEAT, 0xFFFF_0000 | u32::from(NEW)))?;
        bench.check(answer[0] == 0x60, "60: the answer to a download")?;
        expect(bench, NEW)
    }),
    Case::new("A request of fewer than eight bytes is ignored", |bench| {
        bench.send(0x600 + u16::from(bench.node), &[0x40, 0, 0x10, 0, 0, 0, 0])?;
        let answer = bench.hear(ms(200) + bench.jitter)?;
        bench.check(answer.is_none(), "no answer of the SDO server")
    }),
    Case::new("A segment without a transfer is aborted", |bench| {
        for command in [0x00, 0x60] {
            bench.expect_abort(segment(command, &[]), UNEXPECTED)?;
        }
        Ok(())
    }),
    Case::new("A download with a wrong toggle bit is aborted and changes nothing", |bench| {
        begin(bench, 0x21, 2)?;
        bench.expect_abort(segment(0x10 | 5 << 1 | 1, &NEW.to_le_bytes()), &[WRONG_TOGGLE])?;
        expect(bench, 0)
    }),
    Case::new(
        "A download that is announced longer or shorter than the object is refused",
        |bench| {
            for (length, codes) in [(3, TOO_MUCH), (1, TOO_LITTLE)] {
                bench.expect_abort(initiate(0x21, HEARTBEAT, length), codes)?;
            }
            Ok(())
        },
    ),
    Case::new("More or fewer bytes than announced are refused and change nothing", |bench| {
        let address = writable_text(bench)?;
        bench.write(address, b"Before")?;
        for (announced, codes) in [(3, TOO_MUCH), (5, TOO_LITTLE)] {
            bench.ask(initiate(0x21, address, announced))?;
            bench.expect_abort(segment(3 << 1 | 1, b"Four"), codes)?;
            let data = bench.read(address)?;
            bench.check(data == b"Before", "the text before")?;
        }
        Ok(())
    }),
    Case::new("A last segment that says no length has what was announced", |bench| {
        begin(bench, 0x21, 2)?;
        let [low, high] = NEW.to_le_bytes();
        let answer = bench.ask(segment(0x01, &[low, high, 3, 4, 5, 6, 7]))?;
        bench.check(answer[0] == 0x20, "20: the segment is acknowledged")?;
        expect(bench, NEW)
    }),
    Case::new("An abort of the client, or another request, ends a transfer", |bench| {
        for end in [initiate(0x80, HEARTBEAT, GENERAL), initiate(0x40, DEVICE_TYPE, 0)] {
            begin(bench, 0x21, 2)?;
            bench.say(end)?;
            bench.hear(ms(100) + bench.jitter)?;
            bench.expect_abort(segment(5 << 1 | 1, &NEW.to_le_bytes()), UNEXPECTED)?;
        }
        expect(bench, 0)
    }),
    Case::new("A client that is silent for a second gets an abort", |bench| {
        for command in [0x21, 0xC2] {
            begin(bench, command, 2)?;
            let early = bench.hear(ms(950).saturating_sub(bench.jitter))?;
            bench.check(early.is_none(), "nothing within a second")?;
            let late = bench.hear(ms(100) + 2 * bench.jitter)?;
            let is_abort = late.is_some_and(|late| abort_code(&late) == Some(TIMEOUT));
            bench.check(is_abort, "0504 0000h after a second")?;
        }
        Ok(())
    }),
    Case::new("The unused bytes of the last segment are told, none for seven", |bench| {
        let address = writable_text(bench)?;
        for text in [&b"Fourteen bytes"[..], b"Eight by"] {
            bench.write(address, text)?;
            for has_crc in [false, true] {
                let data = block_upload(bench, address, has_crc, false)?;
                bench.check(data == text, "the bytes of the download, in blocks")?;
            }
            let data = bench.read(address)?;
            bench.check(data == text, "the bytes of the download")?;
        }
        Ok(())
    }),
    Case::new("A short value goes by segments if the client asks for that", |bench| {
        let long = long_value(bench)?;
        let len = bench.read(long)?.len() as u32;
        for (threshold, is_block) in [(len - 1, true), (len, false), (0, true)] {
            let answer = bench.ask(initiate(0xA0, long, 127 | threshold << 8))?;
            let is_right = match is_block {
                true => answer[0] & 0xF9 == 0xC0,
                false => answer[0] & 0xFE == 0x40,
            };
            bench.check(is_right, format!("{} with the threshold {threshold}", name(long)))?;
            bench.say(initiate(0x80, long, GENERAL))?;
        }
        Ok(())
    }),
    Case::new("A block upload goes on with the block size of the confirmation", |bench| {
        let Entry { address: long, .. } =
            find(bench, "domain", |entry| entry.kind() == Kind::Domain && entry.can_be_read())?;
        bench.ask(initiate(0xA0, long, 1))?;
        let first = bench.ask(segment(0xA3, &[]))?;
        bench.check(first[0] == 1, "01: the only segment of the first block")?;
        let second = bench.ask(segment(0xA2, &[1, 2]))?;
        let third = bench.answer()?;
        let is_right = second[0] == 1 && third[0] & 0x7F == 2;
        bench.check(is_right, "01 and 02: two segments in the second block")?;
        bench.say(initiate(0x80, long, GENERAL))
    }),
    Case::new("A confirmation of more segments than were sent is aborted", |bench| {
        let long = long_value(bench)?;
        bench.ask(initiate(0xA0, long, 1))?;
        bench.ask(segment(0xA3, &[]))?;
        bench.expect_abort(segment(0xA2, &[2, 1]), &[WRONG_SEQUENCE_NUMBER])?;
        Ok(())
    }),
    Case::new("A block download without CRC takes any CRC", |bench| {
        begin(bench, 0xC2, 2)?;
        let answer = bench.ask(segment(0x81, &NEW.to_le_bytes()))?;
        bench.check(answer[..2] == [0xA2, 1], "A2 01: the block is confirmed")?;
        let answer = bench.ask(segment(0xC1 | 5 << 2, &[0xAA, 0x55]))?;
        bench.check(answer[0] == 0xA1, "A1: the transfer is complete")?;
        expect(bench, NEW)
    }),
    Case::new("Segments of a block out of sequence do not count", |bench| {
        begin(bench, 0xC2, 2)?;
        for number in [2, 0x83] {
            bench.say(segment(number, &NEW.to_le_bytes()))?;
        }
        let answer = bench.answer()?;
        bench.check(answer[..2] == [0xA2, 0], "A2 00: the first segment is missing")?;
        let answer = bench.ask(segment(0x81, &NEW.to_le_bytes()))?;
        bench.check(answer[..2] == [0xA2, 1], "A2 01: the block is confirmed")?;
        let answer = bench.ask(segment(0xC1 | 5 << 2, &[]))?;
        bench.check(answer[0] == 0xA1, "A1: the transfer is complete")?;
        expect(bench, NEW)
    }),
    Case::new("Segment 0 ends a block download, and what follows is not executed", |bench| {
        begin(bench, 0xC2, 2)?;
        bench.expect_abort(segment(0, &[]), &[WRONG_SEQUENCE_NUMBER])?;
        // Segment 2Fh of the block, or a download.
        bench.say(initiate(0x2B, HEARTBEAT, NEW.into()))?;
        bench.pass(ms(200))?;
        expect(bench, 0)
    }),
    Case::new("An abort of the client ends a block download within a block", |bench| {
        begin(bench, 0xC2, 2)?;
        bench.say(segment(1, &NEW.to_le_bytes()))?;
        bench.say(initiate(0x80, HEARTBEAT, GENERAL))?;
        expect(bench, 0)
    }),
    Case::new("A block download that ends in NMT stopped is not executed", |bench| {
        begin(bench, 0xC2, 2)?;
        bench.nmt(crate::Command::Stop)?;
        bench.say(initiate(0x2B, HEARTBEAT, NEW.into()))?;
        bench.nmt(crate::Command::EnterPreOperational)?;
        bench.say(initiate(0x2B, HEARTBEAT, NEW.into()))?;
        bench.pass(ms(200))?;
        expect(bench, 0)
    }),
];

const DEVICE_TYPE: Address = (0x1000, 0);
/// 0 before each case.
const HEARTBEAT: Address = (0x1017, 0);
/// Another heartbeat time.
const NEW: u16 = 30_000;
const UNEXPECTED: &[u32] = &[UNKNOWN_COMMAND, GENERAL];
const TOO_MUCH: &[u32] = &[WRONG_LENGTH, TOO_LONG];
const TOO_LITTLE: &[u32] = &[WRONG_LENGTH, TOO_SHORT];

/// Begins a download of the heartbeat time; the case is skipped if the device does not know this command.
fn begin(bench: &mut Bench, command: u8, length: u32) -> Step {
    let answer = bench.ask(initiate(command, HEARTBEAT, length))?;
    if abort_code(&answer) == Some(UNKNOWN_COMMAND) {
        return bench.skip("the device has no block transfer");
    }
    bench.check(matches!(answer[0], 0x60 | 0xA0 | 0xA4), "60, A0 or A4: the download has begun")
}

fn expect(bench: &mut Bench, heartbeat_ms: u16) -> Step {
    let value = bench.number(HEARTBEAT)?;
    bench.check(value == u64::from(heartbeat_ms), format!("1017h is {heartbeat_ms}"))
}

fn writable_text(bench: &Bench) -> Step<Address> {
    let text = find(bench, "writable text", |entry| {
        entry.kind() == Kind::Text && entry.can_be_written() && entry.can_be_read()
    })?;
    Ok(text.address)
}

/// A value of more than seven bytes; the case is skipped if there is none, or no block transfer.
fn long_value(bench: &mut Bench) -> Step<Address> {
    let node = bench.node;
    let Entry { address, .. } = find(bench, "text of more than seven bytes", |entry| {
        let length = entry.default(node).map_or(0, |text| text.len());
        entry.kind() == Kind::Text && entry.can_be_read() && length > 7
    })?;
    let answer = bench.ask(initiate(0xA0, address, 1))?;
    bench.say(initiate(0x80, address, GENERAL))?;
    match abort_code(&answer) {
        None => Ok(address),
        Some(_) => bench.skip("the device has no block upload"),
    }
}
