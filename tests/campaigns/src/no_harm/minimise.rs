//! Minimises a failing situation: fewer events, fewer boards, shorter times.

use std::time::{Duration, Instant};

use super::situation::{Master, Node, Situation, What};

/// The time limit.
const PATIENCE: Duration = Duration::from_secs(60);
/// The milliseconds by which times are cut down in one step.
const CUTS: [u32; 4] = [5_000, 1_000, 200, 50];

/// Makes a failing situation smaller as long as it `fails`.
pub fn minimise(mut situation: Situation, fails: impl Fn(&Situation) -> bool) -> Situation {
    let begin = Instant::now();
    loop {
        let smaller = candidates(&situation)
            .into_iter()
            .take_while(|_| begin.elapsed() < PATIENCE)
            .find(|candidate| fails(candidate));
        match smaller {
            Some(smaller) => situation = smaller,
            None => return situation,
        }
    }
}

/// The situations that are one step smaller, the smallest first.
fn candidates(situation: &Situation) -> Vec<Situation> {
    let mut candidates = Vec::new();
    let mut add = |change: &dyn Fn(&mut Situation)| {
        let mut candidate = situation.clone();
        change(&mut candidate);
        if candidate != *situation {
            candidates.push(candidate);
        }
    };
    if situation.boards.len() > 1 {
        for board in (0..situation.boards.len()).rev() {
            add(&|candidate| remove_board(candidate, board));
        }
    }
    for event in (0..situation.events.len()).rev() {
        add(&|candidate| {
            candidate.events.remove(event);
        });
    }
    let ends = || situation.events.iter().flat_map(|event| [event.at, event.until]);
    let before = |at: u32| (ends().filter(|end| *end < at).max().unwrap_or(0), at);
    let events = situation.events.iter();
    let spans: Vec<_> = events
        .flat_map(|event| [(event.at, event.until), before(event.at)])
        .chain([before(situation.probe.at)])
        .collect();
    for cut in CUTS {
        for &(_, to) in spans.iter().filter(|(from, to)| from + cut < *to) {
            add(&|candidate| pull(candidate, to, cut));
        }
    }
    for event in 0..situation.events.len() {
        add(&|candidate| simplify(&mut candidate.events[event].what));
    }
    for board in 0..situation.boards.len() {
        add(&|candidate| candidate.boards[board].heartbeat_ms = 0);
        add(&|candidate| {
            let Node { node_id, .. } = &mut candidate.boards[board];
            *node_id = node_id.map(|_| board as u8 + 1);
        });
    }
    candidates
}

/// Removes a board and its events.
fn remove_board(situation: &mut Situation, removed: usize) {
    situation.boards.remove(removed);
    situation.events.retain_mut(|event| match &mut event.what {
        What::NoPower(board) | What::BrokenWire(board) | What::BitError(board) => {
            let remains = *board != removed;
            *board -= usize::from(*board > removed);
            remains
        }
        _ => true,
    });
}

/// Moves all times from `from` on forward by `cut`.
fn pull(situation: &mut Situation, from: u32, cut: u32) {
    let earlier = |at: &mut u32| {
        if *at >= from {
            *at = at.saturating_sub(cut);
        }
    };
    for event in &mut situation.events {
        earlier(&mut event.at);
        earlier(&mut event.until);
        event.until = event.until.max(event.at);
    }
    earlier(&mut situation.probe.at);
}

fn simplify(what: &mut What) {
    match what {
        What::Master(master) => {
            if let Some(rate) = master.bit_rate() {
                *master = Master::Idle(rate);
            }
        }
        What::Switch { is_stored, .. } => *is_stored = false,
        What::Foreign(foreign) => foreign.has_companion = false,
        _ => {}
    }
}
