//! The master with answers that no bus of right slaves gives.

use std::convert::Infallible;

use lss_master::{
    Bus, Error, Fastscan, Find, Identify, InquireNodeId, Instant, Master, Member, Procedure,
    SelectAlone, SwitchBitRate, Timing,
};
use lss_slave::{
    BitRate, Frame,
    lss::{Address, AddressPart, Request},
};

const ADDRESS: Address =
    Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
/// More requests than any procedure here needs.
const MANY: usize = 3000;

/// A bus on which a frame takes no time, and each request has the answer that the function gives, if any.
struct Answers {
    of: Box<dyn FnMut([u8; 8]) -> Option<[u8; 8]>>,
    now: Instant,
    answer: Option<Frame>,
    /// The requests, each with its time in microseconds.
    requests: Vec<(u32, [u8; 8])>,
    /// The time of a new bit rate.
    set_at: Option<u32>,
}

impl Bus for Answers {
    type Error = Infallible;

    fn now(&self) -> Instant {
        self.now
    }

    fn send(&mut self, request: &Frame) -> Result<(), Infallible> {
        let data = request.padded_data();
        self.requests.push((self.now.as_micros(), data));
        assert!(self.requests.len() < MANY, "it goes on and on");
        self.answer = (self.of)(data).and_then(|answer| Frame::new(0x7E4, &answer));
        Ok(())
    }

    fn receive(
        &mut self,
        until: Instant,
        mut take: impl FnMut(&Frame, Instant),
    ) -> Result<(), Infallible> {
        match self.answer.take() {
            Some(answer) => take(&answer, self.now),
            None => self.now = until,
        }
        Ok(())
    }

    fn set_bit_rate(&mut self, _: BitRate) -> Result<(), Infallible> {
        self.set_at = Some(self.now.as_micros());
        Ok(())
    }
}

fn run<P: Procedure>(
    of: impl FnMut([u8; 8]) -> Option<[u8; 8]> + 'static,
    procedure: P,
) -> (Result<P::Output, Error>, Answers) {
    let now = Instant::from_micros(0);
    let mut bus =
        Answers { of: Box::new(of), now, answer: None, requests: Vec::new(), set_at: None };
    let mut master = Master::new(Timing::default());
    let Ok(outcome) = lss_master::run(&mut bus, &mut master, procedure);
    (outcome, bus)
}

impl Answers {
    /// The number of requests that begin so.
    fn count(&self, begin: &[u8]) -> usize {
        self.requests.iter().filter(|(_, request)| request.starts_with(begin)).count()
    }
}

/// The answer with this command specifier, and zeros.
fn empty(specifier: u8) -> Option<[u8; 8]> {
    Some([specifier, 0, 0, 0, 0, 0, 0, 0])
}

#[test]
fn a_node_id_that_no_slave_can_have_is_unexpected() {
    const ANSWER: [u8; 8] = [0x5E, 0x80, 0, 0, 0, 0, 0, 0];
    let (outcome, _) = run(|_| Some(ANSWER), InquireNodeId);
    let request = Request::InquireNodeId;
    assert_eq!(outcome, Err(Error::Unexpected { request, answer: ANSWER }));
}

#[test]
fn a_selected_slave_with_another_serial_number_is_selected_again_and_then_told() {
    let (outcome, bus) = run(
        |request| match request[0] {
            0x43 => empty(0x44),
            0x5D => Some([0x5D, 5, 0, 0, 0, 0, 0, 0]),
            _ => None,
        },
        SelectAlone::new(ADDRESS),
    );
    assert_eq!(outcome, Err(Error::Inconsistent));
    assert_eq!((bus.count(&[0x43]), bus.count(&[0x5D])), (3, 3));
}

#[test]
fn a_scan_whose_numbers_are_never_confirmed_begins_anew_a_few_times() {
    let (outcome, bus) = run(
        |request| match request {
            // To all but the question for a whole number.
            [0x51, _, _, _, _, bit_check, ..] if bit_check > 0 => empty(0x4F),
            _ => None,
        },
        Fastscan::new(),
    );
    assert_eq!(outcome, Err(Error::Inconsistent));
    assert_eq!(bus.count(&[0x51, 0, 0, 0, 0, 0x80]), 9);
    // A number that was contradicted once is asked for as a whole, before its bits are asked for again.
    assert_eq!(bus.count(&[0x51, 0, 0, 0, 0, 0x1F]), 5);
}

#[test]
fn a_search_whose_slave_is_never_confirmed_begins_anew_a_few_times() {
    // In the lower half of each range, but nobody with the number that is left.
    let mut is_left = false;
    let (outcome, bus) = run(
        move |request| match request {
            [0x4B, 0, 0, 0, 0, ..] if is_left => None,
            [0x4B, high, ..] => {
                is_left = high == 0;
                empty(0x4F)
            }
            _ => None,
        },
        Find::new(Identify::product(1, 2)),
    );
    assert_eq!(outcome, Err(Error::Inconsistent));
    assert_eq!(bus.count(&[0x4B, 0xFF, 0xFF, 0xFF, 0xFF]), 5);
}

#[test]
fn the_master_changes_its_rate_and_sends_again_within_the_second_switch_delay() {
    let mut members = [Member::new(ADDRESS)];
    let switch = SwitchBitRate::new(&mut members, BitRate::Kbit1000, BitRate::Kbit250, 50);
    let (outcome, bus) = run(
        |request| match request[0] {
            0x43 => empty(0x44),
            0x13 => empty(0x13),
            _ => None,
        },
        switch,
    );
    assert_eq!(outcome, Ok(()));
    let is_activate = |(_, request): &&(u32, [u8; 8])| request[0] == 0x15;
    let (activated, _) = *bus.requests.iter().find(is_activate).expect("it is sent");
    let set_after = bus.set_at.expect("it is set") - activated;
    let next = bus.requests.iter().map(|(at, _)| at - activated).find(|at| *at > set_after);
    assert_eq!((set_after, next), (75_000, Some(110_000)));
}

#[test]
fn a_member_that_is_not_selected_gets_no_bit_rate() {
    let mut members = [Member::new(ADDRESS)];
    let switch = SwitchBitRate::new(&mut members, BitRate::Kbit1000, BitRate::Kbit250, 50);
    let (outcome, bus) = run(|_| None, switch);
    let last = Request::Select(AddressPart::SerialNumber, ADDRESS.serial_number);
    assert_eq!(outcome, Err(Error::NoAnswer(last)));
    assert_eq!((bus.count(&[0x13]), bus.count(&[0x15])), (0, 0));
    assert_eq!(members[0].outcome, outcome);
}

#[test]
fn an_error_says_which_request_failed_and_how() {
    let request = Request::ConfigureNodeId(5);
    let refused =
        |code, manufacturer_code| Error::Refused { request, code, manufacturer_code }.to_string();
    assert_eq!(Error::NoAnswer(request).to_string(), "11 is not answered");
    assert_eq!(refused(1, None), "11 is refused with error 01");
    assert_eq!(refused(0xFF, Some(0x2A)), "11 is refused with error FF, manufacturer's code 2A");
    let unexpected = Error::Unexpected { request, answer: [0x11, 0, 7, 0, 0, 0, 0, 0] };
    assert_eq!(unexpected.to_string(), "11 is answered [11, 00, 07, 00, 00, 00, 00, 00]");
    assert_eq!(Error::Inconsistent.to_string(), "the answers contradict each other");
}
