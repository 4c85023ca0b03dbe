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
    /// The numbers up to this one.
    Half(Number, u32),
    /// The number that is left.
    Confirm(Number),
    SlowDown,
}

/// The number that is searched for.
#[derive(Clone, Copy, Debug)]
enum Number {
    Serial,
    Revision,
}

impl Number {
    fn range(self, of: &mut Identify) -> &mut RangeInclusive<u32> {
        match self {
            Self::Serial => &mut of.serial_numbers,
            Self::Revision => &mut of.revision_numbers,
        }
    }
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

    fn halve(&mut self, number: Number) -> Step<Option<Address>> {
        let mut lower = self.rest.clone();
        let range = number.range(&mut lower);
        let Some(middle) = middle(range) else { return self.ask(State::Confirm(number)) };
        *range = *range.start()..=middle;
        self.state = State::Half(number, middle);
        Step::Probe(Service::Identify(lower))
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
            State::Anyone if is_answered => self.halve(Number::Serial),
            State::Anyone => Step::Done(Ok(None)),
            State::Half(number, middle) => {
                keep(number.range(&mut self.rest), middle, is_answered);
                self.halve(number)
            }
            State::Confirm(Number::Serial)
                if is_answered && middle(&self.rest.revision_numbers).is_some() =>
            {
                self.halve(Number::Revision)
            }
            State::Confirm(_) if is_answered => self.found(),
            State::Confirm(_) if self.retries > 0 => {
                self.retries -= 1;
                self.state = State::SlowDown;
                Step::SlowDown
            }
            State::Confirm(_) => Step::Done(Err(Error::Inconsistent)),
        }
    }
}
