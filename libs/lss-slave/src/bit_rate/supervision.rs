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
    search: Option<Search>,
    serial_number: u32,
    home: BitRate,
    /// The supervision has nothing to do at home until the next switch.
    is_proven: bool,
    /// The rate before the latest switch, until a search has begun with it.
    previous: Option<BitRate>,
    trusted_until: Option<Instant>,
    place: Place,
    /// The node is in LSS configuration state.
    is_in_session: bool,
    /// The step that [`poll`](Self::poll) returns next.
    step: Option<Step>,
    /// The rate at which the node last took part, as returned by [`take_change`](Self::take_change).
    active: BitRate,
    rescues: u16,
}

/// That the node searches. Without the feature there is no such value, and the compiler leaves out the places that have
/// one, with what is done there.
#[derive(Clone, Copy, Debug)]
enum Search {
    #[cfg(feature = "rescue")]
    On,
}

/// Where the node is, and what it knows there.
#[derive(Clone, Copy, Debug)]
enum Place {
    /// Takes part at home; `until` is the end of the wait for an acknowledge.
    Home { until: Option<Instant> },
    /// Takes part at home but sends nothing, since nobody acknowledges.
    Pause { until: Instant },
    /// Listens at a rate of the round, home among them, in one of so many stays.
    Round { stay: Stay, stays: u8, search: Search },
    /// Listens at home between two stays, the next of them at this rate: a turn of home.
    AtHome { next: BitRate, stays: u8, has_heard: bool, until: Instant },
    /// Listens to detect a home rate.
    Detecting(Stay),
    /// Takes part at the rate found, and only answers.
    Guest {
        _search: Search,
        rate: BitRate,
        /// The time of the latest valid frame that was received or acknowledged.
        heard_at: Instant,
        /// The errors since then.
        errors: u8,
        /// It has answered a request, or will.
        is_asked: bool,
        /// The end of the wait for an acknowledge.
        until: Option<Instant>,
    },
}

/// A stay at a rate, as a listener.
#[derive(Clone, Copy, Debug)]
struct Stay {
    rate: BitRate,
    until: Option<Instant>,
    /// There was an error, so there is traffic.
    has_heard: bool,
    /// An error has led from one rate to this one.
    has_moved: bool,
}

impl Stay {
    const fn new(rate: BitRate, until: Option<Instant>) -> Self {
        Self { rate, until, has_heard: false, has_moved: false }
    }
}

impl Supervision {
    /// The supervision of a node that was powered on with this setting: it only performs automatic detection, if the
    /// setting demands it.
    pub const fn new(setting: BitRateSetting, rates: BitRates) -> Self {
        let (home, place, step) = match setting {
            BitRateSetting::Fixed(rate) => (rate, Place::Home { until: None }, None),
            BitRateSetting::Automatic => {
                let rate = rates.fastest();
                (rate, Place::Detecting(Stay::new(rate, None)), Some(Step::Listen(rate)))
            }
        };
        Self {
            rates,
            search: None,
            serial_number: 0,
            home,
            is_proven: true,
            previous: None,
            trusted_until: None,
            place,
            is_in_session: false,
            step,
            active: home,
            rescues: 0,
        }
    }

    /// Adds the search from an unproven home.
    #[cfg(feature = "rescue")]
    pub const fn with_rescue(self, serial_number: u32) -> Self {
        Self { search: Some(Search::On), is_proven: false, serial_number, ..self }
    }

    /// The bit rate at which the controller runs or listens.
    pub const fn bit_rate(&self) -> BitRate {
        match self.place {
            Place::Home { .. } | Place::Pause { .. } | Place::AtHome { .. } => self.home,
            Place::Round { stay, .. } | Place::Detecting(stay) => stay.rate,
            Place::Guest { rate, .. } => rate,
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
        matches!(self.place, Place::Round { .. } | Place::AtHome { .. } | Place::Detecting(_))
    }

    /// Whether the node may send frames.
    pub const fn may_send(&self) -> bool {
        !self.is_listening() && !matches!(self.place, Place::Pause { .. })
    }

    /// Whether the node takes part at a rate that it has found.
    pub const fn is_guest(&self) -> bool {
        matches!(self.place, Place::Guest { .. })
    }

    /// Whether the node may report itself, which a guest only does once it was asked.
    pub const fn may_report(&self) -> bool {
        self.may_send() && !matches!(self.place, Place::Guest { is_asked: false, .. })
    }

    /// Whether automatic detection has not found a rate yet.
    pub const fn is_detecting(&self) -> bool {
        matches!(self.place, Place::Detecting(_))
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
        self.is_proven && matches!(self.place, Place::Home { .. }) && self.step.is_none()
    }

    /// Whether the controller listens in a search, at a rate other than home.
    pub fn is_elsewhere(&self) -> bool {
        matches!(self.place, Place::Round { stay, .. } if stay.rate != self.home)
    }

    /// The rate at which the node takes part, if it differs from the last one returned or commanded: the node has
    /// become a guest or has returned home.
    pub fn take_change(&mut self) -> Option<BitRate> {
        let rate = self.bit_rate();
        let takes_part = matches!(self.place, Place::Home { .. } | Place::Guest { .. });
        if !takes_part || rate == self.active {
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
            self.is_proven |= self.is_guest();
        } else {
            self.is_proven = self.search.is_none();
            self.previous = Some(before);
            self.step = Some(Step::TakePart(rate));
        }
        self.home = rate;
        self.active = rate;
        self.place = Place::Home { until: None };
        self.trusted_until = Some(silent_until.plus_micros(TRUST_MICROS));
    }

    /// Begins automatic detection.
    pub fn detect(&mut self) {
        self.detect_at(self.rates.fastest(), None);
        self.trusted_until = None;
    }

    /// Records that the node has sent a frame; that of a guest is an answer.
    pub fn note_sent(&mut self, now: Instant) {
        let acknowledged_by = now.plus_micros(REPEAT_MICROS);
        self.note_asked();
        match &mut self.place {
            Place::Home { until } if !self.is_proven => _ = until.get_or_insert(acknowledged_by),
            Place::Guest { until, .. } => _ = until.get_or_insert(acknowledged_by),
            _ => {}
        }
    }

    /// Records a request that the node will answer.
    pub const fn note_asked(&mut self) {
        if let Place::Guest { is_asked, .. } = &mut self.place {
            *is_asked = true;
        }
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
            BusEvent::FormError if !matches!(self.place, Place::AtHome { .. }) => {
                self.handle_error(false, now);
            }
            // Reception cannot wait for the recovery, which takes hundreds of frames on a busy bus. A controller that
            // takes part at once would destroy the frames of a master at another rate.
            BusEvent::BusOff if matches!(self.place, Place::Home { .. }) => {
                self.listen_at_home(self.home, MOST_STAYS, false, self.pause_end(now));
            }
            // A short circuit is no evidence of another rate.
            BusEvent::HeldDominant if self.is_listening() && !self.is_detecting() => {
                self.stay_home();
            }
            _ => {}
        }
    }

    fn handle_valid(&mut self, now: Instant) {
        match &mut self.place {
            Place::Guest { heard_at, errors, until, .. } => {
                (*heard_at, *errors, *until) = (now, 0, None);
            }
            Place::Round { stay, search, .. } if stay.rate != self.home => {
                let rate = stay.rate;
                self.place = Place::Guest {
                    _search: *search,
                    rate,
                    heard_at: now,
                    errors: 0,
                    is_asked: false,
                    until: None,
                };
                self.step = Some(Step::TakePart(rate));
            }
            Place::Detecting(stay) => {
                (self.home, self.active) = (stay.rate, stay.rate);
                self.prove();
            }
            _ => self.prove(),
        }
    }

    /// Handles an error; a form error does not lead to another rate: a silent listener sees one when a frame is not
    /// acknowledged.
    fn handle_error(&mut self, leads_on: bool, now: Instant) {
        match self.place {
            Place::Home { .. } | Place::Pause { .. } => {
                if let Some(search) = self.search
                    && !self.is_proven
                    && self.trusted_until.is_none()
                {
                    let fastest = self.next_rate(BitRate::Kbit10);
                    let other =
                        if fastest == self.home { self.next_rate(fastest) } else { fastest };
                    let rate = self.previous.take().unwrap_or(other);
                    self.stay(search, rate, 0, now);
                }
            }
            Place::Guest { rate, ref mut errors, .. } => {
                *errors = errors.saturating_add(1);
                if *errors >= MOST_ERRORS {
                    self.take_turn(rate, 0, true, now);
                }
            }
            Place::Round { stay, stays, search } => {
                let stay = self.note_traffic(stay, leads_on, now);
                self.place = Place::Round { stay, stays, search };
            }
            Place::Detecting(stay) => {
                self.place = Place::Detecting(self.note_traffic(stay, leads_on, now));
            }
            Place::AtHome { ref mut has_heard, .. } => *has_heard = true,
        }
    }

    /// The stay after an error, which shows that there is traffic.
    fn note_traffic(&mut self, stay: Stay, leads_on: bool, now: Instant) -> Stay {
        let until = Instant::earliest(stay.until, Some(now.plus_micros(HEARD_MICROS)));
        let mut stay = Stay { until, has_heard: true, ..stay };
        if leads_on {
            (stay.rate, stay.has_moved) = (self.next_rate(stay.rate), true);
            self.step = Some(Step::Listen(stay.rate));
        }
        stay
    }

    /// Returns the next step, if one is due at `now`.
    pub fn poll(&mut self, now: Instant) -> Option<Step> {
        if self.step.is_none() {
            let is_over = |end: Option<Instant>| end.is_some_and(|end| end.has_come(now));
            if is_over(self.trusted_until) {
                self.trusted_until = None;
            }
            if is_over(self.end()) {
                self.end_stay(now);
            }
        }
        self.step.take()
    }

    /// The latest time of the next [`poll`](Self::poll), if nothing else happens before.
    pub fn poll_at(&self) -> Option<Instant> {
        Instant::earliest(self.end(), self.trusted_until)
    }

    /// The end of the stay at the place.
    fn end(&self) -> Option<Instant> {
        match self.place {
            Place::Home { until } => until,
            Place::Pause { until } | Place::AtHome { until, .. } => Some(until),
            Place::Round { stay, .. } | Place::Detecting(stay) => stay.until,
            Place::Guest { heard_at, until, .. } => {
                let silence = if self.is_in_session { SESSION_MICROS } else { SILENCE_MICROS };
                Instant::earliest(until, Some(heard_at.plus_micros(silence)))
            }
        }
    }

    fn end_stay(&mut self, now: Instant) {
        match self.place {
            Place::Home { .. } => {
                self.place = Place::Pause { until: self.pause_end(now) };
                self.step = Some(Step::DropFrames);
            }
            Place::Pause { .. } => self.place = Place::Home { until: None },
            Place::Round { stay, stays, .. } => {
                self.take_turn(self.rate_after(stay), stays, stay.has_heard, now);
            }
            Place::AtHome { next, stays, has_heard, .. } => match self.search {
                Some(search) if has_heard && stays < MOST_STAYS => {
                    self.stay(search, next, stays, now);
                }
                _ => self.stay_home(),
            },
            Place::Guest { rate, .. } => self.take_turn(rate, 0, false, now),
            Place::Detecting(stay) if stay.has_heard => {
                self.detect_at(self.rate_after(stay), Some(now.plus_micros(STAY_MICROS)));
            }
            Place::Detecting(_) => self.detect(),
        }
    }

    /// The rate of the next stay.
    fn rate_after(&self, stay: Stay) -> BitRate {
        if stay.has_moved { stay.rate } else { self.next_rate(stay.rate) }
    }

    fn detect_at(&mut self, rate: BitRate, until: Option<Instant>) {
        self.place = Place::Detecting(Stay::new(rate, until));
        self.step = Some(Step::Listen(rate));
    }

    fn pause_end(&self, now: Instant) -> Instant {
        now.plus_micros(PAUSE_MICROS + PAUSE_STEP_MICROS * (self.serial_number & 0xFF))
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
        self.place = Place::Home { until: None };
    }

    /// Listens at a rate of the round, after so many stays.
    fn stay(&mut self, search: Search, rate: BitRate, stays: u8, now: Instant) {
        let stay = Stay::new(rate, Some(now.plus_micros(STAY_MICROS)));
        self.place = Place::Round { stay, stays: stays.saturating_add(1), search };
        self.step = Some(Step::Listen(rate));
    }

    /// Listens at home, and then at the next rate if there was an error at the last one, or is one at home.
    fn take_turn(&mut self, next: BitRate, stays: u8, has_heard: bool, now: Instant) {
        let micros =
            TURN_MICROS + TURN_FRAMES * FRAME_BITS * 1000 / u32::from(self.home.kbit_per_s());
        self.listen_at_home(next, stays, has_heard, now.plus_micros(micros));
    }

    fn listen_at_home(&mut self, next: BitRate, stays: u8, has_heard: bool, until: Instant) {
        self.place = Place::AtHome { next, stays, has_heard, until };
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
