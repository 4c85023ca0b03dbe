//! The master's view of the bus: requests with bounded waits, and everything that nodes send unasked.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use canopen_node::{
    BitRate, Frame,
    lss::{self, Request},
    nmt,
};
use lss_master::{Error, Master, Procedure, Timing};

use crate::{
    adapter::{Adapter, Mode, Received, Status},
    stop::Stop,
};

/// The wait for an answer that must come, besides the frames' own time and the adapter's latency.
const PATIENCE: Duration = Duration::from_millis(500);
/// The same for an answer that may fail to come.
const SHORT: Duration = Duration::from_millis(60);
/// An upper limit for the bits of a request and its answer.
const EXCHANGE_BITS: u32 = 320;
/// Command specifiers.
const SWITCH_STATE_GLOBAL: u8 = 0x04;
const INQUIRE_SERIAL_NUMBER: u8 = 0x5D;
/// The longest wait between two looks at Ctrl-C.
const SLICE: Duration = Duration::from_millis(50);
/// The number of sent frames by which an echo is known.
const ECHOES: usize = 16;
/// The number of pairs, from the first frame on, by which an adapter is known that forwards each frame twice.
const PAIRS: usize = 4;
/// The least bits of a frame without data.
const FRAME_BITS: u32 = 44;
/// The longest latency of an adapter, and the shortest time of a frame, with which the frames of two boards are not gathered
/// again and again.
const PROMPT: Duration = Duration::from_millis(4);
const SLOW_FRAME: Duration = Duration::from_micros(800);
/// The number of unasked frames that are kept.
const KEPT: usize = 1000;

/// What an adapter did.
#[derive(Clone, Debug)]
pub enum What {
    Opened(BitRate),
    Sent(Frame),
    Received(Frame),
}

/// Somebody who is told at once, and whose error ends the run.
type Watcher = Box<dyn FnMut(What, Instant) -> Result<(), Stop>>;

/// The bus, and a master on it.
pub struct Bus {
    adapter: Box<dyn Adapter>,
    watcher: Option<Watcher>,
    latency: Duration,
    rate: BitRate,
    is_interrupted: Arc<AtomicBool>,
    /// Whether a Ctrl-C waits.
    holds_interrupt: bool,
    /// The other masters that end the run.
    minded: Masters,
    /// The request of another master that waits.
    other_master: Option<Frame>,
    pace: Pace,
    /// The last frames sent that have not come back, and whether one has: the adapter may echo what it sends.
    sent: VecDeque<Frame>,
    has_echo: bool,
    pairs: Pairs,
    /// Frames that nodes sent, the oldest first.
    unasked: VecDeque<Received>,
    /// Frames were dropped that nodes sent of themselves: who seems to be silent may have answered.
    pub has_dropped: bool,
    /// The nodes that have sent a frame of the predefined connection set (CiA 301), and the last NMT state that each has
    /// reported.
    pub heard: BTreeMap<u8, Option<u8>>,
    /// The node-IDs that boards have told by inquire node-ID, FFh for none.
    pub inquired: BTreeSet<u8>,
    /// The time from the latest LSS request to its answer.
    pub last_answer: Option<Duration>,
    /// The last LSS answer with fewer than 8 bytes, which are passed over.
    pub short_answer: Option<Frame>,
    /// The number of requests for a serial number since the last switch to LSS waiting state, and the answers to them.
    serial_numbers: (usize, Vec<u32>),
    /// The master, which learns how fast the boards answer at this rate; `None` before its first procedure.
    master: Option<Master>,
    /// The beginning of the master's time.
    start: Instant,
}

/// The requests of other masters that end a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Masters {
    /// Those of LSS, NMT and SDO.
    All,
    /// Those of LSS: a running network may have an NMT master and SDO clients.
    Lss,
    /// Those of LSS, as soon as a Ctrl-C would end it.
    LssAsInterrupt,
    None,
}

/// Equal frames one behind the other, faster than a bus is. Two boards with one LSS address send such, too, and an adapter that gathers
/// frames delivers them so: that is excluded by the frames of two nodes, or by time.
#[derive(Default)]
struct Pairs {
    /// The last frame, if it may be the first of a pair.
    first: Option<Received>,
    count: usize,
    nodes: BTreeSet<u8>,
    has_single: bool,
    /// A second one came so late that it may have been on the bus.
    has_pause: bool,
    is_doubled: bool,
}

impl Pairs {
    /// Notes a frame that takes `span` on the bus; returns whether it is the second of an adapter that doubles.
    fn note(&mut self, received: &Received, span: Duration, is_prompt: bool) -> bool {
        let Some(first) = self.first.replace(*received) else { return false };
        let Received { frame, at, here } = received;
        let pause = here.duration_since(first.here).max(at.saturating_sub(first.at));
        let was_doubled = self.is_doubled;
        let is_second = first.frame == *frame && (was_doubled || pause < span + PROMPT);
        let node = match (first.frame.cob_id(), first.frame.data()) {
            (cob_id @ 0x081..=0x77F, _) => (cob_id & 0x7F) as u8,
            // Those of one board, unlike what all answer.
            (lss::RESPONSE_COB_ID, [0x11 | 0x17 | 0x44, ..]) => 0,
            _ => 0x80,
        };
        if is_second {
            self.first = None;
        }
        if node < 0x80 {
            self.has_single |= !is_second;
            self.has_pause |= pause >= span;
            self.count += 1;
            self.nodes.extend(Some(node).filter(|node| *node > 0));
            let is_quick = is_prompt && span >= SLOW_FRAME && !self.has_pause;
            let is_proven = self.nodes.len() > 1 || is_quick;
            self.is_doubled |= !self.has_single && self.count >= PAIRS && is_proven;
        }
        is_second && was_doubled
    }
}

/// How long a procedure waits for an answer that may fail to come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// Long enough for a computer that pauses.
    Patient,
    /// Long enough for slaves that look for frames once in 10 ms: a Fastscan takes seconds.
    Quick,
}

/// The time of `bits` at `rate`.
pub fn bits(bits: u32, rate: BitRate) -> Duration {
    Duration::from_micros(u64::from(bits) * 1000 / u64::from(rate.kbit_per_s()))
}

impl lss_master::Bus for Bus {
    type Error = Stop;

    fn now(&self) -> canopen_node::Instant {
        self.now()
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        self.note_request(frame);
        self.send(frame)
    }

    fn receive(
        &mut self,
        until: canopen_node::Instant,
        mut take: impl FnMut(&Frame, canopen_node::Instant),
    ) -> Result<(), Stop> {
        let wait = Duration::from_micros(until.micros_after(self.now()).into());
        let is_answer = |frame: &Frame| frame.cob_id() == lss::RESPONSE_COB_ID;
        if let Some(answer) = self.wait_for(wait, is_answer)? {
            self.note_answer(&answer.frame);
            take(&answer.frame, self.now());
            return Ok(());
        }
        // The computer may have paused, and the adapter with it.
        match self.pace {
            Pace::Patient => self.flush()?,
            Pace::Quick => {
                self.adapter.settle()?;
                self.pass(Duration::ZERO)?;
            }
        }
        for late in self.take_unasked() {
            self.note_answer(&late.frame);
            take(&late.frame, self.now());
            self.keep(late);
        }
        self.forget_answers();
        Ok(())
    }

    fn set_bit_rate(&mut self, bit_rate: BitRate) -> Result<(), Stop> {
        self.open(bit_rate)
    }
}

impl Bus {
    /// A master with this adapter, whose latency is at least `latency`.
    pub fn new(
        adapter: Box<dyn Adapter>,
        latency: Duration,
        is_interrupted: Arc<AtomicBool>,
    ) -> Self {
        Self {
            latency,
            rate: BitRate::Kbit125,
            is_interrupted,
            holds_interrupt: false,
            minded: Masters::All,
            other_master: None,
            pace: Pace::Patient,
            sent: VecDeque::new(),
            has_echo: false,
            pairs: Pairs::default(),
            unasked: VecDeque::new(),
            has_dropped: false,
            heard: BTreeMap::new(),
            inquired: BTreeSet::new(),
            last_answer: None,
            short_answer: None,
            serial_numbers: (0, Vec::new()),
            master: None,
            start: adapter.now(),
            watcher: None,
            adapter,
        }
    }

    /// Joins the bus at another rate, or again.
    pub fn open(&mut self, rate: BitRate) -> Result<(), Stop> {
        self.master = None;
        self.open_as(rate, Mode::Normal)
    }

    /// Joins the bus as a listener.
    pub fn listen(&mut self, rate: BitRate) -> Result<(), Stop> {
        self.open_as(rate, Mode::ListenOnly)
    }

    fn open_as(&mut self, rate: BitRate, mode: Mode) -> Result<(), Stop> {
        self.rate = rate;
        self.adapter.open(rate, mode)?;
        self.tell(What::Opened(rate), self.adapter.now())
    }

    /// Tells all that the adapter does from now on.
    pub fn watch(&mut self, watcher: impl FnMut(What, Instant) -> Result<(), Stop> + 'static) {
        self.watcher = Some(Box::new(watcher));
    }

    fn tell(&mut self, what: What, now: Instant) -> Result<(), Stop> {
        self.watcher.as_mut().map_or(Ok(()), |watcher| watcher(what, now))
    }

    /// Leaves the bus, as far as the adapter still works.
    pub fn leave(&mut self) {
        let _ = self.adapter.close();
    }

    pub fn rate(&self) -> BitRate {
        self.rate
    }

    /// The only rate of the adapter, if it cannot be set.
    pub fn fixed_rate(&self) -> Option<BitRate> {
        self.adapter.fixed_rate()
    }

    /// The adapter's time, the clock of [`Received::here`].
    pub fn time(&self) -> Instant {
        self.adapter.now()
    }

    pub fn status(&mut self) -> Result<Option<Status>, Stop> {
        self.adapter.status()
    }

    pub fn clock(&self) -> &'static str {
        self.adapter.clock()
    }

    /// The time that the adapter adds to a request and its answer.
    pub fn latency(&self) -> Duration {
        self.adapter.latency().unwrap_or_default().max(self.latency)
    }

    /// Forgets a Ctrl-C and other masters: the boards must be restored in spite of both.
    pub fn insist(&mut self) {
        self.is_interrupted.store(false, Ordering::Relaxed);
        self.holds_interrupt = false;
        self.minded = Masters::None;
        self.other_master = None;
    }

    /// Minds only these masters from now on.
    pub fn mind(&mut self, masters: Masters) {
        self.minded = masters;
    }

    pub fn set_pace(&mut self, pace: Pace) {
        self.pace = pace;
        self.master = None;
    }

    /// Lets a Ctrl-C wait, or no longer, and so what is minded as one.
    pub fn hold_interrupt(&mut self, holds: bool) {
        self.holds_interrupt = holds;
    }

    pub fn check_interrupt(&self) -> Result<(), Stop> {
        match (self.holds_interrupt, self.other_master) {
            (true, _) => Ok(()),
            (false, Some(frame)) => Err(Stop::OtherMaster(frame)),
            (false, None) if self.is_interrupted.load(Ordering::Relaxed) => Err(Stop::Interrupted),
            (false, None) => Ok(()),
        }
    }

    /// What a person must know of the adapter, as far as that has shown.
    pub fn remarks(&self) -> Vec<String> {
        let mut remarks = self.adapter.doubts();
        if self.has_echo {
            remarks.push("frames come back as they were sent: the adapter echoes, or another master does the same".into());
        }
        if self.is_doubled() {
            remarks.push(
                "each frame comes twice, faster than a bus is: the adapter forwards it so".into(),
            );
        }
        remarks
    }

    /// Whether the adapter is known to forward each frame twice; the second ones are dropped from then on.
    pub fn is_doubled(&self) -> bool {
        self.pairs.is_doubled
    }

    /// The adapter and its version, for a person.
    pub fn description(&self) -> String {
        self.adapter.description()
    }

    pub fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        self.check_interrupt()?;
        self.sent.truncate(ECHOES - 1);
        self.sent.push_front(*frame);
        self.tell(What::Sent(*frame), self.adapter.now())?;
        self.adapter.send(frame)
    }

    /// Sends a frame with this COB-ID.
    pub fn send_to(&mut self, cob_id: u16, data: &[u8]) -> Result<(), Stop> {
        match Frame::new(cob_id, data) {
            Some(frame) => self.send(&frame),
            None => Ok(()),
        }
    }

    pub fn request(&mut self, request: Request) -> Result<(), Stop> {
        self.send_to(lss::REQUEST_COB_ID, &request.to_bytes())
    }

    /// Sends an NMT command; node 0 is all nodes.
    pub fn nmt(&mut self, command: u8, node: u8) -> Result<(), Stop> {
        self.send_to(nmt::COMMAND_COB_ID, &[command, node])
    }

    /// The next frame, if one comes before `until`.
    pub fn receive(&mut self, until: Instant) -> Result<Option<Received>, Stop> {
        loop {
            self.check_interrupt()?;
            let wait = until.saturating_duration_since(self.adapter.now()).min(SLICE);
            if let Some(received) = self.adapter.receive(wait)? {
                self.tell(What::Received(received.frame), received.here)?;
                if self.is_new(&received) {
                    self.note(&received.frame)?;
                    return Ok(Some(received));
                }
                continue;
            }
            if self.adapter.now() >= until {
                return Ok(None);
            }
        }
    }

    /// Waits for the first frame that `is_wanted`; others are kept as unasked.
    pub fn wait_for(
        &mut self,
        wait: Duration,
        is_wanted: impl Fn(&Frame) -> bool,
    ) -> Result<Option<Received>, Stop> {
        let until = self.adapter.now() + wait;
        while let Some(received) = self.receive(until)? {
            if is_wanted(&received.frame) {
                return Ok(Some(received));
            }
            self.keep(received);
        }
        Ok(None)
    }

    /// All frames of the next `span`.
    pub fn collect(&mut self, span: Duration) -> Result<Vec<Received>, Stop> {
        let until = self.adapter.now() + span;
        let mut all = Vec::new();
        while let Some(received) = self.receive(until)? {
            all.push(received);
        }
        Ok(all)
    }

    /// Lets time pass; what is received is kept as unasked.
    pub fn pass(&mut self, span: Duration) -> Result<(), Stop> {
        for received in self.collect(span)? {
            self.keep(received);
        }
        Ok(())
    }

    /// Takes the unasked frames received so far.
    pub fn take_unasked(&mut self) -> Vec<Received> {
        self.unasked.drain(..).collect()
    }

    /// The wait for an answer that must come.
    pub fn patience(&self) -> Duration {
        PATIENCE + self.exchange()
    }

    /// The wait for an answer that may fail to come.
    pub fn short(&self) -> Duration {
        SHORT + self.exchange()
    }

    fn exchange(&self) -> Duration {
        bits(EXCHANGE_BITS, self.rate) + 4 * self.latency()
    }

    /// Sends an LSS request that must be answered; returns the answer.
    pub fn ask(&mut self, request: Request) -> Result<Option<[u8; 8]>, Stop> {
        self.ask_within(request, self.patience())
    }

    /// Sends an LSS request that may remain without an answer.
    pub fn probe(&mut self, request: Request) -> Result<Option<[u8; 8]>, Stop> {
        match self.ask_within(request, self.short())? {
            None => {
                // The computer may have paused, and the adapter with it.
                self.flush()?;
                self.answer_to(request, Duration::ZERO)
            }
            answer => Ok(answer),
        }
    }

    /// The longest time that a slave has taken to answer an LSS request at this bit rate, if any has answered.
    pub fn slowest_answer(&self) -> Option<Duration> {
        let micros = self.master.as_ref()?.slowest_answer()?;
        Some(Duration::from_micros(micros.into()))
    }

    /// Carries out a procedure of the LSS master.
    pub fn carry_out<P: Procedure>(
        &mut self,
        procedure: P,
    ) -> Result<Result<P::Output, Error>, Stop> {
        let micros = |span: Duration| u32::try_from(span.as_micros()).unwrap_or(u32::MAX);
        let answer = micros(self.patience());
        let timing = match self.pace {
            Pace::Patient => Timing { answer, store: answer, margin: micros(self.short()), gap: 0 },
            Pace::Quick => {
                let timing = Timing::default();
                Timing { answer, margin: timing.margin + micros(self.latency()), ..timing }
            }
        };
        let new = || Master::new(timing);
        let mut master = self.master.take().unwrap_or_else(new);
        self.forget_answers();
        let result = lss_master::run(self, &mut master, procedure)?;
        self.master = Some(master);
        Ok(result)
    }

    /// The serial number that came more often than it was asked for: two boards have it, or one answers twice.
    pub fn serial_number_twice(&self) -> Option<u32> {
        let (requests, answers) = &self.serial_numbers;
        let [first, .., last] = answers[..] else { return None };
        (first == last && answers.len() > *requests).then_some(first)
    }

    fn note_request(&mut self, request: &Frame) {
        match request.data().first() {
            Some(&INQUIRE_SERIAL_NUMBER) => self.serial_numbers.0 += 1,
            Some(&SWITCH_STATE_GLOBAL) => self.serial_numbers = (0, Vec::new()),
            // The second answer may come after the next request.
            _ => {}
        }
    }

    fn note_answer(&mut self, answer: &Frame) {
        if let &[INQUIRE_SERIAL_NUMBER, a, b, c, d, _, _, _] = answer.data()
            && self.serial_numbers.0 > 0
        {
            self.serial_numbers.1.push(u32::from_le_bytes([a, b, c, d]));
        }
    }

    fn forget_answers(&mut self) {
        self.unasked.retain(|received| received.frame.cob_id() != lss::RESPONSE_COB_ID);
    }

    /// The master's time.
    fn now(&self) -> canopen_node::Instant {
        canopen_node::Instant::from_micros(
            self.adapter.now().duration_since(self.start).as_micros() as u32,
        )
    }

    /// Waits until what was sent has left the adapter.
    pub fn flush(&mut self) -> Result<(), Stop> {
        for _ in 0..2 {
            self.adapter.settle()?;
            self.pass(self.exchange())?;
        }
        Ok(())
    }

    fn ask_within(&mut self, request: Request, wait: Duration) -> Result<Option<[u8; 8]>, Stop> {
        self.forget_answers();
        let begin = self.adapter.now();
        self.request(request)?;
        let answer = self.answer_to(request, wait)?;
        self.last_answer = answer.map(|_| self.adapter.now().duration_since(begin));
        Ok(answer)
    }

    /// The answer with the command specifier that belongs to the request; an answer to an earlier request that came too
    /// late is skipped.
    fn answer_to(&mut self, request: Request, wait: Duration) -> Result<Option<[u8; 8]>, Stop> {
        let specifier = match request {
            Request::Select(..) => 0x44,
            Request::Identify(..) | Request::Fastscan(_) => 0x4F,
            Request::IdentifyNonConfigured => 0x50,
            _ => request.to_bytes()[0],
        };
        let is_answer = |frame: &Frame| {
            frame.cob_id() == lss::RESPONSE_COB_ID && frame.data().first() == Some(&specifier)
        };
        let kept = self.unasked.iter().find(|received| is_answer(&received.frame)).copied();
        let answer = match kept {
            None => self.wait_for(wait, is_answer)?,
            kept => kept,
        };
        Ok(answer.and_then(|answer| answer.frame.data().try_into().ok()))
    }

    fn keep(&mut self, received: Received) {
        if self.unasked.len() == KEPT {
            // What no question is answered by goes first.
            let other = self.unasked.iter().position(|kept| !is_told(&kept.frame));
            self.has_dropped |= other.is_none();
            self.unasked.remove(other.unwrap_or(0));
        }
        self.unasked.push_back(received);
    }

    /// Whether a frame is neither an echo of the adapter nor the second of two that it makes of one.
    fn is_new(&mut self, received: &Received) -> bool {
        let span = bits(FRAME_BITS + 8 * received.frame.data().len() as u32, self.rate);
        if self.pairs.note(received, span, self.latency() <= PROMPT) {
            return false;
        }
        let echoed = self.sent.iter().rposition(|sent| *sent == received.frame);
        self.has_echo |= echoed.and_then(|at| self.sent.remove(at)).is_some();
        echoed.is_none()
    }

    fn note(&mut self, frame: &Frame) -> Result<(), Stop> {
        let node = (frame.cob_id() & 0x7F) as u8;
        match (frame.cob_id(), frame.data()) {
            (0x701..=0x77F, &[state]) => {
                self.heard.insert(node, Some(state));
            }
            // An emergency, a TPDO or an answer of the SDO server.
            (
                0x081..=0x0FF
                | 0x181..=0x1FF
                | 0x281..=0x2FF
                | 0x381..=0x3FF
                | 0x481..=0x4FF
                | 0x581..=0x5FF,
                _,
            ) => {
                self.heard.entry(node).or_default();
            }
            (lss::RESPONSE_COB_ID, data) if data.len() < 8 => self.short_answer = Some(*frame),
            (lss::RESPONSE_COB_ID, &[0x5E, id, ..]) => {
                self.inquired.insert(id);
            }
            (lss::REQUEST_COB_ID, _) if self.minded == Masters::LssAsInterrupt => {
                self.other_master = Some(*frame);
            }
            (lss::REQUEST_COB_ID, _) if self.minded != Masters::None => {
                return Err(Stop::OtherMaster(*frame));
            }
            (nmt::COMMAND_COB_ID | 0x601..=0x67F, _) if self.minded == Masters::All => {
                return Err(Stop::OtherMaster(*frame));
            }
            _ => {}
        }
        Ok(())
    }
}

/// Whether a node tells of itself: by an emergency, an answer, a boot-up message or a heartbeat.
fn is_told(frame: &Frame) -> bool {
    matches!(frame.cob_id(), 0x081..=0x0FF | 0x581..=0x5FF | 0x701..=0x77F | lss::RESPONSE_COB_ID)
}
