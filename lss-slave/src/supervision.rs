//! Bit-rate supervision: the choice of the node's bit rate and the search for another (`docs/bit-rates.md`).
//!
//! The *home* rate is the one last commanded: stored at power-on, or activated since. At home the node behaves like a
//! node without supervision. Only lasting errors without a single valid frame start a search. The node then listens
//! silently at the other rates, in slices that are short enough for a master at the home rate to be answered within 100
//! ms. A valid frame at another rate makes the node a *guest* there, until errors or a missing acknowledge send it
//! home.

use core::mem;

use crate::{BitRate, BitRateSetting, BitRates, BusEvent, Instant};

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
/// The time for which a disturbed node withholds its frames after the latest error. After bus-off it is at least the
/// time of the recovery (ISO 11898-1).
const WITHHOLD_MICROS: u32 = 50_000;
const RECOVERY_BITS: u32 = 128 * 11;
/// The time for which an unacknowledged frame is repeated, and the pause that follows. Without a pause a slower node
/// never sees the 11 recessive bits that let it join the bus.
const REPEAT_MICROS: u32 = 100_000;
const PAUSE_MICROS: u32 = 20_000;
/// The number of errors without a valid frame, and the time they span, that make a proven home rate doubtful. A rate
/// that was not proven in this power cycle is doubtful after the first error, since frames may be rare.
const LASTING_ERRORS: u8 = 3;
const LASTING_MICROS: u32 = 1_000_000;
/// Errors further apart than this are not added up.
const GAP_MICROS: u32 = 2_500_000;
/// The number of errors without a valid frame that send a guest home.
const GUEST_ERRORS: u8 = 2;
/// The time for which a guest waits for an acknowledge.
const ACKNOWLEDGE_MICROS: u32 = 1_000_000;
/// The length of a look at another rate once something was heard, and the longest wait for that: a network may have no
/// more than one heartbeat a second.
const LOOK_MICROS: u32 = 40_000;
const WAIT_MICROS: u32 = 1_100_000;
/// The time for which the node listens at home between two looks, in addition to the time of two frames.
const TURN_MICROS: u32 = 20_000;
const TURN_BITS: u32 = 2 * 135;
/// Home opens in spite of errors that have gone on for this long: a master that only listens must hear the node.
const DISTURBANCE_MICROS: u32 = 500_000;
/// The time for which the node takes part at home between two looks while the bus is quiet: the longer of the two. A
/// master that only listens hears the node once the node is error passive, after 16 attempts at a frame.
const OPEN_TURN_MICROS: u32 = 150_000;
const OPEN_TURN_BITS: u32 = 3_000;
/// Errors this close together belong to one episode. A look that hears anything lasts no longer.
const EPISODE_GAP_MICROS: u32 = 60_000;
/// The duration of two frames at 10 kbit/s.
const FRAME_MICROS: u32 = 30_000;
/// The next look waits if new errors follow a fruitless look within this time.
const DOUBT_MICROS: u32 = 3_000_000;
/// The number of form errors after which detection leaves a rate. A lone master is error passive after 16 attempts and
/// can then be received.
const FORM_ERRORS: u8 = 20;
/// The time for which detection listens at one rate to a silent bus.
const DETECTION_MICROS: u32 = 1_500_000;

/// The supervision, which chooses the node's bit rate.
#[derive(Clone, Debug)]
pub(crate) struct Supervision {
    rates: BitRates,
    is_enabled: bool,
    home: BitRate,
    /// A frame was received or acknowledged at home since power-on or the latest switch.
    is_proven: bool,
    /// A frame was repeated at home for [`REPEAT_MICROS`] and only the acknowledge was missing: no other node takes
    /// part.
    is_alone: bool,
    /// A search ended at home, and no frame was received since: lasting noise must not keep the node silent.
    has_searched: bool,
    /// The rate before the latest switch, until the search has visited it.
    previous: Option<BitRate>,
    trusted_until: Option<Instant>,
    /// Until then, a look waits until something is heard.
    doubted_until: Option<Instant>,
    place: Place,
    errors: Errors,
    sending: Sending,
    /// The step that [`poll`](Self::poll) returns next.
    step: Option<Step>,
    /// The rate at which the node last took part, as returned by [`take_change`](Self::take_change).
    active: BitRate,
    rescues: u16,
}

#[derive(Clone, Debug)]
enum Place {
    Home,
    Guest { rate: BitRate, unacknowledged_until: Option<Instant> },
    Looking { look: Look, turn: Turn, until: Instant },
    Detecting { rate: BitRate, until: Instant, form_errors: u8 },
}

impl Place {
    const fn detecting(rate: BitRate) -> Self {
        Self::Detecting { rate, until: Instant::from_micros(0), form_errors: 0 }
    }
}

/// Whether the node may send frames where it takes part.
#[derive(Clone, Copy, Debug)]
enum Sending {
    Free,
    /// A frame is being repeated without an acknowledge.
    Unacknowledged {
        until: Instant,
    },
    Withheld {
        until: Instant,
    },
}

/// The state that a search keeps from one turn to the next.
#[derive(Clone, Copy, Debug)]
struct Look {
    /// The rate to listen at when it is not home's turn.
    candidate: BitRate,
    /// The latest look ended at a different candidate than it began with.
    has_moved: bool,
    /// The next look waits until something is heard.
    waits: bool,
    /// A look has waited.
    has_waited: bool,
    /// The latest errors in close succession.
    episode: Errors,
}

impl Look {
    const fn at(candidate: BitRate) -> Self {
        let (has_moved, waits, has_waited) = (false, false, false);
        Self { candidate, has_moved, waits, has_waited, episode: Errors::NONE }
    }

    fn add_error(&mut self, now: Instant) {
        if self.episode.latest.plus_micros(EPISODE_GAP_MICROS).has_come(now) {
            self.episode = Errors::NONE;
        }
        self.episode.add(now);
    }

    /// Whether the episode has lasted for a number of microseconds.
    fn lasts(&self, micros: u32) -> bool {
        self.episode.first.plus_micros(micros).has_come(self.episode.latest)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Turn {
    /// Listens at the candidate.
    Elsewhere { has_heard: bool },
    /// Listens at home.
    HomeSilent { has_heard: bool },
    /// Takes part at home.
    HomeOpen,
}

/// Errors since the latest valid frame.
#[derive(Clone, Copy, Debug)]
struct Errors {
    count: u8,
    first: Instant,
    latest: Instant,
}

impl Errors {
    const NONE: Self =
        Self { count: 0, first: Instant::from_micros(0), latest: Instant::from_micros(0) };

    fn add(&mut self, now: Instant) {
        if self.count == 0 {
            self.first = now;
        }
        self.count = self.count.saturating_add(1);
        self.latest = now;
    }

    fn are_forgotten_at(&self) -> Option<Instant> {
        (self.count > 0).then(|| self.latest.plus_micros(GAP_MICROS))
    }
}

impl Supervision {
    /// The supervision of a node that was powered on with this setting. If disabled, the node only performs automatic
    /// detection, if the setting demands it.
    pub const fn new(setting: BitRateSetting, rates: BitRates, is_enabled: bool) -> Self {
        let (home, place, step) = match setting {
            BitRateSetting::Fixed(rate) => (rate, Place::Home, None),
            BitRateSetting::Automatic => {
                let rate = rates.fastest();
                (rate, Place::detecting(rate), Some(Step::Listen(rate)))
            }
        };
        Self {
            rates,
            is_enabled,
            home,
            is_proven: false,
            is_alone: false,
            has_searched: false,
            previous: None,
            trusted_until: None,
            doubted_until: None,
            place,
            errors: Errors::NONE,
            sending: Sending::Free,
            step,
            active: home,
            rescues: 0,
        }
    }

    /// The bit rate at which the controller runs or listens.
    #[inline(never)] // It has several callers: 130 bytes.
    pub const fn bit_rate(&self) -> BitRate {
        match &self.place {
            Place::Guest { rate, .. } | Place::Detecting { rate, .. } => *rate,
            Place::Looking { look, turn: Turn::Elsewhere { .. }, .. } => look.candidate,
            Place::Home | Place::Looking { .. } => self.home,
        }
    }

    /// The active rate: the commanded rate, or the one at which the node has found the others.
    pub const fn active(&self) -> BitRate {
        self.active
    }

    /// The home rate; `None` until it has been detected.
    pub const fn home(&self) -> Option<BitRate> {
        match self.place {
            Place::Detecting { .. } => None,
            _ => Some(self.home),
        }
    }

    /// The number of times that the node has become a guest.
    pub const fn rescues(&self) -> u16 {
        self.rescues
    }

    /// Whether the controller listens silently.
    pub const fn is_listening(&self) -> bool {
        match self.place {
            Place::Detecting { .. } => true,
            Place::Looking { turn, .. } => !matches!(turn, Turn::HomeOpen),
            Place::Home | Place::Guest { .. } => false,
        }
    }

    /// Whether the node takes part but sends no frames.
    pub const fn is_withholding(&self) -> bool {
        matches!(self.sending, Sending::Withheld { .. })
    }

    /// Whether automatic detection has not found a rate yet.
    pub const fn is_detecting(&self) -> bool {
        matches!(self.place, Place::Detecting { .. })
    }

    /// Whether an event requires a step that has not been taken.
    pub const fn has_step(&self) -> bool {
        self.step.is_some()
    }

    /// Whether the node takes part at home and does not search.
    pub const fn is_at_home(&self) -> bool {
        matches!(self.place, Place::Home)
    }

    /// Whether the controller listens at a rate other than home.
    pub const fn is_elsewhere(&self) -> bool {
        matches!(self.place, Place::Looking { turn: Turn::Elsewhere { .. }, .. })
    }

    /// Whether another valid frame makes no difference.
    pub const fn is_at_ease(&self) -> bool {
        self.is_in_service() && matches!(self.sending, Sending::Free)
    }

    /// Whether another valid frame makes no difference but to what is being sent.
    const fn is_in_service(&self) -> bool {
        self.is_at_home() && self.is_proven && !self.has_searched && self.errors.count == 0
    }

    /// The time until which a frame is repeated without an acknowledge.
    pub const fn repeats_until(&self) -> Option<Instant> {
        match self.sending {
            Sending::Unacknowledged { until } => Some(until),
            _ => None,
        }
    }

    /// Handles an acknowledge if it only ends the repetition of a frame; returns whether it does.
    pub const fn take_acknowledge(&mut self) -> bool {
        let takes = self.is_in_service() && !self.is_withholding();
        if takes {
            self.sending = Sending::Free;
        }
        takes
    }

    /// The rate at which the node takes part, if it differs from the last one returned or commanded: the node has
    /// become a guest or has returned home.
    pub fn take_change(&mut self) -> Option<BitRate> {
        let rate = match self.place {
            Place::Home => self.home,
            Place::Guest { rate, .. } => rate,
            Place::Looking { .. } | Place::Detecting { .. } => return None,
        };
        if rate == self.active {
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
            self.is_proven |= matches!(self.place, Place::Guest { .. });
        } else {
            self.is_proven = false;
            self.previous = Some(before);
            self.step = Some(Step::TakePart(rate));
        }
        self.is_alone = false;
        self.has_searched = false;
        self.home = rate;
        self.active = rate;
        self.enter(Place::Home);
        self.sending = Sending::Free;
        self.doubted_until = None;
        self.trusted_until = Some(silent_until.plus_micros(TRUST_MICROS));
    }

    /// Begins automatic detection.
    pub fn detect(&mut self) {
        let rate = self.rates.fastest();
        self.enter(Place::detecting(rate));
        self.sending = Sending::Free;
        self.step = Some(Step::Listen(rate));
        self.trusted_until = None;
    }

    /// Records that the node has sent a frame.
    pub fn note_sent(&mut self, now: Instant) {
        if self.is_enabled && matches!(self.sending, Sending::Free) {
            self.sending = Sending::Unacknowledged { until: now.plus_micros(REPEAT_MICROS) };
        }
        if let Place::Guest { unacknowledged_until, .. } = &mut self.place {
            unacknowledged_until.get_or_insert(now.plus_micros(ACKNOWLEDGE_MICROS));
        }
    }

    /// Handles an observation of the controller.
    pub fn handle(&mut self, event: BusEvent, now: Instant) {
        use BusEvent::*;
        if event == BusOff && self.is_enabled {
            let rate = self.bit_rate();
            let micros = WITHHOLD_MICROS.max(bits_micros(RECOVERY_BITS, rate));
            self.sending = Sending::Withheld { until: now.plus_micros(micros) };
            if !self.is_listening() {
                // Reception cannot wait for the recovery, which takes hundreds of frames on a busy bus.
                self.step = Some(Step::TakePart(rate));
            }
            return;
        }
        if matches!(event, Received | Acknowledged) {
            self.errors = Errors::NONE;
            self.sending = Sending::Free;
        }
        match (&mut self.place, event) {
            // Errors in the open turn may come from the node's own frames.
            (Place::Looking { turn: Turn::HomeOpen, .. }, _) => {}
            (Place::Looking { look, .. }, Error | FormError) => look.add_error(now),
            _ => {}
        }
        match (&mut self.place, event) {
            (Place::Home, Received | Acknowledged) => {
                self.is_proven = true;
                self.previous = None;
                self.has_searched &= event == Acknowledged;
            }
            (Place::Home, Error | FormError) if self.is_enabled => {
                self.errors.add(now);
                if !self.has_searched && self.is_withholding() {
                    self.withhold(now);
                }
                self.doubt(now);
            }
            (Place::Home, HeldDominant) => self.errors = Errors::NONE,
            (Place::Home, ErrorPassive)
                if self.is_enabled && !matches!(self.sending, Sending::Withheld { .. }) =>
            {
                self.withhold(now);
            }
            (Place::Guest { unacknowledged_until, .. }, Received | Acknowledged) => {
                *unacknowledged_until = None;
            }
            (Place::Guest { .. }, Error | FormError) => {
                self.errors.add(now);
                if self.errors.count >= GUEST_ERRORS {
                    self.leave_as_guest(now);
                }
            }
            (Place::Looking { look, turn, until }, event) => match (&mut *turn, event) {
                (Turn::Elsewhere { .. }, Received) => {
                    let rate = look.candidate;
                    self.enter(Place::Guest { rate, unacknowledged_until: None });
                    self.step = Some(Step::TakePart(rate));
                }
                (Turn::Elsewhere { has_heard }, Error | FormError) => {
                    look.waits = true;
                    *has_heard = true;
                    *until = until.earlier(now.plus_micros(LOOK_MICROS));
                    if event == Error {
                        look.has_moved = true;
                        look.candidate = next_rate(self.rates, look.candidate, Some(self.home));
                        self.step = Some(Step::Listen(look.candidate));
                    }
                }
                (Turn::HomeSilent { .. }, Received) | (Turn::HomeOpen, Received | Acknowledged) => {
                    self.is_proven = true;
                    self.end_look();
                }
                (_, HeldDominant) => self.end_look(),
                (Turn::HomeSilent { has_heard }, Error) => *has_heard = true,
                (Turn::HomeSilent { has_heard: false }, FormError) => {
                    let look = *look;
                    self.withhold(now);
                    self.open_home(look, now);
                }
                (Turn::HomeOpen, Error | FormError) if !look.lasts(DISTURBANCE_MICROS) => {
                    look.waits = true;
                    *until = until.earlier(now.plus_micros(turn_micros(self.home)));
                    self.withhold(now);
                }
                _ => {}
            },
            (Place::Detecting { rate, .. }, Received) => {
                self.home = *rate;
                self.active = *rate;
                self.is_proven = true;
                self.previous = None;
                self.step = Some(Step::TakePart(*rate));
                self.enter(Place::Home);
            }
            (Place::Detecting { rate, form_errors, .. }, Error | FormError) => {
                *form_errors = form_errors.saturating_add(1);
                if event == Error || *form_errors > FORM_ERRORS {
                    let slower = next_rate(self.rates, *rate, None);
                    self.place = Place::detecting(slower);
                    self.step = Some(Step::Listen(slower));
                }
            }
            _ => {}
        }
    }

    /// Returns the next step, if one is due at `now`.
    pub fn poll(&mut self, now: Instant) -> Option<Step> {
        if self.step.is_none() {
            self.end_what_is_over(now);
        }
        let step = self.step.take()?;
        if let Place::Detecting { until, .. } = &mut self.place {
            *until = now.plus_micros(DETECTION_MICROS);
        }
        Some(step)
    }

    /// The latest time of the next [`poll`](Self::poll), if nothing else happens before.
    pub fn poll_at(&self) -> Option<Instant> {
        let of_place = match self.place {
            Place::Home => None,
            Place::Guest { unacknowledged_until, .. } => unacknowledged_until,
            Place::Looking { until, .. } | Place::Detecting { until, .. } => Some(until),
        };
        let of_sending = match self.sending {
            Sending::Free => None,
            Sending::Unacknowledged { until } | Sending::Withheld { until } => Some(until),
        };
        let of_place = Instant::earliest(
            of_place,
            Instant::earliest(of_sending, self.errors.are_forgotten_at()),
        );
        Instant::earliest(of_place, Instant::earliest(self.trusted_until, self.doubted_until))
    }

    #[inline(never)] // Apart it takes 130 bytes less.
    fn end_what_is_over(&mut self, now: Instant) {
        let is_over = |end: &Option<Instant>| end.is_some_and(|end| end.has_come(now));
        if is_over(&self.trusted_until) {
            self.trusted_until = None;
        }
        if is_over(&self.doubted_until) {
            self.doubted_until = None;
        }
        if is_over(&self.errors.are_forgotten_at()) {
            self.errors = Errors::NONE;
        }
        match self.sending {
            Sending::Unacknowledged { until } if until.has_come(now) => {
                self.sending = Sending::Withheld { until: now.plus_micros(PAUSE_MICROS) };
                self.step = Some(Step::DropFrames);
                self.is_alone = self.is_at_home();
            }
            Sending::Withheld { until } if until.has_come(now) => self.sending = Sending::Free,
            _ => {}
        }
        match &mut self.place {
            Place::Guest { unacknowledged_until, .. } if is_over(unacknowledged_until) => {
                self.leave_as_guest(now);
            }
            &mut Place::Looking { look, turn, until } if until.has_come(now) => {
                self.end_turn(look, turn, now);
            }
            Place::Detecting { rate, until, .. } if until.has_come(now) => {
                *until = now.plus_micros(DETECTION_MICROS);
                let fastest = self.rates.fastest();
                if *rate != fastest {
                    self.place = Place::detecting(fastest);
                    self.step = Some(Step::Listen(fastest));
                }
            }
            _ => {}
        }
    }

    fn end_turn(&mut self, look: Look, turn: Turn, now: Instant) {
        match turn {
            Turn::Elsewhere { has_heard } => {
                let waits = look.waits && (has_heard || !look.has_waited);
                self.listen_at_home(Look { waits, ..look }, now);
            }
            Turn::HomeSilent { has_heard: true } if !look.lasts(DISTURBANCE_MICROS) => {
                let next = || next_rate(self.rates, look.candidate, Some(self.home));
                let candidate = if look.has_moved { look.candidate } else { next() };
                self.look_elsewhere(Look { candidate, ..look }, LOOK_MICROS, now);
            }
            Turn::HomeSilent { .. } => self.open_home(look, now),
            Turn::HomeOpen if look.waits => {
                // Errors that lasted longer than one frame and its repetition were no rare frame to wait for.
                let micros = if look.lasts(FRAME_MICROS) { LOOK_MICROS } else { WAIT_MICROS };
                let look = Look { has_waited: true, episode: Errors::NONE, ..look };
                self.look_elsewhere(look, micros, now);
            }
            Turn::HomeOpen => {
                self.has_searched = true;
                self.place = Place::Home;
                self.doubted_until = Some(now.plus_micros(DOUBT_MICROS));
            }
        }
    }

    /// Begins a look if the errors at home justify it.
    fn doubt(&mut self, now: Instant) {
        let are_lasting = self.errors.count >= LASTING_ERRORS
            && self.errors.first.plus_micros(LASTING_MICROS).has_come(now);
        if self.is_proven && !are_lasting || self.trusted_until.is_some() {
            return;
        }
        let slowest = BitRate::Kbit10;
        let fastest = next_rate(self.rates, slowest, Some(self.home));
        let candidate = self.previous.take().unwrap_or(fastest);
        let is_alone = mem::take(&mut self.is_alone);
        let waits = !self.is_proven && !is_alone || self.doubted_until.is_some();
        let mut look = Look { waits, ..Look::at(candidate) };
        look.add_error(now);
        self.look_elsewhere(look, LOOK_MICROS, now);
    }

    fn leave_as_guest(&mut self, now: Instant) {
        let candidate = self.bit_rate();
        self.listen_at_home(Look { has_moved: true, waits: true, ..Look::at(candidate) }, now);
    }

    #[inline(never)] // It has several callers: 20 to 50 bytes.
    fn look_elsewhere(&mut self, look: Look, micros: u32, now: Instant) {
        self.enter(Place::Looking {
            look: Look { has_moved: false, ..look },
            turn: Turn::Elsewhere { has_heard: false },
            until: now.plus_micros(micros),
        });
        self.step = Some(Step::Listen(look.candidate));
    }

    #[inline(never)] // It has several callers: 20 to 50 bytes.
    fn listen_at_home(&mut self, look: Look, now: Instant) {
        self.enter(Place::Looking {
            look,
            turn: Turn::HomeSilent { has_heard: false },
            until: now.plus_micros(turn_micros(self.home)),
        });
        self.step = Some(Step::Listen(self.home));
    }

    #[inline(never)] // It has several callers: 20 to 50 bytes.
    fn open_home(&mut self, look: Look, now: Instant) {
        let micros = OPEN_TURN_MICROS.max(bits_micros(OPEN_TURN_BITS, self.home));
        let until = now.plus_micros(micros);
        self.place = Place::Looking { look, turn: Turn::HomeOpen, until };
        self.step = Some(Step::TakePart(self.home));
    }

    /// Returns home to stay.
    fn end_look(&mut self) {
        self.has_searched = true;
        if self.is_listening() {
            self.step = Some(Step::TakePart(self.home));
        }
        self.enter(Place::Home);
    }

    /// Drops the pending frames and withholds new ones for a while.
    #[inline(never)] // It has several callers: 60 bytes.
    fn withhold(&mut self, now: Instant) {
        let mut end = now.plus_micros(WITHHOLD_MICROS);
        match self.sending {
            Sending::Withheld { until } => end = until.later(end),
            _ => self.step = Some(Step::DropFrames),
        }
        self.sending = Sending::Withheld { until: end };
    }

    fn enter(&mut self, place: Place) {
        self.place = place;
        self.errors = Errors::NONE;
        // A node recovers from bus-off wherever it is.
        if !self.is_withholding() {
            self.sending = Sending::Free;
        }
    }
}

/// The rate to listen at after `rate`: the next slower one, and after the slowest the fastest. At a rate that is too
/// fast each frame ends in a stuff error, since its bits last too long; at a rate that is too slow a frame may pass
/// unnoticed.
fn next_rate(rates: BitRates, rate: BitRate, except: Option<BitRate>) -> BitRate {
    let candidates =
        || BitRate::ALL.into_iter().filter(|&other| rates.contains(other) && Some(other) != except);
    let slower = candidates().find(|other| other.kbit_per_s() < rate.kbit_per_s());
    slower.or_else(|| candidates().next()).unwrap_or(rate)
}

const fn turn_micros(home: BitRate) -> u32 {
    TURN_MICROS + bits_micros(TURN_BITS, home)
}

const fn bits_micros(bits: u32, rate: BitRate) -> u32 {
    bits * 1000 / rate.kbit_per_s() as u32
}
