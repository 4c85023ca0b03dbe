//! The master with answers that no bus of right slaves gives.

use std::convert::Infallible;

use lss_master::{
    Bus, Error, Fastscan, Find, Identify, InquireNodeId, Instant, Master, Member, Outcome,
    Procedure, Select, SelectAlone, Service, Step, SwitchBitRate, Timing,
};
use lss_slave::{
    BitRate, Frame,
    lss::{Address, AddressPart, FastscanStep, Request},
};

const ADDRESS: Address =
    Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
/// The beginning of a scan.
const FASTSCAN: Request =
    Request::Fastscan(FastscanStep { id_number: 0, bit_check: 0x80, sub: 0, next: 0 });
/// More requests than any procedure here needs.
const MANY: usize = 3000;

/// An answer, and the microseconds after its request at which it comes.
type Answer = (u32, [u8; 8]);

/// A bus on which a frame takes no time, and each request has the answer that the function gives, if any.
struct Answers {
    of: Box<dyn FnMut([u8; 8]) -> Option<Answer>>,
    now: Instant,
    /// Those that are still to come, in their order.
    answers: Vec<(Instant, Frame)>,
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
        if let Some((micros, answer)) = (self.of)(data) {
            let answer = Frame::new(0x7E4, &answer).expect("a frame");
            self.answers.push((self.now.plus_micros(micros), answer));
        }
        Ok(())
    }

    fn receive(
        &mut self,
        until: Instant,
        mut take: impl FnMut(&Frame, Instant),
    ) -> Result<(), Infallible> {
        match self.answers.first().copied() {
            Some((at, answer)) if at.as_micros() < until.as_micros() => {
                self.now = at;
                self.answers.remove(0);
                take(&answer, at);
            }
            _ => self.now = until,
        }
        Ok(())
    }

    fn set_bit_rate(&mut self, _: BitRate) -> Result<(), Infallible> {
        self.set_at = Some(self.now.as_micros());
        Ok(())
    }
}

/// Carries out a procedure of which each request is answered at once.
fn run<P: Procedure>(
    mut of: impl FnMut([u8; 8]) -> Option<[u8; 8]> + 'static,
    procedure: P,
) -> (Result<P::Output, Error>, Answers) {
    run_later(move |request| Some((0, of(request)?)), procedure)
}

fn run_later<P: Procedure>(
    of: impl FnMut([u8; 8]) -> Option<Answer> + 'static,
    procedure: P,
) -> (Result<P::Output, Error>, Answers) {
    run_with(Timing::default(), of, procedure)
}

fn run_with<P: Procedure>(
    timing: Timing,
    of: impl FnMut([u8; 8]) -> Option<Answer> + 'static,
    procedure: P,
) -> (Result<P::Output, Error>, Answers) {
    let now = Instant::from_micros(0);
    let (answers, requests) = (Vec::new(), Vec::new());
    let mut bus = Answers { of: Box::new(of), now, answers, requests, set_at: None };
    let Ok(outcome) = lss_master::run(&mut bus, &mut Master::new(timing), procedure);
    (outcome, bus)
}

/// These steps, whatever their outcome.
struct Steps(std::vec::IntoIter<Step<()>>);

impl Steps {
    fn of(steps: impl IntoIterator<Item = Step<()>>) -> Self {
        Self(steps.into_iter().collect::<Vec<_>>().into_iter())
    }
}

impl Procedure for Steps {
    type Output = ();

    fn begin(&mut self) -> Step<()> {
        self.0.next().unwrap_or(Step::Done(Ok(())))
    }

    fn next(&mut self, _: Outcome) -> Step<()> {
        self.begin()
    }
}

impl Answers {
    /// The number of requests that begin so.
    fn count(&self, begin: &[u8]) -> usize {
        self.times(begin).len()
    }

    /// The times of the requests that begin so.
    fn times(&self, begin: &[u8]) -> Vec<u32> {
        let those = self.requests.iter().filter(|(_, request)| request.starts_with(begin));
        those.map(|(at, _)| *at).collect()
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

/// What a slave with this address answers in a Fastscan, 100 us after the request.
fn of_slave(address: Address, request: [u8; 8]) -> Option<Answer> {
    let parts: [u32; 4] = address.into();
    let answer = match request {
        [0x51, n0, n1, n2, n3, bit_check, sub, _] => {
            let number = u32::from_le_bytes([n0, n1, n2, n3]);
            let is_same = || (parts[usize::from(sub)] ^ number) >> bit_check == 0;
            (bit_check == 0x80 || is_same()).then_some(0x4F)?
        }
        [0x5D, ..] => {
            let [n0, n1, n2, n3] = parts[3].to_le_bytes();
            return Some((100, [0x5D, n0, n1, n2, n3, 0, 0, 0]));
        }
        _ => return None,
    };
    Some((100, empty(answer)?))
}

#[test]
fn a_lost_answer_to_the_question_that_ends_a_scan_is_asked_for_again() {
    let mut is_lost = true;
    let (outcome, bus) = run_later(
        move |request| match request[0] {
            0x5D if std::mem::take(&mut is_lost) => None,
            _ => of_slave(ADDRESS, request),
        },
        Fastscan::new(),
    );
    assert_eq!(outcome, Ok(Some(ADDRESS)));
    assert_eq!((bus.count(&[0x51, 0, 0, 0, 0, 0x80]), bus.count(&[0x5D])), (1, 2));
}

#[test]
fn a_last_number_that_nobody_confirms_may_only_have_lost_its_answer() {
    let (outcome, bus) = run_later(
        |request| match request {
            [0x51, _, _, _, _, 0, 3, _] | [0x5D, ..] => None,
            _ => of_slave(ADDRESS, request),
        },
        Fastscan::new(),
    );
    assert_eq!(outcome, Err(Error::Inconsistent));
    // The silence of a probe is trusted less each time.
    let probes = 1 + 2 + 3 + 6 * 4;
    assert_eq!((bus.count(&[0x51, 0, 0, 0, 0, 0x80]), bus.count(&[0x5D])), (9, probes));
}

#[test]
fn a_search_for_a_product_that_nobody_is_asks_one_question() {
    let (outcome, bus) = run(|_| None, Find::new(Identify::product(1, 2)));
    assert_eq!(outcome, Ok(None));
    assert_eq!(bus.count(&[0x4B, 0xFF, 0xFF, 0xFF, 0xFF]), bus.count(&[0x4B]));
}

#[test]
fn the_first_question_of_a_scan_waits_its_whole_time_for_all_slaves() {
    let (_, bus) = run_later(|request| of_slave(ADDRESS, request), Fastscan::new());
    let times: Vec<_> = bus.times(&[0x51]);
    assert_eq!(times[1] - times[0], 200_000);
    assert_eq!(times[2] - times[1], 100, "the others wait for no second one");
}

#[test]
fn the_question_who_is_selected_waits_only_a_margin_for_others() {
    let ask = Step::ask(Request::Inquire(AddressPart::SerialNumber));
    let (_, bus) = run_later(|request| of_slave(ADDRESS, request), Steps::of([ask]));
    assert_eq!(bus.now.as_micros(), 100 + 100 / 16 + 10_000);
}

#[test]
fn after_16_answers_a_probe_waits_for_half_of_their_variation() {
    const REQUEST: Request = Request::InquireNodeId;
    for (answers, margin) in [(15, 10_000), (16, (3_200 - 1_650) / 2)] {
        let mut number = 0;
        let asked = (0..answers).map(|_| Step::ask(REQUEST));
        let (_, bus) = run_later(
            move |_| {
                number += 1;
                let is_fast = number == answers - 1;
                (number <= answers).then_some((if is_fast { 1_600 } else { 3_200 }, empty(0x5E)?))
            },
            Steps::of(asked.chain([Step::probe(REQUEST)])),
        );
        let probed = *bus.times(&[0x5E]).last().expect("it is sent");
        assert_eq!(bus.now.as_micros() - probed, 3_200 + 200 + margin, "{answers} answers");
    }
}

#[test]
fn an_answer_within_a_selection_is_that_to_an_earlier_one() {
    let timing = Timing { gap: 1_000, ..Timing::default() };
    let early = |request: [u8; 8]| Some((0, empty(0x44).filter(|_| request[0] == 0x40)?));
    let (outcome, _) = run_with(timing, early, Select(ADDRESS));
    let last = Request::Select(AddressPart::SerialNumber, ADDRESS.serial_number);
    assert_eq!(outcome, Err(Error::NoAnswer(last)));
}

#[test]
fn a_repeated_single_request_does_not_slow_a_selection_down() {
    let mut is_lost = true;
    let (_, bus) = run(
        move |request| match request[0] {
            0x5E if std::mem::take(&mut is_lost) => None,
            0x5E => empty(0x5E),
            _ => None,
        },
        Steps::of([Step::ask(Request::InquireNodeId), Step::Ask(Service::Select(ADDRESS))]),
    );
    assert_eq!(bus.times(&[0x40])[0], bus.times(&[0x43])[0]);
}

#[test]
fn the_pauses_of_a_selection_grow_to_the_wait_for_an_answer_at_most() {
    // The slave has just lost its power before each selection.
    let mut count = 0;
    let (_, bus) = run(
        move |request| {
            count += u32::from(request[0] == 0x43);
            empty(0x44).filter(|_| request[0] == 0x43 && count % 2 == 0)
        },
        Steps::of((0..8).map(|_| Step::Ask(Service::Select(ADDRESS)))),
    );
    let last = |command| *bus.times(&[command]).last().expect("it is sent");
    assert_eq!(last(0x43) - last(0x42), 200_000);
}

#[test]
fn a_repeated_question_of_a_scan_waits_little_longer_than_the_slowest() {
    let begin = || Step::ask(FASTSCAN);
    let mut is_first = true;
    let (_, bus) = run_later(
        move |_| Some((100, empty(0x4F).filter(|_| std::mem::take(&mut is_first))?)),
        Steps::of([begin(), begin()]),
    );
    let mut times = bus.times(&[0x51]);
    times.push(bus.now.as_micros());
    let waits: Vec<_> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let repeated = 100 + 100 / 16 + 4 * 10_000;
    assert_eq!(waits, [200_000, 200_000, repeated, repeated]);
}

#[test]
fn a_late_answer_to_the_first_attempt_does_not_end_the_second_one() {
    let identify = || Step::Ask(Service::Identify(Identify::address(ADDRESS)));
    let mut number = 0;
    let (_, bus) = run_later(
        move |request| {
            number += usize::from(request[0] == 0x4B);
            let micros = [0, 100, 250_100, 500].get(number)?;
            (request[0] == 0x4B).then_some((*micros, empty(0x4F)?))
        },
        Steps::of([identify(), identify(), Step::ask(Request::InquireNodeId)]),
    );
    let second = bus.times(&[0x4B])[2];
    assert!((200_101..250_100).contains(&(second - bus.times(&[0x4B])[1])), "the gaps have grown");
    assert_eq!(bus.times(&[0x5E])[0] - second, 200_000);
}

#[test]
fn after_contradictions_three_single_answers_end_the_wait_for_others() {
    let address = Address { vendor_id: 0xA000_0000, ..ADDRESS };
    let mut begins = 0;
    let (outcome, bus) = run_later(
        move |request| {
            begins += u32::from(request[5] == 0x80);
            let is_vendor_id = matches!(request, [0x51, .., 0, 0, 1]);
            of_slave(address, request).filter(|_| begins > 2 || !is_vendor_id)
        },
        Fastscan::new(),
    );
    assert_eq!(outcome, Ok(Some(address)));
    let begun = bus.times(&[0x51, 0, 0, 0, 0, 0x80])[2];
    let scan: Vec<_> = bus.requests.iter().filter(|(at, _)| *at >= begun).collect();
    let wait = |bit: u8| {
        let place =
            scan.iter().position(|(_, request)| request[5] == bit).expect("it is asked for");
        scan[place + 1].0 - scan[place].0
    };
    // The first question is one of the three. The bits 31 and 29 are set.
    assert_eq!([30, 28, 27, 26].map(wait), [40_106, 40_106, 100, 100]);
}
