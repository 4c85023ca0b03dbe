//! State 01..04 and Transition 01..04: the NMT slave (CiA 301, 7.3.2).

use std::time::Duration;

use testkit::sdo_messages::initiate;

use crate::{
    Bench, Case, Command, Group, Step,
    bench::{hex, name},
    eds::Entry,
    heartbeat::{check_state, set_producer},
    ms,
    pdo::{self, Direction},
    synchronization,
};

pub const STATES: Group =
    Group { name: "State", prepare: |bench| bench.restore(), cases: STATE_CASES };
pub const TRANSITIONS: Group =
    Group { name: "Transition", prepare: |bench| bench.restore(), cases: TRANSITION_CASES };

const STATE_CASES: &[Case] = &[
    Case::new("Initialisation: boot-up, and the defaults of all parameters", initialisation),
    Case::new("Pre-operational: SDO, SYNC and heartbeat, but no PDO", |bench| {
        services(bench, Command::EnterPreOperational, PRE_OPERATIONAL)
    }),
    Case::new("Operational: SDO, SYNC, heartbeat and PDO", |bench| {
        services(bench, Command::Start, OPERATIONAL)
    }),
    Case::new("Stopped: heartbeat, but neither SDO nor SYNC nor PDO", |bench| {
        services(bench, Command::Stop, STOPPED)
    }),
];

const TRANSITION_CASES: &[Case] = &[
    Case::new("Reset node and reset communication lead to pre-operational", resets),
    Case::new("Enter pre-operational works from every state", |bench| {
        transitions(bench, &[Start, EnterPreOperational, Stop, EnterPreOperational])
    }),
    Case::new("Start works from every state", |bench| transitions(bench, &[Start, Stop, Start])),
    Case::new("Stop works from every state", |bench| transitions(bench, &[Stop, Start, Stop])),
];

use Command::{EnterPreOperational, Start, Stop};

/// The states as a heartbeat reports them.
const PRE_OPERATIONAL: u8 = 127;
const OPERATIONAL: u8 = 5;
const STOPPED: u8 = 4;
const HEARTBEAT_MS: u16 = 500;
const TIMER_MS: u16 = 100;
/// How long SYNC is waited for, and how long it must stay away.
const SYNC_SPAN: Duration = ms(1_000);
/// A number for the values of initialisation, always the same.
const SEED: u32 = 0x2024_1301;

fn resets(bench: &mut Bench) -> Step {
    bench.needs((0x1017, 0))?;
    for reset in [Command::ResetNode, Command::ResetCommunication] {
        bench.reset(reset)?;
        set_producer(bench, HEARTBEAT_MS)?;
        check_state(bench, PRE_OPERATIONAL)?;
        bench.nmt(Start)?;
        check_state(bench, OPERATIONAL)?;
    }
    bench.reset(Command::ResetCommunication)
}

fn transitions(bench: &mut Bench, commands: &[Command]) -> Step {
    bench.needs((0x1017, 0))?;
    set_producer(bench, HEARTBEAT_MS)?;
    check_state(bench, PRE_OPERATIONAL)?;
    for command in commands {
        bench.nmt(*command)?;
        let state = match command {
            Start => OPERATIONAL,
            Stop => STOPPED,
            _ => PRE_OPERATIONAL,
        };
        check_state(bench, state)?;
    }
    Ok(())
}

/// The next of a series of numbers (xorshift).
fn next(state: &mut u32) -> u32 {
    *state ^= *state << 13;
    *state ^= *state >> 17;
    *state ^= *state << 5;
    *state
}

fn initialisation(bench: &mut Bench) -> Step {
    let is_parameter = |entry: &&Entry| {
        let acts = entry.acts_on_write() || matches!(entry.address.0, 0x1010 | 0x1011);
        (0x1000..0x2000).contains(&entry.address.0)
            && entry.is_number()
            && entry.can_be_read()
            && entry.can_be_written()
            && !acts
    };
    let parameters: Vec<Entry> = bench.eds.entries().filter(is_parameter).cloned().collect();
    let mut before = Vec::new();
    for entry in &parameters {
        before.push(bench.read(entry.address)?);
    }
    let mut random = SEED;
    for entry in &parameters {
        // The device may refuse it.
        let _ =
            bench.download(entry.address, &entry.of_number((next(&mut random) & 0x7FFF).into()))?;
    }
    bench.reset(Command::ResetNode)?;
    // Without 1011h the device keeps what was stored before.
    let is_restored = bench.eds.get((0x1011, 1)).is_some();
    for (entry, before) in parameters.iter().zip(before) {
        let default = entry.default(bench.node).filter(|_| is_restored);
        let expected = default.unwrap_or(before);
        let after = bench.read(entry.address)?;
        let is_right = after == expected;
        bench.check(is_right, format!("{} is {} again", name(entry.address), hex(&expected)))?;
    }
    if bench.eds.get((0x1017, 0)).is_some() {
        set_producer(bench, HEARTBEAT_MS)?;
        check_state(bench, PRE_OPERATIONAL)?;
    }
    Ok(())
}

/// What a step gives, or `None` if the device lacks what it needs.
fn if_possible<T>(step: Step<T>) -> Step<Option<T>> {
    match step {
        Ok(value) => Ok(Some(value)),
        Err(crate::Stop::Skipped(_)) => Ok(None),
        Err(stop) => Err(stop),
    }
}

/// Whether SDO, heartbeat, PDO and the SYNC producer work in an NMT state as they must.
fn services(bench: &mut Bench, command: Command, state: u8) -> Step {
    bench.needs((0x1017, 0))?;
    set_producer(bench, HEARTBEAT_MS)?;
    let is_producer = if_possible(synchronization::produce(bench))?.is_some();
    let tpdos = if_possible(pdo::valid(bench, &[Direction::Transmit]))?;
    let tpdo = tpdos.and_then(|tpdos| tpdos.first().copied());
    if let Some((pdo, _)) = tpdo {
        pdo.set_transmission(bench, 254, TIMER_MS)?;
    }
    bench.nmt(command)?;
    check_state(bench, state)?;
    let request = initiate(0x40, (0x1000, 0), 0);
    match state {
        STOPPED => bench.expect_silence(request)?,
        _ => drop(bench.ask(request)?),
    }
    if is_producer {
        let is_there = !bench.collect(SYNC_SPAN, synchronization::COB_ID as u16)?.is_empty();
        bench.check(is_there == (state != STOPPED), "SYNC, but not in NMT state stopped")?;
    }
    let Some((_, cob_id)) = tpdo else { return Ok(()) };
    let cob_id = cob_id as u16 & 0x7FF;
    bench.sync(&[])?;
    let count = bench.collect(ms(1_000), cob_id)?.len();
    match state {
        OPERATIONAL => bench.check(count > 0, format!("{cob_id:03X} within a second")),
        _ => bench.check(count == 0, format!("no {cob_id:03X} in this state")),
    }
}
