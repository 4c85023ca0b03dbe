//! The requirements on a run: no board is reached later than the plain slave, and every lost board is found.

use std::fmt;

use canopen_node::BitRate;
use emulator::{Time, chip::Part, image::Image};

use super::{
    draw::SESSION,
    life::{FRAME_BITS, Life, POLL},
    situation::{Situation, ms},
};
use testkit::wire::bit_per_s;

/// The allowed delay of a board that is proven at its rate against the plain slave, unless [`LATE_FRAMES`] take longer.
const LATE: Time = Time::from_ms(200);
const LATE_FRAMES: u64 = 25;
/// The time after the end of a disturbance in which a board that is not proven must be back.
const BACK: Time = Time::from_s(5);
/// The longest pause of a board that nobody acknowledges, and its repetition before.
const PAUSE: Time = Time::from_ms(760);
/// The time for which a board that was led away repeats a frame that nobody acknowledges.
const UNACKNOWLEDGED: Time = Time::from_ms(100);
/// The time for which a board looks for no other rate after a commanded switch.
const TRUST: Time = Time::from_s(30);
/// The time from the first evidence until a lost board is found.
const FOUND: Time = Time::from_s(5);
/// The same for a board that had the evidence before the probe began.
const AT_ONCE: Time = Time::from_s(1);
/// The number of times that both images are tried again, the step of the crystals' deviation, and the number of times
/// that the product may be in time less often.
const PHASES: i32 = 32;
const DRIFT_PPM: i32 = 7;
const BY_CHANCE: usize = 10;
/// The time after which an unreached plain slave counts as lost.
const PATIENCE: Time = Time::from_s(3);

/// The images of the product and of the plain slave.
pub struct Images {
    pub part: Part,
    pub product: Image,
    pub plain: Image,
}

/// The result of both runs of a situation.
#[derive(Default)]
pub struct Verdict {
    /// The failures, with boards that were not found last.
    pub failures: Vec<Failure>,
    /// The number of boards that were found and that the plain slave shows to be lost.
    pub rescued: usize,
    /// The greatest delay of a board against the plain slave.
    pub worst_delay: Time,
    /// The log of the boards with the product's image.
    pub log: Vec<String>,
}

/// A violated requirement.
#[derive(Debug)]
pub enum Failure {
    /// The product is not reached in time, where the plain slave is reached after its time or lost.
    Late { board: usize, plain: Option<Time>, ours: Option<Time>, limit: Time },
    /// The stored settings or the bit rate differ from the plain slave's.
    Outcome { board: usize },
    /// An access or reset that no program may cause.
    Offence(String),
}

impl Failure {
    /// Whether the plain slave is lost, too.
    pub const fn is_not_found(&self) -> bool {
        matches!(self, Self::Late { plain: None, .. })
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let after = |time: &Option<Time>| match time {
            Some(time) => format!("after {} ms", time.as_ms()),
            None => "not at all".to_owned(),
        };
        match self {
            Self::Late { board, plain, ours, limit } => {
                let (plain, ours, limit) = (after(plain), after(ours), limit.as_ms());
                write!(
                    f,
                    "board {board} is reached {ours}, the plain slave {plain}; {limit} ms are allowed"
                )
            }
            Self::Outcome { board } => {
                write!(f, "board {board} has other settings or another rate than the plain slave")
            }
            Self::Offence(what) => f.write_str(what),
        }
    }
}

impl Images {
    /// Runs a situation with both images.
    pub fn judge(&self, situation: &Situation) -> Verdict {
        let mut plain = Life::up_to_the_probe(situation, &self.plain, self.part);
        let boards = 0..situation.boards.len();
        let home = |board: usize| {
            // A board that is switched on with the probe has its stored rate; its controller has not been set.
            let is_set = |rate: &u32| BitRate::ALL.map(bit_per_s).contains(rate);
            let stored = || bit_per_s(situation.boards[board].stored);
            plain.bit_rate(board).filter(is_set).unwrap_or_else(stored)
        };
        let homes: Vec<u32> = boards.map(home).collect();
        let rate = bit_per_s(situation.probe.rate);
        let is_at_home: Vec<bool> = homes.iter().map(|home| *home == rate).collect();
        let plain_seen = plain.probe(&is_at_home, PATIENCE);

        // Boards that are proven at another rate stay there, and their frames and errors disturb those of the master.
        let stays = |board: usize| homes[board] != rate && plain.has_proven(board, homes[board]);
        let is_disturbed =
            |board: usize| (0..homes.len()).any(|other| other != board && stays(other));
        let mut ours = Life::up_to_the_probe(situation, &self.product, self.part);
        let limits: Vec<Option<Time>> = (0..homes.len())
            .map(|board| {
                match plain_seen[board].sign_of_life(situation.boards[board], situation.probe) {
                    Some(reached) => {
                        let trust = if ours.has_proven(board, homes[board]) {
                            Trust::Proven
                        } else if ours
                            .switched(board)
                            .is_some_and(|switched| ms(situation.probe.at) < switched + TRUST)
                        {
                            Trust::Commanded
                        } else {
                            Trust::None
                        };
                        let may_stay_away = ours.has_missed_switch_to(board, homes[board])
                            || trust == Trust::None && is_disturbed(board);
                        (!may_stay_away).then(|| latest(situation, trust, reached))
                    }
                    None if is_lost_alone(situation, &homes, board)
                        && !is_disturbed(board)
                        && ours
                            .bit_rate(board)
                            .is_none_or(|rate| !plain.has_proven(board, rate))
                        && !ours.has_proven(board, homes[board])
                        // A board that was found may obey a switch that the plain slave does not hear.
                        && (ours.switched(board).is_none() || plain.switched(board).is_some()) =>
                    {
                        let switched = plain.switched(board).max(ours.switched(board));
                        Some(latest_rescue(situation, switched))
                    }
                    None => None,
                }
            })
            .collect();
        let wanted: Vec<bool> = limits.iter().map(Option::is_some).collect();
        // Somewhat longer, to report when a late board is reached.
        let limit = limits.iter().flatten().max().map_or(Time::ZERO, |limit| *limit + LATE * 10);
        let seen = ours.probe(&wanted, limit);
        let has_session = situation.kind == SESSION;

        let mut verdict = Verdict { log: ours.log().collect(), ..Verdict::default() };
        verdict.failures.extend(ours.offences().into_iter().map(Failure::Offence));
        for board in (0..homes.len()).filter(|_| has_session) {
            let outcome = |life: &Life<'_>| (life.stored(board), life.bit_rate(board));
            if outcome(&plain) != outcome(&ours) {
                verdict.failures.push(Failure::Outcome { board });
            }
        }
        let has_proven = |board: usize| ours.has_proven(board, homes[board]);
        // Proven at its own rate, the board has missed a switch as a plain slave may.
        let has_stayed =
            |board: usize| ours.bit_rate(board).is_some_and(|rate| ours.has_proven(board, rate));
        for (board, limit) in limits.iter().enumerate() {
            let (Some(limit), plain, ours) =
                (*limit, plain_seen[board].reached, seen[board].reached)
            else {
                continue;
            };
            let is_in_time = ours.is_some_and(|ours| ours <= limit);
            match (plain, ours) {
                (Some(plain), Some(ours)) if is_in_time => {
                    verdict.worst_delay = verdict.worst_delay.max(ours.saturating_sub(plain));
                }
                (None, _) if is_in_time => verdict.rescued += 1,
                // The board was switched on with the probe, and others at its rate have acknowledged it.
                (None, _) if has_proven(board) => {}
                (Some(_), _)
                    if (has_proven(board) || has_stayed(board))
                        && self.is_chance(situation, board, limit) => {}
                (plain, ours) => verdict.failures.push(Failure::Late { board, plain, ours, limit }),
            }
        }
        verdict.failures.sort_by_key(Failure::is_not_found);
        verdict
    }

    /// Whether a proven board is late by chance: with slightly different crystals it is in time about as often as the
    /// plain slave. After bus-off, and beside boards at another rate, the time until an answer is random.
    fn is_chance(&self, situation: &Situation, board: usize, limit: Time) -> bool {
        let mut wanted = vec![false; situation.boards.len()];
        wanted[board] = true;
        let in_time = |image: &Image| {
            let is_in_time = |phase: &i32| {
                let situation = Situation { drift_ppm: DRIFT_PPM * phase, ..situation.clone() };
                let mut life = Life::up_to_the_probe(&situation, image, self.part);
                life.probe(&wanted, limit)[board].reached.is_some_and(|reached| reached <= limit)
            };
            (1..=PHASES).filter(is_in_time).count()
        };
        in_time(&self.product) + BY_CHANCE >= in_time(&self.plain)
    }
}

/// The reason why a board does not leave its rate.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Trust {
    Proven,
    /// It has switched less than 30 s ago.
    Commanded,
    None,
}

/// The deadline for a board whose plain slave is reached after `plain`.
fn latest(situation: &Situation, trust: Trust, plain: Time) -> Time {
    let frame =
        Time::from_ps(FRAME_BITS * 1_000_000_000_000 / u64::from(bit_per_s(situation.probe.rate)));
    // At slow rates a round of questions and answers takes longer than the polling interval.
    let round = (frame * (2 * situation.boards.len() as u64)).saturating_sub(POLL);
    let allowance = LATE.max(frame * LATE_FRAMES) + round;
    match trust {
        Trust::Proven => return plain + allowance,
        // A frame that nobody acknowledges pauses, for boards that have not switched yet. A request is answered at once.
        Trust::Commanded if situation.probe.listens => return plain + PAUSE + allowance,
        Trust::Commanded => return plain + allowance,
        Trust::None => {}
    }
    let back = situation
        .calm_at()
        .map_or(Time::ZERO, |calm| (ms(calm) + BACK).saturating_sub(ms(situation.probe.at)));
    // A board that is alone at the foreign rate leaves it at the master's requests, which are errors there, unless its
    // own frame, which nobody acknowledges, keeps the master from sending.
    if !situation.probe.listens && situation.boards.len() == 1 {
        return (plain + allowance).max(back.min(UNACKNOWLEDGED + allowance));
    }
    (plain + PAUSE + allowance).max(back)
}

/// The deadline for a lost board that switched at this instant.
fn latest_rescue(situation: &Situation, switched: Option<Time>) -> Time {
    let probe = ms(situation.probe.at);
    let switched = switched.max(situation.last_switch().map(ms).filter(|end| *end > probe));
    let trusted = switched.map_or(Time::ZERO, |switched| switched + TRUST);
    let evidence = ms(situation.evidence_at()).max(trusted);
    (evidence + FOUND).max(probe + AT_ONCE) - probe
}

/// Whether a board has another rate than the probe and receives no valid frame there: no other board has its rate, or
/// none of those sends unasked.
fn is_lost_alone(situation: &Situation, homes: &[u32], board: usize) -> bool {
    let rate = bit_per_s(situation.probe.rate);
    let home = homes[board];
    if home == rate || situation.probe.listens {
        return false;
    }
    peers(homes, home).count() == 1 || !peers(homes, home).any(|at| talks(situation, at))
}

/// The boards at this rate.
fn peers(homes: &[u32], rate: u32) -> impl Iterator<Item = usize> {
    (0..homes.len()).filter(move |at| homes[*at] == rate)
}

fn talks(situation: &Situation, board: usize) -> bool {
    let board = situation.boards[board];
    board.node_id.is_some() && board.heartbeat_ms > 0
}
