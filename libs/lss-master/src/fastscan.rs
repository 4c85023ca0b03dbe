//! Fastscan: finds a slave that has no node-ID (CiA 305).

use lss_slave::lss::{Address, AddressPart, FastscanStep, Request};

use crate::{Error, Outcome, Procedure, Step};

/// The bit check that begins a scan.
const BEGIN: u8 = 0x80;
/// How often a part is confirmed or searched for again.
const RETRIES: u8 = 8;

/// Finds one slave without a node-ID, and brings it to LSS configuration state.
///
/// The result is its LSS address; `None`: no slave without a node-ID has the known parts. All other slaves are in LSS
/// waiting state then.
///
/// Each bit of an unknown part takes one request, 0 being tried first, and each part is confirmed by another: 133
/// requests if no part is known. In the end the slave itself tells its serial number. A lost answer or one that comes
/// too late contradicts the confirmation. Then the part is searched for again, with longer waits.
#[derive(Clone, Debug, Default)]
pub struct Fastscan {
    known: [Option<u32>; 4],
    /// Numbers to try first, and the serial number below which no slave with these is left.
    likely: [Option<u32>; 4],
    /// The parts as far as they are known now.
    found: [Option<u32>; 4],
    /// The part whose confirmation has failed.
    contradicted: Option<AddressPart>,
    retries: u8,
    state: State,
}

/// What was sent last.
#[derive(Clone, Copy, Debug, Default)]
enum State {
    #[default]
    SwitchToWaiting,
    Begin,
    /// A part that is likely.
    Likely(AddressPart, u32),
    /// The part's bits so far, and the bit that is asked for, as a mask.
    Bit(AddressPart, u32, u32),
    Confirm(AddressPart),
    /// The serial number, which the slave itself tells.
    Inquire,
    SlowDown,
}

impl Fastscan {
    /// A scan for any slave without a node-ID.
    pub const fn new() -> Self {
        Self {
            known: [None; 4],
            likely: [None; 4],
            found: [None; 4],
            contradicted: None,
            retries: RETRIES,
            state: State::SwitchToWaiting,
        }
    }

    /// Looks only for slaves with this `number` as `part` of their LSS address: one request in place of 33.
    #[must_use]
    pub const fn with_known(mut self, part: AddressPart, number: u32) -> Self {
        self.known[part as usize] = Some(number);
        self
    }

    /// Begins with what this slave has, which was found by the last scan and has a node-ID now: tries its vendor-ID,
    /// its product code and its revision number first, and looks above its serial number. A number that is right takes
    /// one request in place of 33, any other one more. Slaves that came since are found, too, but may take longer.
    #[must_use]
    pub const fn after_slave(mut self, last: Address) -> Self {
        let Address { vendor_id, product_code, revision_number, serial_number } = last;
        self.likely =
            [Some(vendor_id), Some(product_code), Some(revision_number), Some(serial_number)];
        self
    }

    fn start(&mut self) -> Step<Option<Address>> {
        self.state = State::SwitchToWaiting;
        Step::ask(Request::SwitchToWaiting)
    }

    fn scan(&mut self, part: AddressPart) -> Step<Option<Address>> {
        match (self.found[part as usize], self.likely[part as usize]) {
            (Some(number), _) => self.confirm(part, number),
            (None, Some(number)) if part != AddressPart::SerialNumber => {
                self.state = State::Likely(part, number);
                fastscan(number, 0, part, after(part))
            }
            _ => self.ask_bit(part, 0, 1 << 31),
        }
    }

    fn ask_bit(
        &mut self,
        part: AddressPart,
        mut number: u32,
        mut bit: u32,
    ) -> Step<Option<Address>> {
        // With 0 here it would be a slave below the last one.
        while bit > 0 && self.is_above_last(part, number, bit) {
            number |= bit;
            bit >>= 1;
        }
        if bit == 0 {
            self.found[part as usize] = Some(number);
            return self.confirm(part, number);
        }
        self.state = State::Bit(part, number, bit);
        fastscan(number, bit.trailing_zeros() as u8, part, part)
    }

    /// Whether the last slave has this bit set, and the same bits above it and the same other parts.
    fn is_above_last(&self, part: AddressPart, number: u32, bit: u32) -> bool {
        let is_same = |part: AddressPart| {
            self.found[part as usize].is_none_or(|found| self.likely[part as usize] == Some(found))
        };
        let others = [AddressPart::VendorId, AddressPart::ProductCode, AddressPart::RevisionNumber];
        match self.likely[AddressPart::SerialNumber as usize] {
            Some(last) if part == AddressPart::SerialNumber => {
                last & bit != 0
                    && (last ^ number) & !(bit | bit.saturating_sub(1)) == 0
                    && others.into_iter().all(is_same)
            }
            _ => false,
        }
    }

    fn confirm(&mut self, part: AddressPart, number: u32) -> Step<Option<Address>> {
        self.state = State::Confirm(part);
        fastscan(number, 0, part, after(part))
    }

    /// Confirms all parts anew after a contradiction at `part`; looks for `part` again if that has happened before.
    fn begin_anew(&mut self, part: AddressPart) -> Step<Option<Address>> {
        if self.retries == 0 {
            return Step::Done(Err(Error::Inconsistent));
        }
        self.retries -= 1;
        self.likely[AddressPart::SerialNumber as usize] = None;
        if self.contradicted != Some(part) {
            self.contradicted = Some(part);
        } else if self.known[part as usize].is_some() {
            return Step::Done(Ok(None));
        } else {
            self.contradicted = None;
            for (found, known) in self.found.iter_mut().zip(self.known).skip(part as usize) {
                *found = known;
            }
        }
        self.state = State::SlowDown;
        Step::SlowDown
    }
}

/// The part to scan after `part`; the vendor-ID, at which the slave enters LSS configuration state, after the last.
fn after(part: AddressPart) -> AddressPart {
    AddressPart::new(part as u8 + 1).unwrap_or(AddressPart::VendorId)
}

const fn fastscan(
    id_number: u32,
    bit_check: u8,
    sub: AddressPart,
    next: AddressPart,
) -> Step<Option<Address>> {
    let (sub, next) = (sub as u8, next as u8);
    Step::probe(Request::Fastscan(FastscanStep { id_number, bit_check, sub, next }))
}

impl Procedure for Fastscan {
    type Output = Option<Address>;

    fn begin(&mut self) -> Step<Option<Address>> {
        self.found = self.known;
        self.contradicted = None;
        self.retries = RETRIES;
        self.start()
    }

    fn next(&mut self, outcome: Outcome) -> Step<Option<Address>> {
        let is_answered = matches!(outcome, Ok(Some(_)));
        match self.state {
            State::SlowDown => self.start(),
            State::SwitchToWaiting => {
                self.state = State::Begin;
                let begin = FastscanStep { id_number: 0, bit_check: BEGIN, sub: 0, next: 0 };
                Step::ask(Request::Fastscan(begin))
            }
            State::Begin if is_answered => self.scan(AddressPart::VendorId),
            State::Begin => Step::Done(Ok(None)),
            State::Likely(part, number) if is_answered => {
                self.found[part as usize] = Some(number);
                self.scan(after(part))
            }
            State::Likely(part, _) => self.ask_bit(part, 0, 1 << 31),
            State::Bit(part, mut number, bit) => {
                if !is_answered {
                    number |= bit;
                }
                self.ask_bit(part, number, bit >> 1)
            }
            State::Confirm(AddressPart::SerialNumber) => {
                self.state = State::Inquire;
                let request = Request::Inquire(AddressPart::SerialNumber);
                // Perhaps only the answer was lost.
                if is_answered { Step::ask(request) } else { Step::probe(request) }
            }
            State::Confirm(part) if is_answered => self.scan(after(part)),
            State::Confirm(part) => self.begin_anew(part),
            State::Inquire => match outcome {
                Ok(number @ Some(_))
                    if number == self.found[AddressPart::SerialNumber as usize] =>
                {
                    Step::Done(Ok(Some(self.found.map(Option::unwrap_or_default).into())))
                }
                _ => self.begin_anew(AddressPart::SerialNumber),
            },
        }
    }
}
