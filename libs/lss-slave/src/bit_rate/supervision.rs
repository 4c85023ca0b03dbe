//! Bit-rate supervision: the choice of the node's bit rate and the search for another (`docs/reference.md`).
//!
//! The *home* rate is the one last commanded: stored at power-on, or activated since. It is *proven* once a valid frame
//! was received at it, or a frame of the node acknowledged. A proven home is never left. From an unproven one the node
//! searches at the first error: it listens silently at one rate after another. A valid frame makes it a *guest*, which
//! takes part at the rate found, but speaks only when it is spoken to.

use super::{BitRate, BitRateSetting, BitRates, BusEvent};
use crate::Instant;

/// The node's next step for its bit rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Take part in the bus at this rate.
    TakePart(BitRate),
    /// Receive silently at this rate.
    Listen(BitRate),
    /// Drop the pending frames.
    DropFrames,
}

/// The time after a switch in which only the commanded rate is used.
const TRUST_MICROS: u32 = 30_000_000;
/// The time for which an unacknowledged frame is repeated at an unproven home or by a guest, and the least and the
/// additional pause that follows at home. Without it a slower node never sees the 11 recessive bits that let it
/// join the bus.
const REPEAT_MICROS: u32 = 100_000;
const PAUSE_MICROS: u32 = 400_000;
const PAUSE_STEP_MICROS: u32 = 1_000;
/// The longest stay at a rate: a network may have no more than one heartbeat a second.
const STAY_MICROS: u32 = 1_100_000;
/// The rest of a stay after the first error.
const HEARD_MICROS: u32 = 40_000;
/// The number of stays after which the node takes part at home again until the next error: as many as there are rates.
const MOST_STAYS: u8 = 8;
/// The time for which the node listens at home between two stays. A lone master is error passive after 16 attempts and
/// can then be received in silence.
const TURN_MICROS: u32 = 30_000;
const TURN_FRAMES: u32 = 18;
const FRAME_BITS: u32 = 135;
/// The number of errors without a valid frame after which a guest leaves.
const MOST_ERRORS: u8 = 2;
/// The time without a valid frame after which a guest leaves, and the same in LSS configuration state: a person may
/// pause in a session.
const SILENCE_MICROS: u32 = 2_000_000;
const SESSION_MICROS: u32 = 64_000_000;

/// The supervision, which chooses the node's bit rate.
#[derive(Clone, Debug)]
pub(super) struct Supervision {
    rates: BitRates,
    is_enabled: bool,
    serial_number: u32,
    home: BitRate,
    /// The supervision has nothing to do at home until the next switch.
    is_proven: bool,
    /// The rate before the latest switch, until a search has begun with it.
    previous: Option<BitRate>,
    trusted_until: Option<Instant>,
    place: Place,
    /// The end of the stay at the place, or of the wait for an acknowledge there.
    until: Option<Instant>,
    /// Errors at the place since the latest valid frame. A turn at home counts with the stay before it.
    errors: u8,
    /// The rate of the stay or the next one, or of the guest.
    found: BitRate,
    /// An error has led from one rate to another during the stay.
    has_moved: bool,
    /// The stays of the search.
    stays: u8,
    /// The time of the latest valid frame that a guest has received, or had acknowledged.
    heard_at: Instant,
    /// The node is in LSS configuration state.
    is_in_session: bool,
    /// The guest has answered a request, or will.
    is_asked: bool,
    /// The step that [`poll`](Self::poll) returns next.
    step: Option<Step>,
    /// The rate at which the node last took part, as returned by [`take_change`](Self::take_change).
    active: BitRate,
    rescues: u16,
}

/// The rate in use, and whether the node takes part there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    /// Takes part at home.
    Home,
    /// Takes part at home but sends nothing, since nobody acknowledges.
    Pause,
    /// Listens at the next rate of the round, home among them: a stay.
    ListenInRound,
    /// Listens at home between two stays: a turn of home.
    ListenAtHome,
    /// Listens to detect a home rate.
    ListenToDetect,
    /// Takes part at the rate found, and only answers.
    Guest,
}

impl Supervision {
    /// The supervision of a node that was powered on with this setting: it only performs automatic detection, if the
    /// setting demands it.
    pub const fn new(setting: BitRateSetting, rates: BitRates) -> Self {
        let (home, place, step) = match setting {
            BitRateSetting::Fixed(rate) => (rate, Place::Home, None),
            BitRateSetting::Automatic => {
                (rates.fastest(), Place::ListenToDetect, Some(Step::Listen(rates.fastest())))
            }
        };
        Self {
            rates,
            is_enabled: false,
            serial_number: 0,
            home,
            is_proven: true,
            previous: None,
            trusted_until: None,
            place,
            until: None,
            errors: 0,
            found: home,
            has_moved: false,
            stays: 0,
            heard_at: Instant::from_micros(0),
            is_in_session: false,
            is_asked: false,
            step,
            active: home,
            rescues: 0,
        }
    }

    /// Adds the search from an unproven home.
    pub const fn with_rescue(self, serial_number: u32) -> Self {
        Self { is_enabled: true, is_proven: false, serial_number, ..self }
    }

    /// The bit rate at which the controller runs or listens.
    pub const fn bit_rate(&self) -> BitRate {
        match self.place {
            Place::Home | Place::Pause | Place::ListenAtHome => self.home,
            Place::ListenInRound | Place::ListenToDetect | Place::Guest => self.found,
        }
    }

    /// The active rate: the commanded rate, or the one at which the node has found the others.
    pub const fn active(&self) -> BitRate {
        self.active
    }

    /// The home rate; `None` until it has been detected.
    pub const fn home(&self) -> Option<BitRate> {
        if self.is_detecting() { None } else { Some(self.home) }
    }

    /// The number of times that the node has become a guest.
    pub const fn rescues(&self) -> u16 {
        self.rescues
    }

    /// Whether the controller listens silently.
    pub const fn is_listening(&self) -> bool {
        matches!(self.place, Place::ListenInRound | Place::ListenAtHome | Place::ListenToDetect)
    }

    /// Whether the node may send frames.
    pub const fn may_send(&self) -> bool {
        !self.is_listening() && !matches!(self.place, Place::Pause)
    }

    /// Whether the node takes part at a rate that it has found.
    pub const fn is_guest(&self) -> bool {
        matches!(self.place, Place::Guest)
    }

    /// Whether the node may report itself, which a guest only does once it was asked.
    pub const fn may_report(&self) -> bool {
        self.may_send() && (!self.is_guest() || self.is_asked)
    }

    /// Whether automatic detection has not found a rate yet.
    pub const fn is_detecting(&self) -> bool {
        matches!(self.place, Place::ListenToDetect)
    }

    /// Whether only the commanded rate is used for a while.
    pub const fn is_trusted(&self) -> bool {
        self.trusted_until.is_some()
    }

    /// Whether an event requires a step that has not been taken.
    pub const fn has_step(&self) -> bool {
        self.step.is_some()
    }

    /// Whether nothing but a switch makes a difference any more.
    pub const fn is_settled(&self) -> bool {
        self.is_proven && matches!(self.place, Place::Home) && self.step.is_none()
    }

    /// Whether the controller listens in a search, at a rate other than home.
    pub fn is_elsewhere(&self) -> bool {
        self.place == Place::ListenInRound && self.found != self.home
    }

    /// The rate at which the node takes part, if it differs from the last one returned or commanded: the node has
    /// become a guest or has returned home.
    pub fn take_change(&mut self) -> Option<BitRate> {
        let rate = self.bit_rate();
        if !matches!(self.place, Place::Home | Place::Guest) || rate == self.active {
            return None;
        }
        self.active = rate;
        if rate != self.home {
            self.rescues = self.rescues.saturating_add(1);
        }
        Some(rate)
    }

    /// Switches home to `rate`, at the end of the first delay of activate bit timing. No other rate is used until 30 s
    /// after `silent_until`.
    pub fn command(&mut self, rate: BitRate, silent_until: Instant) {
        let before = self.bit_rate();
        if rate == before {
            // A guest has heard the others at this rate.
            self.is_proven |= self.place == Place::Guest;
        } else {
            self.is_proven = !self.is_enabled;
            self.previous = Some(before);
            self.step = Some(Step::TakePart(rate));
        }
        self.home = rate;
        self.active = rate;
        self.enter(Place::Home, None);
        self.trusted_until = Some(silent_until.plus_micros(TRUST_MICROS));
    }

    /// Begins automatic detection.
    pub fn detect(&mut self) {
        self.found = self.rates.fastest();
        self.enter(Place::ListenToDetect, None);
        self.step = Some(Step::Listen(self.found));
        self.trusted_until = None;
    }

    /// Records that the node has sent a frame; that of a guest is an answer.
    pub fn note_sent(&mut self, now: Instant) {
        self.is_asked = true;
        if self.is_guest() || self.place == Place::Home && !self.is_proven {
            self.until.get_or_insert(now.plus_micros(REPEAT_MICROS));
        }
    }

    /// Records a request that the node will answer.
    pub const fn note_asked(&mut self) {
        self.is_asked = true;
    }

    /// Records whether the node is in LSS configuration state.
    pub const fn note_session(&mut self, is_in_session: bool) {
        self.is_in_session = is_in_session;
    }

    /// Handles an observation of the controller.
    pub fn handle(&mut self, event: BusEvent, now: Instant) {
        match event {
            BusEvent::Received => self.handle_valid(now),
            // The acknowledge of a frame that was sent before the node began to listen decides nothing.
            BusEvent::Acknowledged if !self.is_listening() => self.handle_valid(now),
            BusEvent::Error => self.handle_error(true, now),
            // In a turn at home it is a frame that nobody has acknowledged.
            BusEvent::FormError if self.place != Place::ListenAtHome => {
                self.handle_error(false, now);
            }
            // Reception cannot wait for the recovery, which takes hundreds of frames on a busy bus. A controller that
            // takes part at once would destroy the frames of a master at another rate.
            BusEvent::BusOff if !self.is_proven && self.place == Place::Home => {
                self.enter(Place::ListenAtHome, Some(self.pause_end(now)));
                self.stays = MOST_STAYS;
                self.step = Some(Step::Listen(self.home));
            }
            // A short circuit is no evidence of another rate.
            BusEvent::HeldDominant if self.is_listening() && !self.is_detecting() => {
                self.stay_home();
            }
            _ => {}
        }
    }

    fn handle_valid(&mut self, now: Instant) {
        match self.place {
            Place::Guest => (self.errors, self.until, self.heard_at) = (0, None, now),
            Place::ListenInRound if self.found != self.home => self.join(now),
            Place::ListenToDetect => {
                self.home = self.found;
                self.active = self.found;
                self.prove();
            }
            _ => self.prove(),
        }
    }

    /// Handles an error; a form error does not lead to another rate: a silent listener sees one when a frame is not
    /// acknowledged.
    fn handle_error(&mut self, leads_on: bool, now: Instant) {
        self.errors = self.errors.saturating_add(1);
        match self.place {
            Place::Home | Place::Pause if !self.is_proven && self.trusted_until.is_none() => {
                let fastest = self.next_rate(BitRate::Kbit10);
                let other = if fastest == self.home { self.next_rate(fastest) } else { fastest };
                // After a switch the others may still be at the rate before, if they have missed it.
                self.found = self.previous.take().unwrap_or(other);
                self.stays = 0;
                self.stay(now);
            }
            Place::Guest if self.errors >= MOST_ERRORS => self.take_turn(true, now),
            Place::ListenInRound | Place::ListenToDetect => {
                let end = now.plus_micros(HEARD_MICROS);
                self.until = Instant::earliest(self.until, Some(end));
                if leads_on {
                    self.has_moved = true;
                    self.found = self.next_rate(self.found);
                    self.step = Some(Step::Listen(self.found));
                }
            }
            _ => {}
        }
    }

    /// Returns the next step, if one is due at `now`.
    pub fn poll(&mut self, now: Instant) -> Option<Step> {
        if self.step.is_none() {
            let is_over = |end: Option<Instant>| end.is_some_and(|end| end.has_come(now));
            if is_over(self.trusted_until) {
                self.trusted_until = None;
            }
            if is_over(self.until) || is_over(self.silence_end()) {
                self.end_stay(now);
            }
        }
        self.step.take()
    }

    /// The latest time of the next [`poll`](Self::poll), if nothing else happens before.
    pub fn poll_at(&self) -> Option<Instant> {
        Instant::earliest(Instant::earliest(self.until, self.silence_end()), self.trusted_until)
    }

    /// The time at which a guest leaves if it hears nothing.
    fn silence_end(&self) -> Option<Instant> {
        let micros = if self.is_in_session { SESSION_MICROS } else { SILENCE_MICROS };
        self.is_guest().then(|| self.heard_at.plus_micros(micros))
    }

    fn end_stay(&mut self, now: Instant) {
        let has_heard = self.errors > 0;
        match self.place {
            // Nobody has acknowledged. A frame that is repeated without a pause keeps slower nodes from joining.
            Place::Home => {
                self.pause(now);
                self.step = Some(Step::DropFrames);
            }
            Place::Pause => self.enter(Place::Home, None),
            Place::ListenInRound => {
                self.advance();
                self.take_turn(has_heard, now);
            }
            Place::ListenAtHome if has_heard && self.stays < MOST_STAYS => self.stay(now),
            Place::ListenAtHome => self.stay_home(),
            Place::Guest => self.take_turn(false, now),
            Place::ListenToDetect if has_heard => {
                self.advance();
                self.enter(Place::ListenToDetect, Some(now.plus_micros(STAY_MICROS)));
                self.step = Some(Step::Listen(self.found));
            }
            Place::ListenToDetect => self.detect(),
        }
    }

    fn enter(&mut self, place: Place, until: Option<Instant>) {
        (self.place, self.until) = (place, until);
        (self.errors, self.has_moved) = (0, false);
    }

    /// Ends the stay at a rate.
    fn advance(&mut self) {
        if !self.has_moved {
            self.found = self.next_rate(self.found);
        }
    }

    fn pause(&mut self, now: Instant) {
        self.enter(Place::Pause, Some(self.pause_end(now)));
    }

    fn pause_end(&self, now: Instant) -> Instant {
        // Boards that pause together would begin again together, so each waits for a time of its own.
        now.plus_micros(PAUSE_MICROS + PAUSE_STEP_MICROS * (self.serial_number & 0xFF))
    }

    /// Becomes a guest.
    fn join(&mut self, now: Instant) {
        self.enter(Place::Guest, None);
        (self.stays, self.is_asked, self.heard_at) = (0, false, now);
        self.step = Some(Step::TakePart(self.found));
    }

    /// Takes part at home for good.
    fn prove(&mut self) {
        self.is_proven = true;
        self.stay_home();
    }

    /// Takes part at home until the next error.
    fn stay_home(&mut self) {
        if self.is_listening() {
            self.step = Some(Step::TakePart(self.home));
        }
        self.enter(Place::Home, None);
    }

    /// Listens at the next rate of the round.
    fn stay(&mut self, now: Instant) {
        self.enter(Place::ListenInRound, Some(now.plus_micros(STAY_MICROS)));
        self.stays = self.stays.saturating_add(1);
        self.step = Some(Step::Listen(self.found));
    }

    /// Listens at home, and then at the next rate if there was an error at the last one, or is one at home.
    fn take_turn(&mut self, has_heard: bool, now: Instant) {
        let micros =
            TURN_MICROS + TURN_FRAMES * FRAME_BITS * 1000 / u32::from(self.home.kbit_per_s());
        self.enter(Place::ListenAtHome, Some(now.plus_micros(micros)));
        self.errors = has_heard.into();
        self.step = Some(Step::Listen(self.home));
    }

    /// The rate after `rate` in the round: the next slower one, and after the slowest the fastest. At a rate that is
    /// too fast each frame ends in a stuff error, since its bits last too long; at a rate that is too slow a frame may
    /// pass unnoticed.
    fn next_rate(&self, rate: BitRate) -> BitRate {
        let mut offered = BitRate::ALL.into_iter().filter(|&other| self.rates.contains(other));
        let slower = offered.find(|other| other.kbit_per_s() < rate.kbit_per_s());
        slower.unwrap_or(self.rates.fastest())
    }
}
