//! Procedures of one service, and the inquiry of a whole LSS address.

use lss_slave::{
    NodeId,
    lss::{Address, AddressPart, Request},
};

use crate::{Error, Identify, Outcome, Procedure, Service, Step};

/// A single request, which must be answered unless it has no answer.
impl Procedure for Request {
    type Output = ();

    fn begin(&mut self) -> Step<()> {
        Step::ask(*self)
    }

    fn next(&mut self, outcome: Outcome) -> Step<()> {
        Step::Done(outcome.map(drop))
    }
}

/// Brings the slave with this LSS address to LSS configuration state, and all others to LSS waiting state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Select(pub Address);

impl Procedure for Select {
    type Output = ();

    fn begin(&mut self) -> Step<()> {
        Step::Ask(Service::Select(self.0))
    }

    fn next(&mut self, outcome: Outcome) -> Step<()> {
        Step::Done(outcome.map(drop))
    }
}

/// The same as [`Select`], and then it asks who is in LSS configuration state: a slave that missed the switch to LSS
/// waiting state would take each request that follows. In that case it begins again. A slave that does not answer to
/// this question is taken to be alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SelectAlone {
    address: Address,
    retries: u8,
    is_selected: bool,
}

impl SelectAlone {
    /// How often it begins again.
    const RETRIES: u8 = 2;

    /// The selection of this slave.
    pub const fn new(address: Address) -> Self {
        Self { address, retries: Self::RETRIES, is_selected: false }
    }

    fn select(&mut self) -> Step<()> {
        self.is_selected = false;
        Step::Ask(Service::Select(self.address))
    }
}

impl Procedure for SelectAlone {
    type Output = ();

    fn begin(&mut self) -> Step<()> {
        self.retries = Self::RETRIES;
        self.select()
    }

    fn next(&mut self, outcome: Outcome) -> Step<()> {
        match (self.is_selected, outcome) {
            (false, Ok(_)) => {
                self.is_selected = true;
                Step::probe(Request::Inquire(AddressPart::SerialNumber))
            }
            (false, Err(error)) => Step::Done(Err(error)),
            (true, Ok(None)) => Step::Done(Ok(())),
            (true, Ok(Some(number))) if number == self.address.serial_number => Step::Done(Ok(())),
            (true, _) if self.retries > 0 => {
                self.retries -= 1;
                self.select()
            }
            (true, _) => Step::Done(Err(Error::Inconsistent)),
        }
    }
}

/// Whether any slave is within the ranges.
impl Procedure for Identify {
    type Output = bool;

    fn begin(&mut self) -> Step<bool> {
        Step::Probe(Service::Identify(self.clone()))
    }

    fn next(&mut self, outcome: Outcome) -> Step<bool> {
        Step::Done(outcome.map(|answer| answer.is_some()))
    }
}

/// Reads the active node-ID of the slave in LSS configuration state; `None`: not configured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InquireNodeId;

impl Procedure for InquireNodeId {
    type Output = Option<NodeId>;

    fn begin(&mut self) -> Step<Self::Output> {
        Step::ask(Request::InquireNodeId)
    }

    fn next(&mut self, outcome: Outcome) -> Step<Self::Output> {
        Step::Done(outcome.map(|number| NodeId::new(number.unwrap_or(0) as u8)))
    }
}

/// Reads the LSS address of the slave in LSS configuration state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct InquireAddress {
    /// The parts read so far.
    numbers: [u32; 4],
    part: Option<AddressPart>,
}

impl InquireAddress {
    /// The inquiry.
    pub const fn new() -> Self {
        Self { numbers: [0; 4], part: None }
    }
}

impl Procedure for InquireAddress {
    type Output = Address;

    fn begin(&mut self) -> Step<Address> {
        self.part = Some(AddressPart::VendorId);
        Step::ask(Request::Inquire(AddressPart::VendorId))
    }

    fn next(&mut self, outcome: Outcome) -> Step<Address> {
        let number = match outcome {
            Ok(number) => number.unwrap_or(0),
            Err(error) => return Step::Done(Err(error)),
        };
        let part = self.part.unwrap_or(AddressPart::SerialNumber);
        self.numbers[part as usize] = number;
        self.part = AddressPart::new(part as u8 + 1);
        match self.part {
            Some(part) => Step::ask(Request::Inquire(part)),
            None => Step::Done(Ok(self.numbers.into())),
        }
    }
}
