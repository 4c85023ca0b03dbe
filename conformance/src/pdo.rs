//! PDO 01..33: the communication parameters and the transmission of PDOs (CiA 301, 7.2.2); the mapping is in `mapping`.

mod mapping;

use crate::{Address, Bench, Case, Command, Group, Step, ms};

pub const GROUP: Group = Group { name: "PDO", prepare: |bench| bench.restore(), cases: CASES };

const CASES: &[Case] = &[
    Case::new("The COB-ID of each RPDO can be read", |bench| scan(bench, Direction::Receive)),
    Case::new("The COB-ID of each TPDO can be read", |bench| scan(bench, Direction::Transmit)),
    Case::new("Operational: a remote frame requests a TPDO", |bench| {
        transmission(bench, Mode::Remote, Command::Start)
    }),
    Case::new("Operational: an event-driven TPDO is sent", |bench| {
        transmission(bench, Mode::EventDriven, Command::Start)
    }),
    Case::new("Operational: the event timer sends a TPDO", |bench| {
        transmission(bench, Mode::EventTimer, Command::Start)
    }),
    Case::new("Operational: SYNC sends a cyclic TPDO", |bench| {
        transmission(bench, Mode::Cyclic, Command::Start)
    }),
    Case::new("Operational: SYNC sends an acyclic TPDO", |bench| {
        transmission(bench, Mode::Acyclic, Command::Start)
    })
    .with_remark(ACYCLIC),
    Case::new("Operational: a cyclic TPDO waits for its SYNC start value", |bench| {
        transmission(bench, Mode::StartValue, Command::Start)
    })
    .with_remark(START_VALUE),
    Case::new("Stopped: a remote frame requests no TPDO", |bench| {
        transmission(bench, Mode::Remote, Command::Stop)
    }),
    Case::new("Stopped: no event-driven TPDO is sent", |bench| {
        transmission(bench, Mode::EventDriven, Command::Stop)
    }),
    Case::new("Stopped: the event timer sends no TPDO", |bench| {
        transmission(bench, Mode::EventTimer, Command::Stop)
    }),
    Case::new("Stopped: SYNC sends no cyclic TPDO", |bench| {
        transmission(bench, Mode::Cyclic, Command::Stop)
    }),
    Case::new("Stopped: SYNC sends no acyclic TPDO", |bench| {
        transmission(bench, Mode::Acyclic, Command::Stop)
    }),
    Case::new("Stopped: the SYNC start value sends no TPDO", |bench| {
        transmission(bench, Mode::StartValue, Command::Stop)
    })
    .with_remark(START_VALUE),
    Case::new("Pre-operational: a remote frame requests no TPDO", |bench| {
        transmission(bench, Mode::Remote, Command::EnterPreOperational)
    }),
    Case::new("Pre-operational: no event-driven TPDO is sent", |bench| {
        transmission(bench, Mode::EventDriven, Command::EnterPreOperational)
    }),
    Case::new("Pre-operational: the event timer sends no TPDO", |bench| {
        transmission(bench, Mode::EventTimer, Command::EnterPreOperational)
    }),
    Case::new("Pre-operational: SYNC sends no cyclic TPDO", |bench| {
        transmission(bench, Mode::Cyclic, Command::EnterPreOperational)
    }),
    Case::new("Pre-operational: SYNC sends no acyclic TPDO", |bench| {
        transmission(bench, Mode::Acyclic, Command::EnterPreOperational)
    }),
    Case::new("Pre-operational: the SYNC start value sends no TPDO", |bench| {
        transmission(bench, Mode::StartValue, Command::EnterPreOperational)
    })
    .with_remark(START_VALUE),
    mapping::DEFAULT,
    mapping::PROCEDURE,
    mapping::WITHOUT_PROCEDURE,
    mapping::VALID_PDO,
    mapping::TOO_MANY,
    mapping::TOO_LONG,
    mapping::RECEIVE_OUTPUT,
    mapping::RECEIVE_INPUT,
    mapping::RECEIVE_UNMAPPABLE,
    mapping::TRANSMIT_INPUT,
    mapping::TRANSMIT_OUTPUT,
    mapping::TRANSMIT_UNMAPPABLE,
    mapping::DUMMY,
];

const ACYCLIC: &str = "CiA 301 lets the device send at a SYNC after an event, and does not say whether the start is one. \
    This case wants a TPDO after one of two SYNCs; the tool has failed a device that sent after the first alone.";
const START_VALUE: &str =
    "The tool skipped this case in the public log; the frames follow CiA 301, 7.5.2.37.";

/// Bit 31 of a COB-ID: the PDO does not exist. Bit 30: no remote frame requests it.
const INVALID: u32 = 1 << 31;
const NO_REMOTE: u32 = 1 << 30;
const TIMER_MS: u16 = 100;
/// How long a TPDO is waited for, and how long it must stay away.
const WAIT: std::time::Duration = ms(1_000);

#[derive(Clone, Copy, PartialEq, Eq)]
enum Direction {
    Receive,
    Transmit,
}

/// A PDO of the data sheet.
#[derive(Clone, Copy)]
struct Pdo {
    direction: Direction,
    /// The index of its communication parameters, and of its mapping.
    communication: u16,
    mapping: u16,
}

impl Pdo {
    const fn cob_id(self) -> Address {
        (self.communication, 1)
    }

    /// Writes a COB-ID with its flags.
    fn set_cob_id(self, bench: &mut Bench, cob_id: u32) -> Step {
        bench.write(self.cob_id(), &cob_id.to_le_bytes())
    }

    /// Makes the PDO invalid; returns its COB-ID before.
    fn close(self, bench: &mut Bench) -> Step<u32> {
        let cob_id = bench.number(self.cob_id())? as u32;
        self.set_cob_id(bench, cob_id | INVALID)?;
        Ok(cob_id)
    }
}

/// The PDOs of the data sheet; the case is skipped if there are none.
fn pdos(bench: &Bench, direction: Direction) -> Step<Vec<Pdo>> {
    let (first, mapping, name): (u16, u16, _) = match direction {
        Direction::Receive => (0x1400, 0x1600, "RPDO"),
        Direction::Transmit => (0x1800, 0x1A00, "TPDO"),
    };
    let pdo =
        |number: u16| Pdo { direction, communication: first + number, mapping: mapping + number };
    let exists = |pdo: &Pdo| bench.eds.get(pdo.cob_id()).is_some();
    let all: Vec<Pdo> = (0..0x200).map(pdo).filter(exists).collect();
    if all.is_empty() { bench.skip(format!("the EDS has no {name}")) } else { Ok(all) }
}

fn scan(bench: &mut Bench, direction: Direction) -> Step {
    for pdo in pdos(bench, direction)? {
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

impl Mode {
    /// The transmission type.
    const fn transmission_type(self) -> u8 {
        match self {
            Self::Remote | Self::EventDriven | Self::EventTimer => 254,
            Self::Cyclic | Self::StartValue => 1,
            Self::Acyclic => 0,
        }
    }
}

/// Each TPDO that is valid by default is sent in NMT state operational, and not in the others.
fn transmission(bench: &mut Bench, mode: Mode, state: Command) -> Step {
    let mut tried = false;
    for pdo in pdos(bench, Direction::Transmit)? {
        bench.nmt(Command::EnterPreOperational)?;
        let cob_id = bench.number(pdo.cob_id())? as u32;
        let is_fit = mode != Mode::Remote || cob_id & NO_REMOTE == 0;
        if cob_id & INVALID != 0 || !is_fit {
            continue;
        }
        tried = true;
        pdo.set_cob_id(bench, cob_id | INVALID)?;
        bench.write((pdo.communication, 2), &[mode.transmission_type()])?;
        configure(bench, pdo, mode)?;
        pdo.set_cob_id(bench, cob_id)?;
        bench.nmt(state)?;
        stimulate(bench, mode, cob_id as u16 & 0x7FF, state == Command::Start)?;
        bench.nmt(Command::EnterPreOperational)?;
        bench.pass(ms(10))?;
        pdo.set_cob_id(bench, cob_id | INVALID)?;
    }
    let what = if mode == Mode::Remote {
        "valid TPDO that a remote frame may request"
    } else {
        "valid TPDO"
    };
    if tried { Ok(()) } else { bench.skip(format!("the device has no {what}")) }
}

/// Sets what the mode needs besides the transmission type.
fn configure(bench: &mut Bench, pdo: Pdo, mode: Mode) -> Step {
    match mode {
        Mode::EventDriven | Mode::EventTimer => {
            bench.needs((pdo.communication, 5))?;
            bench.write((pdo.communication, 5), &TIMER_MS.to_le_bytes())
        }
        Mode::StartValue => {
            bench.needs((0x1019, 0))?;
            bench.needs((pdo.communication, 6))?;
            bench.write((0x1019, 0), &[10])?;
            bench.write((pdo.communication, 6), &[3])
        }
        Mode::Remote | Mode::Cyclic | Mode::Acyclic => Ok(()),
    }
}

/// Does what makes the TPDO go, and checks whether it goes.
fn stimulate(bench: &mut Bench, mode: Mode, cob_id: u16, is_sent: bool) -> Step {
    // The start itself may be an event.
    let at_start = bench.collect(ms(50), cob_id)?;
    let frames = match mode {
        Mode::Remote => {
            bench.send_remote(cob_id, 8)?;
            bench.collect(WAIT, cob_id)?
        }
        Mode::EventDriven | Mode::EventTimer => bench.collect(WAIT, cob_id)?,
        Mode::Cyclic | Mode::Acyclic => {
            bench.sync(&[])?;
            let mut frames = bench.collect(WAIT / 2, cob_id)?;
            bench.sync(&[])?;
            frames.extend(bench.collect(WAIT / 2, cob_id)?);
            frames
        }
        Mode::StartValue => {
            let mut early = Vec::new();
            for counter in 1..=2 {
                bench.sync(&[counter])?;
                early.extend(bench.collect(WAIT / 4, cob_id)?);
            }
            bench.check(
                early.is_empty(),
                format!("no {cob_id:03X} before the SYNC with counter 3"),
            )?;
            bench.sync(&[3])?;
            bench.collect(WAIT / 4, cob_id)?
        }
    };
    if !is_sent {
        let is_silent = frames.is_empty() && at_start.is_empty();
        return bench.check(is_silent, format!("no {cob_id:03X} in this NMT state"));
    }
    bench.check(!frames.is_empty(), format!("{cob_id:03X} within {WAIT:?}"))?;
    if mode == Mode::Cyclic {
        bench.check(frames.len() == 2, format!("one {cob_id:03X} for each of two SYNCs"))?;
    }
    if mode != Mode::EventTimer {
        return Ok(());
    }
    let period = ms(TIMER_MS.into());
    let tolerance = period / 10 + bench.jitter();
    let is_punctual =
        frames.windows(2).all(|pair| (pair[1].0 - pair[0].0).abs_diff(period) <= tolerance);
    bench.check(is_punctual && frames.len() > 5, format!("{cob_id:03X} every {period:?}"))
}
