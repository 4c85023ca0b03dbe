//! The requirements on a run: no board is reached later than the plain slave, and every lost board is found.

use std::fmt;

use emulator::{Time, chip::Part, image::Image};

use super::{
    life::{FRAME_BITS, Life, POLL},
    situation::{Situation, ms},
};
use testkit::image_rig::bit_per_s;

/// The allowed delay against the plain slave, unless [`LATE_FRAMES`] take longer.
const LATE: Time = Time::from_ms(100);
const LATE_FRAMES: u64 = 25;
/// The same on a contested bus, where a board at another rate disturbs. It does so until it is error passive, which
/// comes sooner the more the others send, or until it has had errors for a second and looks elsewhere.
const LATE_IF_CONTESTED: Time = Time::from_ms(1_250);
/// The time for which a foreign device may keep a board away after it has left. A master that only listens sends
/// nothing: the board's next heartbeat, up to a second later, must first go without an acknowledge for a second.
const AFTER_DEPARTURE: Time = Time::from_s(1);
const AFTER_DEPARTURE_UNHEARD: Time = Time::from_s(2);
/// The time for which a board looks for no other rate after a commanded switch.
const TRUST: Time = Time::from_s(30);
/// The time from the first evidence until a lost board is found.
const FOUND: Time = Time::from_s(10);
/// The same for a board that had the evidence before the probe began.
const AT_ONCE: Time = Time::from_s(1);
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
#[derive(Clone, Debug)]
pub enum Failure {
    /// The plain slave is reached after this time, the product later or not in time.
    Worse { board: usize, plain: Time, ours: Option<Time>, limit: Time },
    /// The plain slave is lost, and the product was not found in time.
    NotFound { board: usize, ours: Option<Time>, limit: Time },
    /// An access or reset that no program may cause.
    Offence(String),
}

impl Failure {
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Worse { ours: Some(_), .. } => "reached late",
            Self::Worse { ours: None, .. } => "not reached",
            Self::NotFound { .. } => "not found",
            Self::Offence(_) => "offence",
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let after = |time: &Option<Time>| match time {
            Some(time) => format!("after {} ms", time.as_ms()),
            None => "not at all".to_owned(),
        };
        match self {
            Self::Worse { board, plain, ours, limit } => {
                let (plain, ours, limit) = (plain.as_ms(), after(ours), limit.as_ms());
                write!(
                    f,
                    "board {board} is reached {ours}, the plain slave after {plain} ms; {limit} ms are allowed"
                )
            }
            Self::NotFound { board, ours, limit } => {
                let (ours, limit) = (after(ours), limit.as_ms());
                write!(
                    f,
                    "board {board} is lost to the plain slave and found {ours}; {limit} ms are allowed"
                )
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
            // A board that is switched on with the probe has its stored rate.
            let stored = || bit_per_s(situation.boards[board].stored);
            plain.bit_rate(board).unwrap_or_else(stored)
        };
        let homes: Vec<u32> = boards.map(home).collect();
        let rate = bit_per_s(situation.probe.rate);
        let is_at_home: Vec<bool> = homes.iter().map(|home| *home == rate).collect();
        let plain_seen = plain.probe(&is_at_home, PATIENCE);

        let mut ours = Life::up_to_the_probe(situation, &self.product, self.part);
        let limits: Vec<Option<Time>> = (0..homes.len())
            .map(|board| match plain_seen[board].sign_of_life(situation.boards[board]) {
                Some(reached) => Some(latest(situation, &homes, reached)),
                None if is_lost_alone(situation, &homes, board) => {
                    let switched = plain.switched(board).max(ours.switched(board));
                    Some(latest_rescue(situation, switched))
                }
                None => None,
            })
            .collect();
        let wanted: Vec<bool> = limits.iter().map(Option::is_some).collect();
        // Somewhat longer, to report when a late board is reached.
        let limit = limits.iter().flatten().max().map_or(Time::ZERO, |limit| *limit + LATE * 10);
        let seen = ours.probe(&wanted, limit);

        let mut verdict = Verdict { log: ours.log().collect(), ..Verdict::default() };
        verdict.failures.extend(ours.offences().into_iter().map(Failure::Offence));
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
                (Some(plain), ours) => {
                    verdict.failures.push(Failure::Worse { board, plain, ours, limit });
                }
                (None, _) if is_in_time => verdict.rescued += 1,
                (None, ours) => verdict.failures.push(Failure::NotFound { board, ours, limit }),
            }
        }
        verdict.failures.sort_by_key(|failure| matches!(failure, Failure::NotFound { .. }));
        verdict
    }
}

/// The deadline for a board whose plain slave is reached after `plain`.
fn latest(situation: &Situation, homes: &[u32], plain: Time) -> Time {
    let frame =
        Time::from_ps(FRAME_BITS * 1_000_000_000_000 / u64::from(bit_per_s(situation.probe.rate)));
    // At slow rates a round of questions and answers takes longer than the polling interval.
    let round = (frame * (2 * situation.boards.len() as u64)).saturating_sub(POLL);
    let late = if is_contested(situation, homes) { LATE_IF_CONTESTED } else { LATE };
    let allowance = late.max(frame * LATE_FRAMES) + round;
    let after_departure = situation.last_departure().map_or(Time::ZERO, |departure| {
        let span = if situation.probe.listens { AFTER_DEPARTURE_UNHEARD } else { AFTER_DEPARTURE };
        (ms(departure) + span).saturating_sub(ms(situation.probe.at))
    });
    plain.max(after_departure) + allowance
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

/// Whether any board has another rate than the probe.
fn is_contested(situation: &Situation, homes: &[u32]) -> bool {
    let rate = bit_per_s(situation.probe.rate);
    homes.iter().any(|home| *home != rate)
}

/// The boards at this rate.
fn peers(homes: &[u32], rate: u32) -> impl Iterator<Item = usize> {
    (0..homes.len()).filter(move |at| homes[*at] == rate)
}

fn talks(situation: &Situation, board: usize) -> bool {
    let board = situation.boards[board];
    board.node_id.is_some() && board.heartbeat_ms > 0
}
