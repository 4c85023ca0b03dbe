//! Bit-rate supervision: which bit rate the node runs at, and when it looks for another (`docs/bit-rates.md`).
//!
//! The *home* rate is the one last commanded: stored at power-on, or activated since. There the node behaves as a node
//! without supervision does. Only lasting errors without one valid frame make it look elsewhere. It then listens silently at
//! the other rates, in slices that are short enough for a master at the home rate to be answered within 100 ms. A valid frame
//! at another rate makes the node a *guest* there, until errors or a missing acknowledge send it home.

use core::mem;

use crate::{BitRate, BitRateSetting, BitRates, BusEvent, Instant};

/// What the node does next about its bit rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Take part in the bus at this rate.
    TakePart(BitRate),
    /// Receive silently at this rate.
    Listen(BitRate),
    /// Drop the frames that wait.
    DropFrames,
}

/// How long a commanded rate counts alone after the switch.
const TRUST_MICROS: u32 = 30_000_000;
/// How long a disturbed node withholds its frames after the latest error, and at least after bus-off: the time of the
/// recovery (ISO 11898-1).
const WITHHOLD_MICROS: u32 = 50_000;
const RECOVERY_BITS: u32 = 128 * 11;
/// How long a frame is repeated that nobody acknowledges, and the pause that follows. Without a pause a slower node never
/// sees the 11 recessive bits that let it join the bus.
const REPEAT_MICROS: u32 = 100_000;
const PAUSE_MICROS: u32 = 20_000;
/// How many errors without a valid frame, and for how long, make a home rate doubtful that was proven in this power cycle. One
/// that was not is doubtful at the first: frames may be rare.
const LASTING_ERRORS: u8 = 3;
const LASTING_MICROS: u32 = 1_000_000;
/// Errors further apart than this do not add up.
const GAP_MICROS: u32 = 2_500_000;
/// Errors without a valid frame that send a guest home.
const GUEST_ERRORS: u8 = 2;
/// How long a guest waits for an acknowledge.
const ACKNOWLEDGE_MICROS: u32 = 1_000_000;
/// How long a look elsewhere lasts once something was heard, and how long it waits for that: a network may have no more
/// than one heartbeat a second.
const LOOK_MICROS: u32 = 40_000;
const WAIT_MICROS: u32 = 1_100_000;
/// How long home is listened to between two looks: this, and the time of two frames.
const TURN_MICROS: u32 = 20_000;
const TURN_BITS: u32 = 2 * 135;
/// How long the node takes part at home between two looks while the bus is quiet.
const OPEN_TURN_MICROS: u32 = 150_000;
/// Errors this close to one another belong to one episode: no look is longer that hears anything.
const EPISODE_GAP_MICROS: u32 = 60_000;
/// The time of two frames at 10 kbit/s.
const FRAME_MICROS: u32 = 30_000;
/// How soon new errors must follow a fruitless look for the next one to wait.
const DOUBT_MICROS: u32 = 3_000_000;
/// Form errors at one rate until detection leaves it. A lone master is error passive after 16 attempts, and then heard.
const FORM_ERRORS: u8 = 20;
/// How long detection listens at one rate to a silent bus.
const DETECTION_MICROS: u32 = 1_500_000;

/// Decides which bit rate the node runs at.
#[derive(Clone, Debug)]
pub(crate) struct Supervision {
    rates: BitRates,
    is_enabled: bool,
    home: BitRate,
    /// Something was received or acknowledged at home, since power-on or the latest switch.
    is_proven: bool,
    /// A frame was repeated at home for [`REPEAT_MICROS`], and nothing but an acknowledge was missing: nobody takes part.
    is_alone: bool,
    /// The rate before the latest switch, until it has been looked at.
    previous: Option<BitRate>,
    trusted_until: Option<Instant>,
    /// The next look waits for something to be heard.
    doubted_until: Option<Instant>,
    place: Place,
    errors: Errors,
    sending: Sending,
    /// Not yet taken by [`poll`](Self::poll).
    step: Option<Step>,
    /// The rate at which the node last took part, as [`take_change`](Self::take_change) knows it.
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

/// Whether own frames may leave where the node takes part.
#[derive(Clone, Copy, Debug)]
enum Sending {
    Free,
    /// A frame is repeated that nobody has acknowledged.
    Unacknowledged {
        until: Instant,
    },
    Withheld {
        until: Instant,
    },
}

/// What a search remembers from one turn to the next.
#[derive(Clone, Copy, Debug)]
struct Look {
    /// The rate that is listened to when it is not home's turn.
    candidate: BitRate,
    /// The latest look elsewhere ended at another candidate than it began.
    has_moved: bool,
    /// The next look waits for something to be heard.
    waits: bool,
    /// A look has waited.
    has_waited: bool,
    /// The latest errors that followed one another closely.
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

    /// Whether what was heard lasted longer than one frame that its sender repeats: a look need not wait for the next frame.
    fn is_dense(&self) -> bool {
        self.episode.first.plus_micros(FRAME_MICROS).has_come(self.episode.latest)
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
    /// The supervision of a node that was switched on with this setting. If it is not enabled, the node only detects its bit
    /// rate if the setting says so.
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

    /// The bit rate at which the controller runs, or listens.
    #[inline(never)] // It has several callers: 130 bytes.
    pub const fn bit_rate(&self) -> BitRate {
        match &self.place {
            Place::Guest { rate, .. } | Place::Detecting { rate, .. } => *rate,
            Place::Looking { look, turn: Turn::Elsewhere { .. }, .. } => look.candidate,
            Place::Home | Place::Looking { .. } => self.home,
        }
    }

    /// The active rate: the one commanded, or at which the node has found others.
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

    /// How often the node has become a guest at another rate.
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

    /// Whether the node sends no frame although it takes part.
    pub const fn is_withholding(&self) -> bool {
        matches!(self.sending, Sending::Withheld { .. })
    }

    /// Whether automatic detection has not found a rate yet.
    pub const fn is_detecting(&self) -> bool {
        matches!(self.place, Place::Detecting { .. })
    }

    /// Whether something that has happened asks for a step that has not been taken.
    pub const fn has_step(&self) -> bool {
        self.step.is_some()
    }

    /// Whether the node takes part at home, and looks nowhere else.
    pub const fn is_at_home(&self) -> bool {
        matches!(self.place, Place::Home)
    }

    /// Whether the controller listens at another rate than home.
    pub const fn is_elsewhere(&self) -> bool {
        matches!(self.place, Place::Looking { turn: Turn::Elsewhere { .. }, .. })
    }

    /// Whether one more valid frame makes no difference.
    pub const fn is_at_ease(&self) -> bool {
        self.is_at_home()
            && self.is_proven
            && self.errors.count == 0
            && matches!(self.sending, Sending::Free)
    }

    /// A rate to take part at that is another than the last one returned, or commanded: the node has become a guest, or is
    /// home again.
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

    /// Activate bit timing has come to the end of its first delay: `rate` is home from now on, and counts alone until 30 s
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

    /// Takes what the controller has observed.
    pub fn handle(&mut self, event: BusEvent, now: Instant) {
        use BusEvent::*;
        if event == BusOff && self.is_enabled {
            let rate = self.bit_rate();
            let micros = WITHHOLD_MICROS.max(bits_micros(RECOVERY_BITS, rate));
            self.sending = Sending::Withheld { until: now.plus_micros(micros) };
            if !self.is_listening() {
                // Receiving cannot wait for the recovery: on a busy bus that takes hundreds of frames.
                self.step = Some(Step::TakePart(rate));
            }
            return;
        }
        if matches!(event, Received | Acknowledged) {
            self.errors = Errors::NONE;
            self.sending = Sending::Free;
        }
        if let (Place::Looking { look, .. }, Error | FormError) = (&mut self.place, event) {
            look.add_error(now);
        }
        match (&mut self.place, event) {
            (Place::Home, Received | Acknowledged) => {
                self.is_proven = true;
                self.previous = None;
            }
            (Place::Home, Error | FormError) if self.is_enabled => {
                self.errors.add(now);
                if self.is_withholding() {
                    self.withhold(now);
                }
                self.doubt(now);
            }
            (Place::Home, HeldDominant) => {
                self.errors = Errors::NONE;
                if !matches!(self.sending, Sending::Free) {
                    self.withhold(now);
                }
            }
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
                    self.open_home(look, now);
                    self.withhold(now);
                    self.step = Some(Step::TakePart(self.home));
                }
                (Turn::HomeOpen, Error | FormError) => {
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

    /// The next step, if one is due at `now`.
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

    /// When [`poll`](Self::poll) must be called again, if nothing else happens before.
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

    #[inline(never)]
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
            Turn::HomeSilent { has_heard: true } => {
                let next = || next_rate(self.rates, look.candidate, Some(self.home));
                let candidate = if look.has_moved { look.candidate } else { next() };
                self.look_elsewhere(Look { candidate, ..look }, LOOK_MICROS, now);
            }
            Turn::HomeSilent { has_heard: false } => self.open_home(look, now),
            Turn::HomeOpen if look.waits => {
                let micros = if look.is_dense() { LOOK_MICROS } else { WAIT_MICROS };
                self.look_elsewhere(Look { has_waited: true, ..look }, micros, now);
            }
            Turn::HomeOpen => {
                self.place = Place::Home;
                self.doubted_until = Some(now.plus_micros(DOUBT_MICROS));
            }
        }
    }

    /// Looks elsewhere if the errors at home are reason enough.
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
        let until = now.plus_micros(OPEN_TURN_MICROS);
        self.place = Place::Looking { look, turn: Turn::HomeOpen, until };
        self.step = Some(Step::TakePart(self.home));
    }

    /// Takes part at home from now on, and stays.
    fn end_look(&mut self) {
        if self.is_listening() {
            self.step = Some(Step::TakePart(self.home));
        }
        self.enter(Place::Home);
    }

    #[inline(never)]
    /// Drops the frames that wait, and sends none for a while.
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
        // A bus-off is to be recovered from anywhere.
        if !self.is_withholding() {
            self.sending = Sending::Free;
        }
    }
}

/// The rate that is the next to listen at after `rate`: the next slower one, after the slowest the fastest. At a rate that is
/// too fast each frame ends in an error, since it holds its bits longer than stuffing allows; at one that is too slow it
/// may pass unnoticed.
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
