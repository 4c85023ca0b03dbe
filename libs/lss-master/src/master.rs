//! The master: its time-outs, which adapt to the slaves, and the session that carries out a procedure.

use lss_slave::{
    BitRate, Frame, Instant,
    lss::{AddressPart, RESPONSE_COB_ID, Request},
};

use crate::{
    Error, Outcome, Procedure, Service, Step,
    service::{answer_specifier, number},
};

/// How often a service is sent that must be answered.
const ATTEMPTS: u8 = 3;
/// The greatest caution with silence.
const GREATEST_CAUTION: u8 = 3;

/// How long the master waits, in microseconds from the moment at which it hands out a request, each less than half a
/// turn of [`Instant`] (35 minutes). The times include those of the frames on the bus and of the adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// The wait for an answer that must come.
    pub answer: u32,
    /// The wait for the answer to store configuration.
    pub store: u32,
    /// The wait for an answer that may fail to come, beyond the longest time that others have taken: the variation of
    /// the slaves' answer times. It decides how long a Fastscan takes. After 16 answers it shrinks to half of the
    /// variation that was seen, and after contradictions it grows up to `answer`.
    pub margin: u32,
    /// The pause after a request that has no answer. It grows up to `answer`, and stays so, if a slave seems to lose
    /// frames that come back to back.
    pub gap: u32,
}

/// 200 ms for an answer, 2 s for one to store configuration, a margin of 10 ms and no gap: for slaves that look for
/// frames once in 10 ms, by an adapter with a latency of a few milliseconds.
impl Default for Timing {
    fn default() -> Self {
        Self { answer: 200_000, store: 2_000_000, margin: 10_000, gap: 0 }
    }
}

/// The question who is in LSS configuration state.
const WHO: Request = Request::Inquire(AddressPart::SerialNumber);
/// The number of single answers in a row after which only one slave is left in a scan.
const SINGLES: u8 = 3;
/// The least margin of a master that has seen many answers, in microseconds.
const LEAST_MARGIN: u32 = 150;
/// The number of answers that show how much the answer times vary.
const ENOUGH: u8 = 16;

/// The answer times of a kind of service, in microseconds.
#[derive(Clone, Copy, Debug)]
struct Seen {
    /// Slowly forgotten, both.
    slowest: u32,
    fastest: u32,
    /// Never forgotten.
    longest: u32,
    /// At most [`ENOUGH`].
    count: u8,
}

/// An LSS master on one bus, which learns how fast the slaves answer.
#[derive(Clone, Debug)]
pub struct Master {
    timing: Timing,
    /// For a single request, a selection, and identify remote slave.
    seen: [Option<Seen>; 3],
    /// Whether slaves have answered one request one after the other.
    is_staggered: bool,
    /// The number of requests without an answer that the adapter may still hold.
    queued: u32,
}

impl Master {
    /// A master that knows nothing of the slaves.
    pub const fn new(timing: Timing) -> Self {
        Self { timing, seen: [None; 3], is_staggered: false, queued: 0 }
    }

    /// Begins a procedure. A session that is dropped before its end may leave slaves in LSS configuration state.
    pub const fn start<P: Procedure>(&mut self, procedure: P) -> Session<'_, P> {
        Session { master: self, procedure, state: State::Begin, caution: 0, singles: 0 }
    }

    /// The longest time that a slave has taken to answer a single request at this bit rate, in microseconds. Frames and
    /// the adapter are included.
    pub const fn slowest_answer(&self) -> Option<u32> {
        let [single, ..] = &self.seen;
        match single {
            Some(seen) => Some(seen.longest),
            None => None,
        }
    }

    const fn seen(&mut self, service: &Service) -> &mut Option<Seen> {
        let [single, select, identify] = &mut self.seen;
        match service {
            Service::Request(_) => single,
            Service::Select(_) => select,
            Service::Identify(_) => identify,
        }
    }

    /// The longest time to the answer of this service.
    fn slowest(&mut self, service: &Service) -> Option<u32> {
        self.seen(service).map(|seen| seen.slowest)
    }

    /// Whether the answer times of this service are known well.
    fn knows(&mut self, service: &Service) -> bool {
        self.seen(service).is_some_and(|seen| seen.count == ENOUGH)
    }

    /// Learns from an answer.
    fn learn(&mut self, service: &Service, micros: u32) {
        let seen = self.seen(service);
        let first = Seen { slowest: micros, fastest: micros, longest: micros, count: 0 };
        let Seen { slowest, fastest, longest, count } = seen.unwrap_or(first);
        let forgotten = |known: u32| known.abs_diff(micros) / 32;
        *seen = Some(Seen {
            slowest: micros.max(slowest.saturating_sub(forgotten(slowest))),
            fastest: micros.min(fastest.saturating_add(forgotten(fastest))),
            longest: micros.max(longest),
            count: count.saturating_add(1).min(ENOUGH),
        });
    }

    /// The time in which the queued requests leave.
    fn queue_time(&mut self, service: &Service) -> u32 {
        self.slowest(service).unwrap_or(0).saturating_mul(self.queued)
    }

    /// The time-out of a probe.
    fn probe_time_out(&mut self, service: &Service, caution: u8) -> u32 {
        let Some(Seen { slowest, fastest, count, .. }) = *self.seen(service) else {
            return self.timing.answer;
        };
        // Later requests may have more stuff bits.
        let exchange = slowest.saturating_add(slowest / 16);
        let wide =
            |exponent: u8| self.timing.margin.saturating_mul(4_u32.saturating_pow(exponent.into()));
        let margin = match (caution, count) {
            (0, ENOUGH) => {
                (slowest.saturating_sub(fastest) / 2).max(LEAST_MARGIN).min(self.timing.margin)
            }
            (caution, ENOUGH) => wide(caution.saturating_sub(1)),
            (caution, _) => wide(caution),
        };
        exchange.saturating_add(margin).min(self.timing.answer)
    }
}

/// A procedure that is being carried out.
///
/// Call [`poll`](Self::poll) until it returns [`Output::Wait`] or [`Output::Done`]; then wait for the instant or a
/// frame, whichever comes first.
#[derive(Debug)]
pub struct Session<'a, P: Procedure> {
    master: &'a mut Master,
    procedure: P,
    state: State,
    /// How little the silence of a probe is trusted.
    caution: u8,
    /// How often in a row a single answer came in a Fastscan when all were waited for.
    singles: u8,
}

/// What a [`Session`] wants next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Output<T> {
    /// A frame to send.
    Transmit(Frame),
    /// The bit rate that the master's own CAN controller takes now.
    SetBitRate(BitRate),
    /// Nothing before this instant, unless a frame comes.
    Wait(Instant),
    /// The result. The next poll would begin the procedure again.
    Done(Result<T, Error>),
}

#[derive(Debug)]
enum State {
    Begin,
    Pause(Instant),
    Exchange(Exchange),
}

impl<P: Procedure> Session<'_, P> {
    /// Does what is due at `now`.
    pub fn poll(&mut self, now: Instant) -> Output<P::Output> {
        loop {
            let step = match &mut self.state {
                State::Begin => {
                    self.caution = 0;
                    self.singles = 0;
                    self.procedure.begin()
                }
                State::Pause(until) if !until.has_come(now) => return Output::Wait(*until),
                State::Pause(_) => {
                    self.master.queued = 0;
                    self.procedure.next(Ok(None))
                }
                State::Exchange(exchange) => match exchange.poll(self.master, now) {
                    Progress::Transmit(frame) => return Output::Transmit(frame),
                    Progress::Wait(until) => return Output::Wait(until),
                    Progress::Over(outcome) => {
                        self.singles = match exchange.is_single() {
                            Some(true) => self.singles.saturating_add(1),
                            Some(false) => 0,
                            None => self.singles,
                        };
                        self.procedure.next(outcome)
                    }
                },
            };
            self.state = match step {
                Step::Ask(service) => State::Exchange(self.exchange(service, None, now)),
                Step::Probe(service) => {
                    State::Exchange(self.exchange(service, Some(self.caution), now))
                }
                Step::Pause(micros) => State::Pause(now.plus_micros(micros)),
                Step::SetBitRate(rate) => {
                    self.master.seen = [None; 3];
                    self.state = State::Pause(now);
                    return Output::SetBitRate(rate);
                }
                Step::SlowDown => {
                    self.caution = GREATEST_CAUTION.min(self.caution.saturating_add(1));
                    State::Pause(now)
                }
                Step::Done(result) => {
                    self.state = State::Begin;
                    return Output::Done(result);
                }
            };
        }
    }

    fn exchange(&mut self, service: Service, caution: Option<u8>, now: Instant) -> Exchange {
        // The answers to the first question of all show how different the slaves are.
        let is_cautious =
            self.master.slowest(&service).is_none() || self.master.is_staggered || self.caution > 0;
        // Slaves that answer at the same moment seem to be one.
        let is_single = self.singles >= SINGLES;
        let awaits_all = is_cautious && !is_single && may_many_answer(&service);
        Exchange::new(service, caution, awaits_all, self.master, now)
    }

    /// Takes a received frame, also one that is no LSS answer.
    pub fn handle_frame(&mut self, frame: &Frame, now: Instant) {
        if let State::Exchange(exchange) = &mut self.state
            && frame.cob_id() == RESPONSE_COB_ID
            && let Ok(data) = frame.data().try_into()
        {
            exchange.handle_answer(data, self.master, now);
        }
    }
}

/// The requests of a service and the wait for its answer.
#[derive(Debug)]
struct Exchange {
    service: Service,
    /// For a probe, how little its silence is trusted.
    caution: Option<u8>,
    /// Whether the answers of several slaves are waited for, until the time-out.
    awaits_all: bool,
    /// How often the service may still be repeated.
    repetitions: u8,
    /// The pause after each request that has no answer.
    gap: u32,
    /// The number of requests that were handed out, and the time of the last one.
    sent: u8,
    since: Instant,
    /// Whether no other request was under way when the first one was handed out.
    is_alone: bool,
    /// The end of the gap, or the time-out.
    until: Instant,
    answers: u8,
    answer: Option<Result<u32, Error>>,
}

enum Progress {
    Transmit(Frame),
    Wait(Instant),
    Over(Outcome),
}

impl Exchange {
    fn new(
        service: Service,
        caution: Option<u8>,
        awaits_all: bool,
        master: &mut Master,
        now: Instant,
    ) -> Self {
        // Another slave in LSS configuration state would take each request that follows.
        let is_who = service.last() == WHO;
        Self {
            caution,
            awaits_all: awaits_all || is_who,
            repetitions: match caution {
                None => ATTEMPTS - 1,
                // Nobody has answered yet, perhaps because the frames came back to back.
                Some(0) if service.len() > 1 && master.slowest(&service).is_none() => 1,
                Some(caution) => caution,
            },
            gap: master.timing.gap,
            sent: 0,
            since: now,
            is_alone: master.queued == 0,
            until: now,
            answers: 0,
            answer: None,
            service,
        }
    }

    fn poll(&mut self, master: &mut Master, now: Instant) -> Progress {
        if (self.answer.is_none() || self.awaits_all) && !self.until.has_come(now) {
            return Progress::Wait(self.until);
        }
        if self.sent < self.service.len() {
            return Progress::Transmit(self.transmit(master, now));
        }
        if !self.has_answer() {
            return Progress::Over(Ok(None));
        }
        master.queued = 0;
        if let Some(answer) = self.answer {
            // The slaves get the time that they need.
            master.timing.gap = self.gap;
            return Progress::Over(answer.map(Some));
        }
        if self.repetitions == 0 {
            return Progress::Over(match self.caution {
                Some(_) => Ok(None),
                None => Err(Error::NoAnswer(self.service.last())),
            });
        }
        self.repetitions -= 1;
        // The first attempt may have an answer yet.
        self.awaits_all |= may_many_answer(&self.service);
        if self.service.len() > 1 {
            // A slave may have lost frames that came back to back; one that was without power looks the same.
            let longer = self.gap.saturating_mul(4).max(master.timing.margin);
            self.gap = self.gap.max(longer.min(master.timing.answer));
        }
        self.sent = 0;
        self.is_alone = true;
        Progress::Transmit(self.transmit(master, now))
    }

    /// The next request.
    fn transmit(&mut self, master: &mut Master, now: Instant) -> Frame {
        let request = self.service.request(self.sent);
        self.sent = self.sent.saturating_add(1);
        self.since = now;
        if self.sent < self.service.len() || !self.has_answer() {
            self.until = now.plus_micros(self.gap);
            if self.gap > 0 {
                master.queued = 0;
            } else if !self.has_answer() {
                master.queued = master.queued.saturating_add(1);
            }
            return request.to_frame();
        }
        let wait = match (self.caution, request) {
            // A slow slave may have been silent for so long that it is forgotten.
            (Some(GREATEST_CAUTION), _) => master.timing.answer,
            (Some(caution), _) => master.probe_time_out(&self.service, caution),
            (None, Request::StoreConfiguration) => master.timing.store,
            // Only a lost frame is asked for again.
            (None, Request::Fastscan(_)) if self.repetitions < ATTEMPTS - 1 => {
                master.probe_time_out(&self.service, 1)
            }
            (None, _) => master.timing.answer,
        };
        self.until = now.plus_micros(wait.saturating_add(master.queue_time(&self.service)));
        request.to_frame()
    }

    fn handle_answer(&mut self, data: [u8; 8], master: &mut Master, now: Instant) {
        let request = self.service.last();
        if self.sent < self.service.len() || answer_specifier(request) != Some(data[0]) {
            return;
        }
        master.is_staggered |= self.answer.is_some();
        // Behind another request the time is too long, which does no harm if all answers are waited for.
        if (self.is_alone || self.awaits_all) && request != Request::StoreConfiguration {
            master.learn(&self.service, now.micros_after(self.since));
        }
        let is_known = master.knows(&self.service) || request == WHO;
        if self.caution.is_none_or(|caution| caution == GREATEST_CAUTION)
            && self.awaits_all
            && is_known
        {
            // Somebody answers: the others are not much slower.
            let wait = master.probe_time_out(&self.service, self.caution.unwrap_or(0));
            self.until =
                self.since.plus_micros(wait.saturating_add(master.queue_time(&self.service)));
        }
        self.answers = self.answers.saturating_add(1);
        let number = number(request, data);
        let contradicts = request == WHO && self.answer.is_some_and(|answer| answer != number);
        self.answer = Some(if contradicts { Err(Error::Inconsistent) } else { number });
    }

    /// Whether a single answer came in a scan, of which each question is for slaves that have answered to the one
    /// before; `None` if that is unknown.
    fn is_single(&self) -> Option<bool> {
        match self.service.last() {
            Request::SwitchToWaiting => Some(false),
            Request::Fastscan(_) if self.awaits_all && self.answers > 0 => Some(self.answers == 1),
            _ => None,
        }
    }

    fn has_answer(&self) -> bool {
        answer_specifier(self.service.last()).is_some()
    }
}

/// Whether slaves answer this service together.
fn may_many_answer(service: &Service) -> bool {
    matches!(service.last(), Request::Identify(..) | Request::Fastscan(_))
}
