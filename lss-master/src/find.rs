//! The search for a slave by identify remote slave, with ranges that are halved.

use core::ops::RangeInclusive;

use lss_slave::lss::Address;

use crate::{Error, Identify, Outcome, Procedure, Service, Step};

/// How often a number is searched for again.
const RETRIES: u8 = 4;

/// Finds the slave with the lowest serial number within ranges, whether it has a node-ID or not, and changes no state.
///
/// The result is its LSS address; `None`: none is there, or none supports identify remote slave. The serial number
/// takes at most 34 questions of six requests each, and so does the revision number if its range is not a single one.
/// To find the other slaves, search above the serial number found.
#[derive(Clone, Debug)]
pub struct Find {
    within: Identify,
    /// The ranges that are left; somebody is within them.
    rest: Identify,
    retries: u8,
    state: State,
}

/// What was asked last.
#[derive(Clone, Copy, Debug)]
enum State {
    Anyone,
    /// The serial numbers up to this one.
    SerialNumber(u32),
    ConfirmSerialNumber,
    /// The revision numbers up to this one.
    RevisionNumber(u32),
    ConfirmRevisionNumber,
    SlowDown,
}

impl Find {
    /// The search within these ranges.
    pub fn new(within: Identify) -> Self {
        Self { rest: within.clone(), within, retries: RETRIES, state: State::Anyone }
    }

    fn start(&mut self) -> Step<Option<Address>> {
        self.rest = self.within.clone();
        self.ask(State::Anyone)
    }

    /// Asks whether somebody is within the rest, which must be so.
    fn ask(&mut self, state: State) -> Step<Option<Address>> {
        self.state = state;
        Step::Ask(Service::Identify(self.rest.clone()))
    }

    fn halve_serial_numbers(&mut self) -> Step<Option<Address>> {
        let Some(middle) = middle(&self.rest.serial_numbers) else {
            return self.ask(State::ConfirmSerialNumber);
        };
        self.state = State::SerialNumber(middle);
        let serial_numbers = *self.rest.serial_numbers.start()..=middle;
        Step::Probe(Service::Identify(Identify { serial_numbers, ..self.rest.clone() }))
    }

    fn halve_revision_numbers(&mut self) -> Step<Option<Address>> {
        let Some(middle) = middle(&self.rest.revision_numbers) else {
            return self.ask(State::ConfirmRevisionNumber);
        };
        self.state = State::RevisionNumber(middle);
        let revision_numbers = *self.rest.revision_numbers.start()..=middle;
        Step::Probe(Service::Identify(Identify { revision_numbers, ..self.rest.clone() }))
    }

    fn found(&self) -> Step<Option<Address>> {
        Step::Done(Ok(Some(Address {
            vendor_id: self.rest.vendor_id,
            product_code: self.rest.product_code,
            revision_number: *self.rest.revision_numbers.start(),
            serial_number: *self.rest.serial_numbers.start(),
        })))
    }
}

/// The last number of the lower half; `None` for a single number.
fn middle(range: &RangeInclusive<u32>) -> Option<u32> {
    let (low, high) = (*range.start(), *range.end());
    (low < high).then(|| low.midpoint(high))
}

/// Leaves the lower half of a range if somebody is within it, else the upper half.
fn keep(range: &mut RangeInclusive<u32>, middle: u32, is_lower: bool) {
    *range = match is_lower {
        true => *range.start()..=middle,
        false => middle.saturating_add(1)..=*range.end(),
    };
}

impl Procedure for Find {
    type Output = Option<Address>;

    fn begin(&mut self) -> Step<Option<Address>> {
        self.retries = RETRIES;
        self.start()
    }

    fn next(&mut self, outcome: Outcome) -> Step<Option<Address>> {
        let is_answered = matches!(outcome, Ok(Some(_)));
        match self.state {
            State::SlowDown => self.start(),
            State::Anyone if is_answered => self.halve_serial_numbers(),
            State::Anyone => Step::Done(Ok(None)),
            State::SerialNumber(middle) => {
                keep(&mut self.rest.serial_numbers, middle, is_answered);
                self.halve_serial_numbers()
            }
            State::RevisionNumber(middle) => {
                keep(&mut self.rest.revision_numbers, middle, is_answered);
                self.halve_revision_numbers()
            }
            State::ConfirmSerialNumber if is_answered => {
                match middle(&self.rest.revision_numbers) {
                    Some(_) => self.halve_revision_numbers(),
                    None => self.found(),
                }
            }
            State::ConfirmRevisionNumber if is_answered => self.found(),
            State::ConfirmSerialNumber | State::ConfirmRevisionNumber if self.retries > 0 => {
                self.retries -= 1;
                self.state = State::SlowDown;
                Step::SlowDown
            }
            State::ConfirmSerialNumber | State::ConfirmRevisionNumber => {
                Step::Done(Err(Error::Inconsistent))
            }
        }
    }
}
