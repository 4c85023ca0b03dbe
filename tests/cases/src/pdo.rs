//! PDO 01..33: the communication parameters and the transmission of PDOs (CiA 301, 7.2.2); the mapping is in `mapping`.

mod mapping;

use std::time::Duration;

use crate::{
    Address, Bench, Case,
    Command::{self, EnterPreOperational, Start, Stop},
    Group, Step, ms,
};
use Mode::*;
use mapping::{Kind::*, map};

pub const GROUP: Group = Group { name: "PDO", prepare: |bench| bench.restore(), cases: CASES };

const CASES: &[Case] = &[
    Case::new("The COB-ID of each RPDO can be read", |bench| scan(bench, Direction::Receive)),
    Case::new("The COB-ID of each TPDO can be read", |bench| scan(bench, Direction::Transmit)),
    Case::new("Operational: a remote frame requests a TPDO", |bench| operational(bench, Remote)),
    Case::new("Operational: an event sends a TPDO", |bench| operational(bench, EventDriven)),
    Case::new("Operational: the event timer sends a TPDO", |bench| operational(bench, EventTimer)),
    Case::new("Operational: SYNC sends a cyclic TPDO", |bench| operational(bench, Cyclic)),
    Case::new("Operational: SYNC sends an acyclic TPDO", |bench| operational(bench, Acyclic))
        .with_remark(ACYCLIC),
    Case::new("Operational: a TPDO waits for its SYNC start value", |bench| {
        operational(bench, StartValue)
    })
    .with_remark(START_VALUE),
    Case::new("Stopped: a remote frame requests no TPDO", |bench| stopped(bench, Remote)),
    Case::new("Stopped: an event sends no TPDO", |bench| stopped(bench, EventDriven)),
    Case::new("Stopped: the event timer sends no TPDO", |bench| stopped(bench, EventTimer)),
    Case::new("Stopped: SYNC sends no cyclic TPDO", |bench| stopped(bench, Cyclic)),
    Case::new("Stopped: SYNC sends no acyclic TPDO", |bench| stopped(bench, Acyclic)),
    Case::new("Stopped: no TPDO at the SYNC start value", |bench| stopped(bench, StartValue))
        .with_remark(START_VALUE),
    Case::new("Pre-operational: a remote frame requests no TPDO", |bench| {
        pre_operational(bench, Remote)
    }),
    Case::new("Pre-operational: an event sends no TPDO", |bench| {
        pre_operational(bench, EventDriven)
    }),
    Case::new("Pre-operational: the event timer sends no TPDO", |bench| {
        pre_operational(bench, EventTimer)
    }),
    Case::new("Pre-operational: SYNC sends no cyclic TPDO", |bench| pre_operational(bench, Cyclic)),
    Case::new("Pre-operational: SYNC sends no acyclic TPDO", |bench| {
        pre_operational(bench, Acyclic)
    }),
    Case::new("Pre-operational: no TPDO at the SYNC start value", |bench| {
        pre_operational(bench, StartValue)
    })
    .with_remark(START_VALUE),
    Case::new(
        "The mapping is the default, and each mapped value exists, with its length",
        mapping::default_mapping,
    ),
    Case::new("A new mapping is taken by the procedure of CiA 301", mapping::procedure)
        .with_remark(
            "The tool writes the first default value only; this case writes all of them in \
         reverse order.",
        ),
    Case::new(
        "An entry is refused while the number of entries is not 0",
        mapping::without_procedure,
    ),
    Case::new("The mapping of a valid PDO cannot be changed", mapping::valid_pdo).with_remark(
        "The tool found no valid PDO in the public log, after its own cases. Here the default ones \
         are valid.",
    ),
    Case::new("More entries than there are cannot be enabled", mapping::too_many),
    Case::new("Entries of more than 64 bits cannot be enabled", mapping::too_long),
    Case::new("An output can be mapped to an RPDO", |bench| map(bench, Output, Direction::Receive))
        .with_remark(BOTH_WAYS),
    Case::new("An input cannot be mapped to an RPDO", |bench| {
        map(bench, Input, Direction::Receive)
    }),
    Case::new("An RPDO refuses a value that cannot be mapped", |bench| {
        map(bench, Fixed, Direction::Receive)
    }),
    Case::new("An input can be mapped to a TPDO", |bench| map(bench, Input, Direction::Transmit))
        .with_remark(BOTH_WAYS),
    Case::new("A mere output cannot be mapped to a TPDO", |bench| {
        map(bench, Output, Direction::Transmit)
    }),
    Case::new("A TPDO refuses a value that cannot be mapped", |bench| {
        map(bench, Fixed, Direction::Transmit)
    }),
    Case::new("A dummy can be mapped to an RPDO", mapping::dummy),
];

const ACYCLIC: &str = "CiA 301 lets the device send at a SYNC after an event, and does not say \
    whether the start is one. This case wants a TPDO after one of two SYNCs; the tool has failed a \
    device that sent after the first alone.";
const BOTH_WAYS: &str = "The tool skipped this case in the public log. Here a value with access rw \
    counts too, since it can be mapped both ways.";
const START_VALUE: &str =
    "The tool skipped this case in the public log; the frames follow CiA 301, 7.5.2.37.";

/// Bit 31 of a COB-ID: the PDO does not exist. Bit 30: no remote frame requests it.
const INVALID: u32 = 1 << 31;
const NO_REMOTE: u32 = 1 << 30;
const TIMER_MS: u16 = 100;
/// How long a TPDO is waited for, and how long it must stay away.
const SPAN: Duration = ms(1_000);

#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    Receive,
    Transmit,
}

/// A PDO of the data sheet.
#[derive(Clone, Copy)]
pub struct Pdo {
    direction: Direction,
    /// The index of its communication parameters, and of its mapping.
    communication: u16,
    mapping: u16,
}

impl Pdo {
    pub const fn cob_id(self) -> Address {
        (self.communication, 1)
    }

    pub const fn transmission_type(self) -> Address {
        (self.communication, 2)
    }

    pub const fn inhibit_time(self) -> Address {
        (self.communication, 3)
    }

    pub const fn event_timer(self) -> Address {
        (self.communication, 5)
    }

    /// Writes a COB-ID with its flags.
    pub fn set_cob_id(self, bench: &mut Bench, cob_id: u32) -> Step {
        bench.write(self.cob_id(), &cob_id.to_le_bytes())
    }

    /// Makes the PDO invalid; returns its COB-ID before.
    pub fn close(self, bench: &mut Bench) -> Step<u32> {
        let cob_id = bench.number(self.cob_id())? as u32;
        self.set_cob_id(bench, cob_id | INVALID)?;
        Ok(cob_id)
    }

    /// Writes a transmission type, and an event timer where the data sheet has one, while the PDO is invalid.
    pub fn set_transmission(self, bench: &mut Bench, kind: u8, timer_ms: u16) -> Step {
        let cob_id = self.close(bench)?;
        bench.write(self.transmission_type(), &[kind])?;
        if bench.eds.get((self.communication, 5)).is_some() {
            bench.write((self.communication, 5), &timer_ms.to_le_bytes())?;
        }
        self.set_cob_id(bench, cob_id)
    }
}

/// The PDOs of the data sheet; the case is skipped if there are none.
fn pdos(bench: &Bench, directions: &[Direction]) -> Step<Vec<Pdo>> {
    let mut all = Vec::new();
    for &direction in directions {
        let (first, mapping): (u16, u16) = match direction {
            Direction::Receive => (0x1400, 0x1600),
            Direction::Transmit => (0x1800, 0x1A00),
        };
        let numbers = (0..0x200).filter(|number| bench.eds.get((first + number, 1)).is_some());
        all.extend(numbers.map(|number| Pdo {
            direction,
            communication: first + number,
            mapping: mapping + number,
        }));
    }
    let name = match directions {
        [Direction::Receive] => "RPDO",
        [Direction::Transmit] => "TPDO",
        _ => "PDO",
    };
    if all.is_empty() { bench.skip(format!("the EDS has no {name}")) } else { Ok(all) }
}

/// The PDOs that are valid and have a mapping, with their COB-IDs and flags; the case is skipped if there are none.
pub fn valid(bench: &mut Bench, directions: &[Direction]) -> Step<Vec<(Pdo, u32)>> {
    let mut valid = Vec::new();
    for pdo in pdos(bench, directions)? {
        let cob_id = bench.number(pdo.cob_id())? as u32;
        if cob_id & INVALID == 0 && bench.number((pdo.mapping, 0))? > 0 {
            valid.push((pdo, cob_id));
        }
    }
    if valid.is_empty() { bench.skip("no PDO is valid and mapped by default") } else { Ok(valid) }
}

fn scan(bench: &mut Bench, direction: Direction) -> Step {
    for pdo in pdos(bench, &[direction])? {
        let cob_id = bench.number(pdo.cob_id())? as u32;
        bench.check(cob_id & 0x1FFF_FFFF != 0, "a COB-ID that is not 0")?;
    }
    Ok(())
}

/// What makes a TPDO go.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Mode {
    Remote,
    EventDriven,
    EventTimer,
    Cyclic,
    Acyclic,
    StartValue,
}

fn operational(bench: &mut Bench, mode: Mode) -> Step {
    transmission(bench, mode, Start)
}

fn stopped(bench: &mut Bench, mode: Mode) -> Step {
    transmission(bench, mode, Stop)
}

fn pre_operational(bench: &mut Bench, mode: Mode) -> Step {
    transmission(bench, mode, EnterPreOperational)
}

/// Each TPDO that is valid by default is sent in NMT state operational, and not in the others.
fn transmission(bench: &mut Bench, mode: Mode, state: Command) -> Step {
    let mut pdos = valid(bench, &[Direction::Transmit])?;
    pdos.retain(|(_, cob_id)| mode != Remote || cob_id & NO_REMOTE == 0);
    if pdos.is_empty() {
        return bench.skip("the device has no TPDO that a remote frame may request");
    }
    for (pdo, cob_id) in pdos {
        configure(bench, pdo, mode)?;
        bench.nmt(state)?;
        stimulate(bench, mode, cob_id as u16 & 0x7FF, state == Start)?;
        bench.nmt(EnterPreOperational)?;
        bench.pass(ms(10))?;
        pdo.close(bench)?;
    }
    Ok(())
}

fn configure(bench: &mut Bench, pdo: Pdo, mode: Mode) -> Step {
    match mode {
        Remote => pdo.set_transmission(bench, 254, 0),
        EventDriven | EventTimer => {
            bench.needs((pdo.communication, 5))?;
            pdo.set_transmission(bench, 254, TIMER_MS)
        }
        Cyclic => pdo.set_transmission(bench, 1, 0),
        Acyclic => pdo.set_transmission(bench, 0, 0),
        StartValue => {
            bench.needs((0x1019, 0))?;
            bench.needs((pdo.communication, 6))?;
            bench.write((0x1019, 0), &[10])?;
            let cob_id = pdo.close(bench)?;
            bench.write((pdo.communication, 6), &[3])?;
            pdo.set_cob_id(bench, cob_id)?;
            pdo.set_transmission(bench, 1, 0)
        }
    }
}

/// Does what makes the TPDO go, and checks whether it goes.
fn stimulate(bench: &mut Bench, mode: Mode, cob_id: u16, is_sent: bool) -> Step {
    let is_synchronous = matches!(mode, Cyclic | Acyclic | StartValue);
    // The start itself may be an event.
    let at_start = bench.collect(if is_synchronous { SPAN / 2 } else { ms(50) }, cob_id)?;
    let frames = match mode {
        Remote => {
            bench.send_remote(cob_id, 8)?;
            bench.collect(SPAN, cob_id)?
        }
        EventDriven | EventTimer => bench.collect(SPAN, cob_id)?,
        Cyclic | Acyclic => {
            let mut frames = Vec::new();
            for _ in 0..2 {
                bench.sync(&[])?;
                let sent = bench.collect(SPAN / 2, cob_id)?;
                bench.check(sent.len() <= 1, format!("at most one {cob_id:03X} for a SYNC"))?;
                frames.extend(sent);
            }
            frames
        }
        StartValue => {
            let mut early = Vec::new();
            for counter in 1..=2 {
                bench.sync(&[counter])?;
                early.extend(bench.collect(SPAN / 4, cob_id)?);
            }
            bench.check(
                early.is_empty(),
                format!("no {cob_id:03X} before the SYNC with counter 3"),
            )?;
            bench.sync(&[3])?;
            bench.collect(SPAN / 4, cob_id)?
        }
    };
    if !is_sent {
        let is_silent = frames.is_empty() && at_start.is_empty();
        return bench.check(is_silent, format!("no {cob_id:03X} in this NMT state"));
    }
    if is_synchronous {
        bench.check(at_start.is_empty(), format!("no {cob_id:03X} before a SYNC"))?;
    }
    bench.check(!frames.is_empty(), format!("{cob_id:03X} within {SPAN:?}"))?;
    match mode {
        Cyclic => {
            bench.check(frames.len() == 2, format!("one {cob_id:03X} for each of two SYNCs"))?;
        }
        StartValue => {
            bench.check(frames.len() == 1, format!("one {cob_id:03X} for the SYNC"))?;
        }
        _ => {}
    }
    if mode != EventTimer {
        return Ok(());
    }
    let period = ms(TIMER_MS.into());
    let tolerance = period / 10 + bench.jitter;
    let is_punctual =
        frames.windows(2).all(|pair| (pair[1].0 - pair[0].0).abs_diff(period) <= tolerance);
    bench.check(is_punctual && frames.len() > 5, format!("{cob_id:03X} every {period:?}"))
}
