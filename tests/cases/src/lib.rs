//! The cases of a conformance test of CANopen: they drive a device by its electronic data sheet (EDS), over any line.
//!
//! A [`Case`] is one function with a purpose. Cases form a [`Group`], a file each; [`APPLICATION_LAYER`] lists the
//! groups of CiA 301. Their numbers and purposes are those of the certifier's tool, so that reports can be compared;
//! frames, expectations and words are our own. [`OWN`] has cases that the tool lacks. A case takes a [`Bench`], which speaks with the device and keeps the
//! frames, and ends in one of three ways:
//!
//! - It returns `Ok(())`: passed.
//! - A step of the bench fails, or [`Bench::check`] finds a difference: failed, with what was expected.
//! - [`Bench::skip`], or an object that the EDS lacks: skipped, with the reason.
//!
//! # Adding a group
//!
//! A file with the functions and a constant, and its name in a list of groups such as [`APPLICATION_LAYER`]:
//!
//! ```
//! use conformance::{Bench, Case, Group, Step};
//!
//! pub const GROUP: Group = Group {
//!     name: "Example",
//!     // What precedes each case: here a reset and the default values.
//!     prepare: |bench| bench.restore(),
//!     // The number of a case is its place, such as Example 02.
//!     cases: &[Case::new("The device type has four bytes", device_type)],
//! };
//!
//! fn device_type(bench: &mut Bench) -> Step {
//!     let bytes = bench.read((0x1000, 0))?;
//!     bench.check(bytes.len() == 4, "1000h is an UNSIGNED32")
//! }
//! ```
//!
//! [`lss::LSS`] lists the groups of CiA 305, which the certifier's tool does not test; they need the LSS addresses in
//! `Bench::lss`.
//!
//! A [`Line`] is an adapter: a real one for `cargo hil`, a [`Lab`] in virtual time for `cargo verify conformance`.

mod abort;
mod bench;
mod data_sheet;
mod dictionary;
mod emergency;
mod guarding;
mod heartbeat;
mod line;
pub mod lss;
mod other;
mod own;
mod pdo;
mod report;
mod sdo;
mod states;
mod synchronization;

pub use can_bus::eds;

pub use bench::{Address, Bench, Command, Seen, Stop, ms};
pub use line::{Lab, Line};
pub use own::OWN;
pub use report::{Finding, Outcome, Report, head_table, html, junit, page};

/// What a step of a case gives, or the reason why the case ends here.
pub type Step<T = ()> = Result<T, Stop>;

/// The cases of one service.
#[derive(Clone, Copy)]
pub struct Group {
    pub name: &'static str,
    /// What is done before each case.
    pub prepare: fn(&mut Bench) -> Step,
    pub cases: &'static [Case],
}

/// A case: what it proves, and how.
#[derive(Clone, Copy)]
pub struct Case {
    /// One sentence, without its full stop.
    pub purpose: &'static str,
    /// What the certifier's tool does otherwise, or what CiA 301 leaves open; mostly empty.
    pub remark: &'static str,
    pub run: fn(&mut Bench) -> Step,
}

impl Case {
    pub const fn new(purpose: &'static str, run: fn(&mut Bench) -> Step) -> Self {
        Self { purpose, remark: "", run }
    }

    pub const fn with_remark(self, remark: &'static str) -> Self {
        Self { remark, ..self }
    }
}

impl Group {
    /// The number of the case at this place, such as `SDO 01`; the name alone if there is only one.
    pub fn number(&self, place: usize) -> String {
        match self.cases {
            [_] => self.name.to_owned(),
            _ => format!("{} {:02}", self.name, place + 1),
        }
    }
}

/// The groups of CiA 301, in the order of the certifier's tool.
pub const APPLICATION_LAYER: &[Group] = &[
    data_sheet::GROUP,
    sdo::GROUP,
    pdo::GROUP,
    dictionary::GROUP,
    emergency::GROUP,
    synchronization::GROUP,
    guarding::GROUP,
    heartbeat::GROUP,
    guarding::VERSUS_HEARTBEAT,
    other::GROUP,
    states::STATES,
    states::TRANSITIONS,
];

/// The beginning of what was expected by a case that failed before it began.
pub const UNPREPARED: &str = "before the case: ";
/// So many of them end a run.
const MOST_UNPREPARED: usize = 3;

/// Whether the number of a case begins with one of `wanted`, or that is empty.
fn is_wanted(number: &str, wanted: &[String]) -> bool {
    wanted.is_empty() || wanted.iter().any(|start| number.starts_with(start))
}

/// Whether the number of a case in `groups` begins with one of `wanted`, or that is empty.
pub fn has_case(groups: &[Group], wanted: &[String]) -> bool {
    let is_wanted = |group: &Group, place| is_wanted(&group.number(place), wanted);
    groups.iter().any(|group| (0..group.cases.len()).any(|place| is_wanted(group, place)))
}

/// Runs the cases of `groups` whose number begins with one of `wanted`, or all if it is empty, and adds them to the
/// report. `show` gets each finding when its case ends.
///
/// # Errors
/// The line has broken, the device does not come back, or no case is wanted.
pub fn run(
    bench: &mut Bench,
    groups: &[Group],
    wanted: &[String],
    report: &mut Report,
    mut show: impl FnMut(&Finding),
) -> Step {
    let mut unprepared = 0;
    for group in groups {
        for (place, case) in group.cases.iter().enumerate() {
            let number = group.number(place);
            if !is_wanted(&number, wanted) {
                continue;
            }
            bench.begin();
            let from = bench.now();
            let prepared = (group.prepare)(bench);
            let prepared = match prepared {
                Err(Stop::Failed(expected)) => {
                    unprepared += 1;
                    Err(Stop::Failed(format!("{UNPREPARED}{expected}")))
                }
                prepared => {
                    unprepared = 0;
                    prepared
                }
            };
            let outcome = match prepared.and_then(|()| (case.run)(bench)) {
                Ok(()) => Outcome::Passed,
                Err(Stop::Failed(expected)) => Outcome::Failed(expected),
                Err(Stop::Skipped(reason)) => Outcome::Skipped(reason),
                Err(broken @ Stop::Broken(_)) => return Err(broken),
            };
            let took = bench.now() - from;
            let frames = bench.take_seen();
            let finding = Finding { number, group: group.name, case: *case, outcome, frames, took };
            show(&finding);
            report.findings.push(finding);
            if unprepared == MOST_UNPREPARED {
                return Err(Stop::Broken("the device cannot be prepared: is it there?".into()));
            }
        }
    }
    if report.findings.is_empty() {
        return Err(Stop::Broken(format!("no case begins with {}", wanted.join(" or "))));
    }
    Ok(())
}
