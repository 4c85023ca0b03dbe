//! The least of a situation that still fails: fewer events, fewer boards, shorter times.

use std::time::{Duration, Instant};

use super::situation::{Master, Node, Situation, What};

/// How long it is tried.
const PATIENCE: Duration = Duration::from_secs(60);
/// Times are cut down by so many milliseconds at once.
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

/// The situations that are one step smaller, those that lack most first.
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
    for cut in CUTS {
        for event in 0..situation.events.len() {
            add(&|candidate| shorten(candidate, event, cut));
        }
        for event in 0..=situation.events.len() {
            add(&|candidate| move_earlier(candidate, event, cut));
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

/// Without a board, and what happens to it.
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

/// An event ends earlier, and all that begins or ends after it as well.
fn shorten(situation: &mut Situation, event: usize, cut: u32) {
    let shortened = situation.events[event];
    if shortened.until <= shortened.at + cut {
        return;
    }
    pull(situation, shortened.until, cut);
}

/// An event, or after the last the probe, comes earlier after the one before, and all that follows as well.
fn move_earlier(situation: &mut Situation, event: usize, cut: u32) {
    let before = |at: u32| {
        let ends = situation.events.iter().flat_map(|event| [event.at, event.until]);
        ends.filter(|end| *end < at).max().unwrap_or(0)
    };
    let at = situation.events.get(event).map_or(situation.probe.at, |event| event.at);
    if before(at) + cut <= at {
        pull(situation, at, cut);
    }
}

/// Brings all that is at `from` or later forward by `cut`.
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
