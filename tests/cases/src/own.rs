//! Own 01..15: rules of CiA 301 that no case of the certifier's tool looks at.

mod nmt;
mod process_data;
mod transfers;

use std::time::Duration;

use canopen_node::Frame;
use testkit::sdo_messages::{crc, initiate, segment};

use crate::{
    Address, Bench, Case, Command, Group, Step, abort,
    bench::{abort_code, name},
    eds::Kind,
    emergency, heartbeat, ms,
    pdo::{self, Direction, Pdo},
    sdo, synchronization,
};

/// Our own cases, which the certifier's tool does not have.
pub const OWN: &[Group] = &[
    Group { name: "Own", prepare: |bench| bench.restore(), cases: CASES },
    nmt::GROUP,
    transfers::GROUP,
    process_data::GROUP,
];

const CASES: &[Case] = &[
    Case::new("A TPDO has the length of its mapping", tpdo_length),
    Case::new("The inhibit time of a TPDO is kept", tpdo_inhibit_time),
    Case::new("An RPDO that is not received within its event timer is signalled", rpdo_deadline),
    Case::new("An RPDO of type 0 takes effect at the next SYNC", synchronous_rpdo),
    Case::new("A synchronous RPDO behind the window 1007h has no effect", window),
    Case::new("A SYNC without the counter of 1019h sends no TPDO", sync_without_counter),
    Case::new("The inhibit time 1015h is kept between emergency messages", emergency_inhibit_time),
    Case::new("An invalid 1014h ends the emergency messages", no_emergency),
    Case::new("1003h sub 0 := 0 clears the history", clear_history),
    Case::new("1029h sub 1 = 1: a missing heartbeat leaves the NMT state alone", |bench| {
        error_behaviour(bench, 1, heartbeat::OPERATIONAL)
    }),
    Case::new("1029h sub 1 = 2: a missing heartbeat stops the device", |bench| {
        error_behaviour(bench, 2, heartbeat::STOPPED)
    }),
    Case::new("A write to 1017h begins its time again", heartbeat_restart),
    Case::new("Segments of a block upload that are repeated count once in its CRC", |bench| {
        sdo::block_upload_of_text(bench, true, true)
    }),
    Case::new("Segments of a block download that are repeated count once in its CRC", |bench| {
        repeated_download(bench, 0)
    }),
    Case::new("A block download with a wrong CRC is aborted and changes nothing", |bench| {
        repeated_download(bench, 1)
    }),
];

/// The wait for an effect of a frame.
const EFFECT: Duration = ms(20);
/// Bit 31 of 1014h: there are no emergency messages.
const INVALID: u32 = 1 << 31;
/// The error code of an RPDO that is late.
const LATE: u16 = 0x8250;

fn synchronous_tpdos(bench: &mut Bench) -> Step<Vec<(Pdo, u16)>> {
    bench.needs((0x1005, 0))?;
    let tpdos = pdo::valid(bench, &[Direction::Transmit])?;
    for (tpdo, _) in &tpdos {
        tpdo.set_transmission(bench, 1, 0)?;
    }
    Ok(tpdos.into_iter().map(|(tpdo, cob_id)| (tpdo, cob_id as u16 & 0x7FF)).collect())
}

fn tpdo_length(bench: &mut Bench) -> Step {
    let tpdos = synchronous_tpdos(bench)?;
    for (tpdo, cob_id) in tpdos {
        let length = tpdo.len(bench)?;
        bench.nmt(Command::Start)?;
        bench.pass(EFFECT)?;
        bench.sync(&[])?;
        let frame = bench.wait_for(ms(500), |frame| frame.cob_id() == cob_id)?;
        let is_right = frame.is_some_and(|(_, frame)| frame.data().len() == length);
        bench.check(is_right, format!("{cob_id:03X} with {length} bytes"))?;
        bench.nmt(Command::EnterPreOperational)?;
    }
    Ok(())
}

fn tpdo_inhibit_time(bench: &mut Bench) -> Step {
    for (tpdo, cob_id) in pdo::valid(bench, &[Direction::Transmit])? {
        bench.needs(tpdo.inhibit_time())?;
        bench.needs(tpdo.event_timer())?;
        tpdo.close(bench)?;
        bench.write(tpdo.inhibit_time(), &1_000_u16.to_le_bytes())?;
        tpdo.set_cob_id(bench, cob_id)?;
        tpdo.set_transmission(bench, 254, 20)?;
        bench.nmt(Command::Start)?;
        let frames = bench.collect(ms(1_000), cob_id as u16 & 0x7FF)?;
        bench.check(frames.len() > 4, "TPDOs in spite of the inhibit time")?;
        check_gaps(bench, &frames, 100)?;
        bench.nmt(Command::EnterPreOperational)?;
    }
    Ok(())
}

/// Checks that at least so many milliseconds are between two frames.
fn check_gaps(bench: &Bench, frames: &[(Duration, Frame)], least: u64) -> Step {
    let least_gap = ms(least).saturating_sub(bench.jitter);
    let is_kept = frames.windows(2).all(|pair| pair[1].0 - pair[0].0 >= least_gap);
    bench.check(is_kept, format!("{least} ms between two of them"))
}

fn rpdo_deadline(bench: &mut Bench) -> Step {
    for (rpdo, cob_id) in pdo::valid(bench, &[Direction::Receive])? {
        bench.needs(rpdo.event_timer())?;
        rpdo.set_transmission(bench, 254, 200)?;
        let data = vec![0; rpdo.len(bench)?];
        bench.nmt(Command::Start)?;
        let mut messages = emergency::messages(bench, ms(500))?;
        for _ in 0..5 {
            bench.send(cob_id as u16 & 0x7FF, &data)?;
            messages.extend(emergency::messages(bench, ms(100))?);
        }
        let is_late = |message| emergency::code(message) == LATE;
        bench.check(!messages.iter().any(is_late), "no 8250h while the RPDO comes in time")?;
        let messages = emergency::messages(bench, ms(1_000))?;
        let count = messages.iter().filter(|message| is_late(message)).count();
        bench.check(count == 1, "one emergency message 8250h when it no longer comes")?;
        bench.nmt(Command::EnterPreOperational)?;
        rpdo.set_transmission(bench, 254, 0)?;
    }
    Ok(())
}

/// An RPDO that changes a value which can be read.
struct Output {
    rpdo: Pdo,
    cob_id: u16,
    /// What the RPDO carries.
    data: Vec<u8>,
    /// The same without the change.
    before: Vec<u8>,
    address: Address,
    /// The value before, and the one that the RPDO sets.
    values: [Vec<u8>; 2],
}

impl Output {
    /// The case is skipped if there is none.
    fn of(bench: &mut Bench) -> Step<Self> {
        bench.needs((0x1005, 0))?;
        for (rpdo, cob_id) in pdo::valid(bench, &[Direction::Receive])? {
            let (mut data, mut unchanged, mut found) = (Vec::new(), Vec::new(), None);
            for entry in rpdo.entries(bench)? {
                let address = ((entry >> 16) as u16, (entry >> 8) as u8);
                let can_be_read = bench.eds.get(address).is_some_and(|entry| entry.can_be_read());
                let mut value = match can_be_read {
                    true => bench.read(address)?,
                    false => vec![0; (entry & 0xFF) as usize / 8],
                };
                unchanged.extend_from_slice(&value);
                if can_be_read && found.is_none() {
                    let before = value.clone();
                    value[0] ^= 1;
                    found = Some((address, [before, value.clone()]));
                }
                data.extend(value);
            }
            if let Some((address, values)) = found {
                let cob_id = cob_id as u16 & 0x7FF;
                return Ok(Self { rpdo, cob_id, data, before: unchanged, address, values });
            }
        }
        bench.skip("no RPDO changes a value that can be read")
    }

    /// The same with this transmission type, in NMT state operational.
    fn running(bench: &mut Bench, kind: u8) -> Step<Self> {
        let output = Self::of(bench)?;
        output.rpdo.set_transmission(bench, kind, 0)?;
        bench.nmt(Command::Start)?;
        bench.pass(EFFECT)?;
        Ok(output)
    }

    fn send(&self, bench: &mut Bench) -> Step {
        self.send_data(bench, &self.data)
    }

    fn send_data(&self, bench: &mut Bench, data: &[u8]) -> Step {
        bench.send(self.cob_id, data)?;
        bench.pass(EFFECT)
    }

    fn expect(&self, bench: &mut Bench, is_changed: bool, when: &str) -> Step {
        let value = bench.read(self.address)?;
        let words = if is_changed { "the value of the RPDO" } else { "unchanged" };
        bench.check(
            value == self.values[usize::from(is_changed)],
            format!("{} is {words} {when}", name(self.address)),
        )
    }
}

fn sync(bench: &mut Bench) -> Step {
    bench.sync(&[])?;
    bench.pass(EFFECT)
}

fn synchronous_rpdo(bench: &mut Bench) -> Step {
    let output = Output::of(bench)?;
    output.rpdo.set_transmission(bench, 0, 0)?;
    bench.nmt(Command::Start)?;
    output.send(bench)?;
    output.expect(bench, false, "before SYNC")?;
    sync(bench)?;
    output.expect(bench, true, "after SYNC")
}

fn window(bench: &mut Bench) -> Step {
    bench.needs((0x1007, 0))?;
    let output = Output::of(bench)?;
    bench.write((0x1007, 0), &200_000_u32.to_le_bytes())?;
    output.rpdo.set_transmission(bench, 0, 0)?;
    bench.nmt(Command::Start)?;
    sync(bench)?;
    bench.pass(ms(400))?;
    output.send(bench)?;
    sync(bench)?;
    output.expect(bench, false, "by an RPDO behind the window")?;
    output.send(bench)?;
    sync(bench)?;
    output.expect(bench, true, "by an RPDO within the window")
}

fn sync_without_counter(bench: &mut Bench) -> Step {
    bench.needs((0x1019, 0))?;
    synchronization::end_period(bench)?;
    bench.write((0x1019, 0), &[10])?;
    let (_, cob_id) = synchronous_tpdos(bench)?[0];
    bench.nmt(Command::Start)?;
    bench.pass(EFFECT)?;
    for (counter, count) in [(&[][..], 0), (&[1], 1)] {
        bench.sync(counter)?;
        let frames = bench.collect(ms(200), cob_id)?;
        let expected =
            format!("{count} times {cob_id:03X} for a SYNC with {} bytes", counter.len());
        bench.check(frames.len() == count, expected)?;
    }
    Ok(())
}

fn emergency_inhibit_time(bench: &mut Bench) -> Step {
    bench.needs((0x1015, 0))?;
    bench.write((0x1015, 0), &2_000_u16.to_le_bytes())?;
    let (rpdo, cob_id) = pdo::valid(bench, &[Direction::Receive])?[0];
    rpdo.set_transmission(bench, 254, 0)?;
    let right = vec![0; rpdo.len(bench)?];
    bench.nmt(Command::Start)?;
    bench.pass(EFFECT)?;
    // Of the wrong length, and of the right one: an error and its end.
    for data in [&[][..], &right] {
        bench.send(cob_id as u16 & 0x7FF, data)?;
    }
    let messages = bench.collect(ms(1_000), 0x80 + u16::from(bench.node))?;
    bench.check(messages.len() > 1, "two emergency messages: the error and its end")?;
    check_gaps(bench, &messages, 200)
}

fn no_emergency(bench: &mut Bench) -> Step {
    bench.needs((0x1014, 0))?;
    let cob_id = bench.number((0x1014, 0))? as u32;
    bench.write((0x1014, 0), &(cob_id | INVALID).to_le_bytes())?;
    let messages = emergency::force(bench)?;
    bench.check(messages.is_empty(), "no emergency message")?;
    let register = bench.number((0x1001, 0))?;
    bench.check(register != 0, "an error in 1001h")
}

fn clear_history(bench: &mut Bench) -> Step {
    bench.needs((0x1003, 1))?;
    emergency::force(bench)?;
    let count = bench.number((0x1003, 0))?;
    bench.check(count > 0, "an error in 1003h")?;
    bench.write((0x1003, 0), &[0])?;
    emergency::no_history(bench)
}

fn error_behaviour(bench: &mut Bench, behaviour: u8, state: u8) -> Step {
    bench.needs((0x1029, 1))?;
    bench.write((0x1029, 1), &[behaviour])?;
    heartbeat::lost(bench, state)
}

fn heartbeat_restart(bench: &mut Bench) -> Step {
    bench.needs((0x1017, 0))?;
    let cob_id = 0x700 + u16::from(bench.node);
    heartbeat::set_producer(bench, 1_000)?;
    let beat = bench.wait_for(ms(2_000), |frame| frame.cob_id() == cob_id)?;
    bench.check(beat.is_some(), format!("{cob_id:03X}: the heartbeat"))?;
    bench.pass(ms(600))?;
    heartbeat::set_producer(bench, 1_000)?;
    let written = bench.now();
    // The first one may follow the write at once.
    bench.pass(ms(100))?;
    let early = bench.collect(ms(800), cob_id)?;
    bench.check(early.is_empty(), "no heartbeat of the time before")?;
    let beat = bench.wait_for(ms(1_100), |frame| frame.cob_id() == cob_id)?;
    let latest = written + ms(1_100) + bench.jitter;
    let is_punctual = beat.is_some_and(|(time, _)| time <= latest);
    bench.check(is_punctual, format!("{cob_id:03X} 1 s after the write"))
}

/// Writes a value of eight bytes by a block download whose first segment is lost at first. The bits `wrong` of its CRC
/// are wrong.
fn repeated_download(bench: &mut Bench, wrong: u16) -> Step {
    let entry = sdo::find(bench, "writable value of eight bytes", |entry| {
        let is_plain = entry.kind() != Kind::Domain && !entry.acts_on_write();
        let can_be = entry.can_be_written() && entry.can_be_read();
        is_plain && can_be && entry.size() == Some(8)
    })?;
    let before = bench.read(entry.address)?;
    let data: Vec<u8> = (1..).zip(&before).map(|(place, byte)| byte ^ place).collect();
    let answer = bench.ask(initiate(0xC6, entry.address, 8))?;
    if abort_code(&answer) == Some(abort::UNKNOWN_COMMAND) {
        return bench.skip("the device has no block transfer");
    }
    bench.check(answer[0] == 0xA4, "A4: a block download with CRC")?;
    let answer = bench.ask(segment(0x82, &data[7..]))?;
    bench.check(answer[..2] == [0xA2, 0], "A2 00: the first segment is missing")?;
    bench.say(segment(0x01, &data[..7]))?;
    let answer = bench.ask(segment(0x82, &data[7..]))?;
    bench.check(answer[..2] == [0xA2, 2], "A2 02: both segments are confirmed")?;
    // Six bytes of the last segment are unused.
    let end = segment(0xC1 | 6 << 2, &(crc(&data) ^ wrong).to_le_bytes());
    if wrong == 0 {
        let answer = bench.ask(end)?;
        bench.check(answer[0] == 0xA1, "A1: the transfer is complete")?;
    } else {
        bench.expect_abort(end, &[abort::WRONG_CRC, abort::GENERAL])?;
    }
    let value = bench.read(entry.address)?;
    let (expected, words) = if wrong == 0 { (data, "new") } else { (before, "old") };
    bench.check(value == expected, format!("{} has its {words} value", name(entry.address)))
}
