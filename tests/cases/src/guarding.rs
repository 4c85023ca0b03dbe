//! Guarding 01..06, and Heartbeat versus guarding 01..07: node guarding and life guarding (CiA 301, 7.2.8.3.2.1).

use crate::{Bench, Case, Group, Step, emergency, heartbeat, ms};

pub const GROUP: Group = Group { name: "Guarding", prepare: |bench| bench.restore(), cases: CASES };

pub const VERSUS_HEARTBEAT: Group = Group {
    name: "Heartbeat versus guarding",
    prepare: |bench| bench.restore(),
    cases: VERSUS_HEARTBEAT_CASES,
};

const CASES: &[Case] = &[
    Case::new("100Ch and 100Dh can be read", read),
    Case::new("A remote frame is answered with the NMT state", answer),
    Case::new("The toggle bit alternates", toggle),
    Case::new("Remote frames for other nodes are not answered", other_nodes),
    Case::new("100Ch and 100Dh can be written", write),
    Case::new("Life guarding notices that the remote frames end", life_guarding),
];

const VERSUS_HEARTBEAT_CASES: &[Case] = &[
    Case::new("The device has a heartbeat or guarding", has_error_control),
    Case::new("The heartbeat can be switched off", |bench| both(bench, Some(0), Expected::Nothing)),
    Case::new("Guarding works without a heartbeat", |bench| {
        both(bench, Some(0), Expected::Guarding)
    }),
    Case::new("The heartbeat works without guarding", |bench| {
        both(bench, None, Expected::Heartbeat)
    }),
    Case::new("Remote frames do not end the heartbeat", |bench| {
        both(bench, None, Expected::NoGuarding)
    }),
    Case::new("The heartbeat prevails over guarding", |bench| {
        both(bench, Some(100), Expected::Heartbeat)
    }),
    Case::new("Remote frames are not answered beside the heartbeat", |bench| {
        both(bench, Some(100), Expected::NoGuarding)
    }),
];

const GUARD_TIME_MS: u16 = 100;
const LIFE_TIME_FACTOR: u8 = 3;

fn needs_guarding(bench: &Bench) -> Step {
    match bench.eds.get((0x100C, 0)).and(bench.eds.get((0x100D, 0))) {
        Some(_) => Ok(()),
        None => {
            bench.skip("the EDS has no 100Ch: CiA 301 recommends the heartbeat instead of guarding")
        }
    }
}

/// Ends the heartbeat, if there is one.
fn begin(bench: &mut Bench) -> Step {
    needs_guarding(bench)?;
    match bench.eds.get((0x1017, 0)) {
        Some(_) => heartbeat::set_producer(bench, 0),
        None => Ok(()),
    }
}

/// Sends a remote frame; returns the byte of the answer.
fn guard(bench: &mut Bench, node: u8) -> Step<Option<u8>> {
    let cob_id = 0x700 + u16::from(node);
    bench.send_remote(cob_id, 1)?;
    let answers = bench.collect(ms(GUARD_TIME_MS.into()), cob_id)?;
    Ok(answers.first().and_then(|(_, frame)| frame.data().first().copied()))
}

fn read(bench: &mut Bench) -> Step {
    needs_guarding(bench)?;
    bench.read((0x100C, 0))?;
    bench.read((0x100D, 0))?;
    Ok(())
}

fn answer(bench: &mut Bench) -> Step {
    begin(bench)?;
    let node = bench.node;
    let answer = guard(bench, node)?;
    bench.check(answer.is_some_and(|byte| byte & 0x7F == 127), "NMT state 7F")
}

fn toggle(bench: &mut Bench) -> Step {
    begin(bench)?;
    let node = bench.node;
    for toggle in [0x00, 0x80, 0x00, 0x80] {
        let answer = guard(bench, node)?;
        bench.check(answer == Some(127 | toggle), format!("{:02X}", 127 | toggle))?;
    }
    Ok(())
}

fn other_nodes(bench: &mut Bench) -> Step {
    begin(bench)?;
    let own = bench.node;
    for node in (1..=127).filter(|node| *node != own) {
        let answer = guard(bench, node)?;
        bench.check(answer.is_none(), "no answer")?;
    }
    Ok(())
}

fn set_guarding(bench: &mut Bench, time_ms: u16) -> Step {
    bench.write((0x100C, 0), &time_ms.to_le_bytes())?;
    bench.write((0x100D, 0), &[LIFE_TIME_FACTOR])
}

fn write(bench: &mut Bench) -> Step {
    begin(bench)?;
    set_guarding(bench, GUARD_TIME_MS)?;
    let time = bench.number((0x100C, 0))?;
    bench.check(time == u64::from(GUARD_TIME_MS), "100Ch has its new value")
}

fn life_guarding(bench: &mut Bench) -> Step {
    begin(bench)?;
    set_guarding(bench, GUARD_TIME_MS)?;
    let node = bench.node;
    for _ in 0..5 {
        guard(bench, node)?;
    }
    let messages = emergency::messages(bench, ms(2_000))?;
    let is_sent = messages.iter().any(|message| emergency::code(message) == 0x8130);
    bench.check(is_sent, "an emergency message with error code 8130h")
}

fn has_error_control(bench: &mut Bench) -> Step {
    match bench.eds.get((0x1017, 0)) {
        Some(_) => bench.read((0x1017, 0)).map(drop),
        None => read(bench),
    }
}

/// What comes with heartbeat and guarding set.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Expected {
    Nothing,
    Heartbeat,
    Guarding,
    /// Heartbeats, and no answer to a remote frame.
    NoGuarding,
}

/// Sets the guard time, if there is one, switches the heartbeat on if it is expected, and looks what comes.
fn both(bench: &mut Bench, guard_time_ms: Option<u16>, expected: Expected) -> Step {
    needs_guarding(bench)?;
    bench.needs((0x1017, 0))?;
    if let Some(time_ms) = guard_time_ms {
        set_guarding(bench, time_ms)?;
    }
    let has_heartbeat = matches!(expected, Expected::Heartbeat | Expected::NoGuarding);
    let interval = if has_heartbeat { 500 } else { 0 };
    heartbeat::set_producer(bench, interval)?;
    let (node, cob_id) = (bench.node, 0x700 + u16::from(bench.node));
    match expected {
        Expected::Nothing => {
            let frames = bench.collect(ms(2_000), cob_id)?;
            bench.check(frames.is_empty(), "no heartbeat")
        }
        Expected::Guarding => {
            let answer = guard(bench, node)?;
            bench.check(answer.is_some(), "an answer")
        }
        Expected::Heartbeat => heartbeat::check_state(bench, 127),
        Expected::NoGuarding => {
            // Right behind a heartbeat the next is far away.
            bench.wait_for(ms(2_000), |frame| frame.cob_id() == cob_id)?;
            let answer = guard(bench, node)?;
            bench.check(answer.is_none(), "no answer to the remote frame")?;
            heartbeat::check_state(bench, 127)
        }
    }
}
