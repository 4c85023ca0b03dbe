//! Process data (CiA 301, 7.2.2): PDOs with the values of the application, at their events or at a SYNC.
//!
//! A product declares its PDOs in [`Application::TPDOS`] and [`Application::RPDOS`].

mod mapping;
mod parameters;
mod rpdo;
mod stored;
mod tables;
mod tpdo;

pub use crate::application::process_data::{Rpdo, Tpdo};
pub(crate) use parameters::Pdo;
pub(crate) use tables::{Tables, describe};

use core::mem;

use crate::{
    Application, Frame, Instant, NodeId,
    application::event::Event,
    declaration_error::DeclarationError,
    emergency::{COMMUNICATION, Emergency, PROCESS_DATA},
    nmt,
    numbers::{Element, List, Numbers},
    object_dictionary::{Entry, Object},
    sdo::Abort,
    settings::parameters::Packer,
    sync::{self, Sync},
};
use mapping::{Direction, Mapping};
use rpdo::Reception;
use tpdo::Transmission;

/// The most TPDOs, and the most RPDOs, of a node.
pub const MAX_PDOS: usize = 16;
/// The number of TPDOs, and of RPDOs, with a COB-ID in the predefined connection set (CiA 301, 7.3.5).
const PREDEFINED: usize = 4;
/// The sub-index of the inhibit time in the communication parameter of a TPDO (CiA 301, 7.5.2.37).
const INHIBIT_TIME: u8 = 3;
/// The parameters of the PDOs and of SYNC.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Configuration<N: Numbers> {
    tpdos: N::Tpdos<Pdo>,
    rpdos: N::Rpdos<Pdo>,
    sync: Sync,
}

/// The PDOs of a node. They take no code if there are none.
#[derive(Clone, Debug)]
pub(crate) struct Pdos<N: Numbers> {
    current: Configuration<N>,
    /// The parameters to which a reset returns.
    pub persistent: Configuration<N>,
    tpdos: N::Tpdos<Transmission>,
    /// The TPDOs in use whose type is synchronous.
    synchronous: Set,
    /// Those of them that do not answer each SYNC.
    counting: Set,
    /// The other TPDOs in use.
    event_driven: Set,
    /// The synchronous TPDOs that a SYNC has asked for, and the others that may have changed.
    due: Set,
    rpdos: N::Rpdos<Reception>,
    /// The latest SYNC had a wrong length.
    is_sync_wrong: bool,
    /// The end of the synchronous window.
    window_end: Option<Instant>,
    /// The synchronous window is over until the next SYNC.
    is_window_over: bool,
    /// The node is NMT operational.
    is_running: bool,
}

impl<N: Numbers> Configuration<N> {
    /// The parameters of a device with these PDOs, without SYNC parameters.
    pub const fn new(tpdos: N::Tpdos<Pdo>, rpdos: N::Rpdos<Pdo>) -> Self {
        Self { tpdos, rpdos, sync: Sync::new() }
    }

    fn pdo(&self, direction: Direction, at: usize) -> Option<&Pdo> {
        match direction {
            Direction::Transmit => self.tpdos.as_ref().get(at),
            Direction::Receive => self.rpdos.as_ref().get(at),
        }
    }

    fn pdo_mut(&mut self, direction: Direction, at: usize) -> Option<&mut Pdo> {
        match direction {
            Direction::Transmit => self.tpdos.as_mut().get_mut(at),
            Direction::Receive => self.rpdos.as_mut().get_mut(at),
        }
    }
}

/// Checks the number of PDOs of the node.
const fn check_number(direction: Direction, number: usize) {
    if number > MAX_PDOS {
        DeclarationError::of_pdo(direction.pdo(), MAX_PDOS + 1)
            .text("a node has at most 16")
            .raise();
    }
}

/// The TPDOs of a new device; panics, at compile time, with what is wrong.
pub(crate) const fn declared_tpdos<A: Application, const TPDOS: usize>() -> [Pdo; TPDOS] {
    check_number(Direction::Transmit, TPDOS);
    let mut tpdos = [Pdo::UNUSED; TPDOS];
    let mut at = 0;
    while at < A::TPDOS.len() {
        tpdos[at] = Pdo::declared_tpdo(at + 1, &A::TPDOS[at], A::OBJECTS);
        at += 1;
    }
    tpdos
}

/// The RPDOs of a new device; panics, at compile time, with what is wrong.
pub(crate) const fn declared_rpdos<A: Application, const RPDOS: usize>() -> [Pdo; RPDOS] {
    check_number(Direction::Receive, RPDOS);
    let mut rpdos = [Pdo::UNUSED; RPDOS];
    let mut at = 0;
    while at < A::RPDOS.len() {
        rpdos[at] = Pdo::declared_rpdo(at + 1, &A::RPDOS[at], A::OBJECTS);
        at += 1;
    }
    rpdos
}

impl<N: Numbers> Pdos<N> {
    /// Whether there are any.
    pub const IS_USED: bool = N::TPDOS + N::RPDOS > 0;

    /// The PDOs with these parameters.
    pub const fn new(configuration: Configuration<N>) -> Self {
        Self {
            current: configuration,
            persistent: configuration,
            tpdos: List::UNUSED,
            synchronous: Set::NONE,
            counting: Set::NONE,
            event_driven: Set::NONE,
            due: Set::NONE,
            rpdos: List::UNUSED,
            is_sync_wrong: false,
            window_end: None,
            is_window_over: false,
            is_running: false,
        }
    }

    /// Packs the PDOs in use, but for the event timers of RPDOs.
    pub fn save(&self, to: &mut Packer<'_>) {
        self.current.save(to);
    }

    /// Makes the parameters in use the persistent ones.
    pub fn keep_current(&mut self) {
        self.persistent = self.current;
        self.persistent.remove_unused();
    }

    /// Restarts as after power-on, with the persistent parameters.
    pub fn reset(&mut self) {
        if Self::IS_USED {
            self.current = self.persistent;
            self.stop();
            (self.is_sync_wrong, self.is_running) = (false, false);
        }
    }

    fn stop(&mut self) {
        (self.synchronous, self.counting) = (Set::NONE, Set::NONE);
        (self.event_driven, self.due) = (Set::NONE, Set::NONE);
        self.tpdos.as_mut().fill(Transmission::UNUSED);
        self.rpdos.as_mut().fill(Reception::UNUSED);
        (self.window_end, self.is_window_over) = (None, false);
    }

    /// Makes the parameters of a TPDO effective, and the TPDO due.
    fn start_tpdo(&mut self, at: usize, node: Option<NodeId>) {
        let (Some(tpdo), Some(pdo)) =
            (self.tpdos.as_mut().get_mut(at), self.current.tpdos.as_ref().get(at))
        else {
            return;
        };
        let sets =
            [&mut self.synchronous, &mut self.counting, &mut self.event_driven, &mut self.due];
        sets.into_iter().for_each(|set| set.remove(at));
        let cob_id = pdo.cob_id.active(base(Direction::Transmit, at), node);
        let Some(cob_id) = cob_id.filter(|_| self.is_running && !pdo.mapping.is_empty()) else {
            return;
        };
        *tpdo = tpdo.renewed(cob_id, pdo);
        if pdo.transmission_type <= 240 {
            self.synchronous.add(at);
            if pdo.transmission_type > 1 || pdo.sync_start_value > 0 {
                self.counting.add(at);
            }
        } else {
            self.event_driven.add(at);
            self.due.add(at);
        }
    }

    /// Makes the parameters of an RPDO effective, and forgets what it has received.
    fn start_rpdo(&mut self, at: usize, node: Option<NodeId>) {
        let cob_id = self.rpdo_cob_id(at, node).filter(|_| self.is_running);
        if let Some(rpdo) = self.rpdos.as_mut().get_mut(at) {
            *rpdo = Reception::new(cob_id);
        }
    }

    /// The state of a TPDO, and its parameters.
    fn tpdo(&mut self, at: usize) -> Option<(&mut Transmission, &Pdo)> {
        Some((self.tpdos.as_mut().get_mut(at)?, self.current.tpdos.as_ref().get(at)?))
    }

    /// The states of the RPDOs with their numbers, from 1, and their parameters.
    fn rpdos(&mut self) -> impl Iterator<Item = (u8, (&mut Reception, &Pdo))> {
        (1..).zip(self.rpdos.as_mut().iter_mut().zip(self.current.rpdos.as_ref()))
    }

    /// The COB-ID of SYNC, if there are PDOs.
    pub fn sync_cob_id(&self) -> Option<u16> {
        Self::IS_USED.then(|| self.current.sync.cob_id())
    }

    /// The COB-ID of an RPDO, if it is valid.
    pub fn rpdo_cob_id(&self, at: usize, node: Option<NodeId>) -> Option<u16> {
        let pdo = self.current.pdo(Direction::Receive, at)?;
        pdo.cob_id.active(base(Direction::Receive, at), Some(node?))
    }

    /// Follows the NMT state: PDOs live in NMT operational.
    pub fn follow(&mut self, state: nmt::State, node: Option<NodeId>) {
        let is_running = state == nmt::State::Operational;
        let was_running = mem::replace(&mut self.is_running, is_running);
        if !Self::IS_USED || is_running == was_running {
            return;
        }
        self.stop();
        (0..N::TPDOS).for_each(|at| self.start_tpdo(at, node));
        (0..N::RPDOS).for_each(|at| self.start_rpdo(at, node));
    }

    /// Makes all event-driven TPDOs due, since the board has dropped frames.
    pub fn frames_dropped(&mut self) {
        self.tpdos.as_mut().iter_mut().for_each(Transmission::restart);
        self.due = self.event_driven;
    }

    /// Records that values of the application may have changed.
    pub const fn note_values(&mut self) {
        self.due.add_all(self.event_driven);
    }

    /// Makes the TPDO with this number, from 1, due without a change, if it is in use. One of type 0 waits for SYNC.
    pub fn request(&mut self, number: u8) {
        let at = usize::from(number).wrapping_sub(1);
        if let Some(tpdo) = self.tpdos.as_mut().get_mut(at) {
            tpdo.request();
            if self.event_driven.has(at) {
                self.due.add(at);
            }
        }
    }

    /// Handles a frame that may be a PDO or SYNC; returns whether it is SYNC.
    pub fn handle_frame<A: Application>(
        &mut self,
        frame: &Frame,
        application: &mut A,
        errors: &mut Emergency,
        now: Instant,
    ) -> bool {
        if !Self::IS_USED || !self.is_running {
            return false;
        }
        let is_sync = frame.cob_id() == self.current.sync.cob_id();
        if is_sync {
            self.handle_sync(frame, application, errors, now);
        } else {
            self.handle_pdo(frame, application, errors, now);
        }
        is_sync
    }

    fn handle_pdo<A: Application>(
        &mut self,
        frame: &Frame,
        application: &mut A,
        errors: &mut Emergency,
        now: Instant,
    ) {
        let is_window_over = self.is_window_over;
        for (number, (rpdo, pdo)) in self.rpdos() {
            if !rpdo.receives(frame.cob_id()) {
                continue;
            }
            if let Some(code) = rpdo.check_length(pdo, frame) {
                errors.report(PROCESS_DATA, code, COMMUNICATION, [number, 0, 0, 0, 0]);
            }
            if rpdo.handle(pdo, frame, application, is_window_over, now) {
                application.handle(Event::Received(number));
            }
        }
    }

    fn handle_sync<A: Application>(
        &mut self,
        frame: &Frame,
        application: &mut A,
        errors: &mut Emergency,
        now: Instant,
    ) {
        let counter = self.current.sync.counter(frame);
        let was_wrong = mem::replace(&mut self.is_sync_wrong, counter.is_err());
        let Ok(counter) = counter else {
            if !was_wrong {
                let len = frame.data().len() as u8;
                let information = [len, 0, 0, 0, 0];
                errors.report(PROCESS_DATA, sync::WRONG_LENGTH, COMMUNICATION, information);
            }
            return;
        };
        for (number, (rpdo, pdo)) in self.rpdos() {
            if rpdo.handle_sync(pdo, application) {
                application.handle(Event::Received(number));
            }
        }
        application.handle(Event::Sync);
        self.window_end = self.current.sync.window_end(now);
        self.is_window_over = false;
        self.due.add_all(self.synchronous.without(self.counting));
        for at in self.counting {
            if let Some((tpdo, pdo)) = self.tpdo(at)
                && tpdo.handle_sync(pdo, counter)
            {
                self.due.add(at);
            }
        }
    }

    /// Ends the errors that are no longer present.
    pub fn end_errors(&self, errors: &mut Emergency) {
        let has = |code| self.rpdos.as_ref().iter().any(|rpdo| rpdo.fault() == Some(code));
        for (code, is_present) in [
            (rpdo::TOO_SHORT, has(rpdo::TOO_SHORT)),
            (rpdo::TOO_LONG, has(rpdo::TOO_LONG)),
            (rpdo::LATE, has(rpdo::LATE)),
            (sync::WRONG_LENGTH, self.is_sync_wrong),
        ] {
            if !is_present {
                errors.end(PROCESS_DATA, code);
            }
        }
    }

    /// The next RPDO, from 1, that begins to be late at `now`.
    pub fn next_late(&mut self, errors: &mut Emergency, now: Instant) -> Option<u8> {
        let at = self.rpdos.as_mut().iter_mut().position(|rpdo| rpdo.poll(now))?;
        let number = (at as u8).wrapping_add(1);
        errors.report(PROCESS_DATA, rpdo::LATE, COMMUNICATION, [number, 0, 0, 0, 0]);
        Some(number)
    }

    /// The time at which [`next_late`](Self::next_late) has something to do.
    pub fn late_at(&self) -> Option<Instant> {
        self.rpdos.as_ref().iter().filter_map(Reception::deadline).reduce(Instant::earlier)
    }

    /// Ends the event timers of RPDOs until their next frames, since nobody has sent any during a switch of the bit rate.
    pub fn end_event_timers(&mut self) {
        self.rpdos.as_mut().iter_mut().for_each(Reception::end_event_timer);
    }

    /// Ends the synchronous window, if it is over: TPDOs that have not been sent by then are dropped.
    fn end_window(&mut self, now: Instant) {
        if self.window_end.take_if(|end| end.has_come(now)).is_some() {
            self.is_window_over = true;
            self.due.remove_all(self.synchronous);
        }
    }

    /// The next TPDO to send at `now`, and whether only its event timer asks for it; `may_be_timed` says whether one may
    /// be sent for that.
    pub fn next_frame<A: Application>(
        &mut self,
        application: &mut A,
        may_be_timed: impl Fn() -> bool,
        now: Instant,
    ) -> Option<(Frame, bool)> {
        self.end_window(now);
        let mut timed_out = None;
        if !self.event_driven.is_empty() {
            for at in self.event_driven {
                if self.tpdos.as_mut().get_mut(at).is_some_and(|tpdo| tpdo.ends_inhibit_time(now)) {
                    self.due.add(at);
                }
            }
            timed_out = self.first_timed_out(now).filter(|_| may_be_timed()).map(|(at, _)| at);
            if let Some(at) = timed_out {
                self.due.add(at);
            }
        }
        while let Some(at) = self.due.take_first() {
            let Some((tpdo, pdo)) = self.tpdo(at) else { continue };
            let sent = if pdo.transmission_type <= 240 {
                tpdo.answer_sync(pdo, application).map(|frame| (frame, false))
            } else {
                tpdo.poll(pdo, application, timed_out == Some(at), now)
            };
            if sent.is_some() {
                return sent;
            }
        }
        None
    }

    /// The TPDO whose event timer has been over for the longest time, with its end.
    pub fn first_timed_out(&self, now: Instant) -> Option<(usize, Instant)> {
        if N::TPDOS == 0 {
            return None;
        }
        let timed_out = self
            .event_driven
            .into_iter()
            .filter_map(|at| Some((at, self.tpdos.as_ref().get(at)?.is_timed_out(now)?)));
        timed_out.reduce(|first, other| if first.1.has_come(other.1) { first } else { other })
    }

    /// The time at which [`next_frame`](Self::next_frame) has something to do; `postpone` says when a TPDO may be sent
    /// whose event timer is over.
    pub fn poll_at(&self, postpone: impl Fn(Instant) -> Option<Instant>) -> Option<Instant> {
        let due = |at| {
            let tpdo: &Transmission = self.tpdos.as_ref().get(at)?;
            // An event timer that is over within the inhibit time would ask for the next call at once, again and again.
            tpdo.inhibited_until().or_else(|| postpone(tpdo.event_at()?))
        };
        self.event_driven
            .into_iter()
            .filter_map(due)
            .chain(self.window_end)
            .reduce(Instant::earlier)
    }

    /// The value of an object of PDOs or SYNC.
    ///
    /// # Errors
    /// [`Abort::NoObject`] for any other object.
    pub fn read(&self, object: Object, node: Option<NodeId>) -> Result<u32, Abort> {
        use Direction::{Receive, Transmit};
        let (direction, part) = match object {
            Object::RpdoParameter(part) | Object::RpdoMapping(part) => (Receive, part),
            Object::TpdoParameter(part) | Object::TpdoMapping(part) => (Transmit, part),
            _ if Self::IS_USED => return self.current.sync.read(object).ok_or(Abort::NoObject),
            _ => return Err(Abort::NoObject),
        };
        let (at, sub_index) = (part.at(), part.sub_index());
        let pdo = self.current.pdo(direction, at).ok_or(Abort::NoObject)?;
        Ok(match object {
            Object::RpdoMapping(_) | Object::TpdoMapping(_) => pdo.mapping.value(sub_index),
            _ => pdo.parameter(direction, sub_index, base(direction, at), node),
        })
    }

    /// Writes an object of PDOs or SYNC; `objects` are those of the application.
    ///
    /// # Errors
    /// The abort code for the client.
    pub fn write(
        &mut self,
        object: Object,
        value: u32,
        node: Option<NodeId>,
        objects: &'static [Entry],
    ) -> Result<(), Abort> {
        use Direction::{Receive, Transmit};
        let (direction, part) = match object {
            Object::RpdoParameter(part) | Object::RpdoMapping(part) => (Receive, part),
            Object::TpdoParameter(part) | Object::TpdoMapping(part) => (Transmit, part),
            _ if Self::IS_USED => return self.current.sync.write(object, value),
            _ => return Err(Abort::NoObject),
        };
        let (at, sub_index) = (part.at(), part.sub_index());
        let pdo = self.current.pdo_mut(direction, at).ok_or(Abort::NoObject)?;
        if let Object::RpdoMapping(_) | Object::TpdoMapping(_) = object {
            return pdo.set_mapping(direction, sub_index, value, objects);
        }
        pdo.set_parameter(direction, sub_index, value, base(direction, at), node)?;
        match direction {
            Receive => self.start_rpdo(at, node),
            Transmit => {
                if sub_index == INHIBIT_TIME
                    && let Some((tpdo, _)) = self.tpdo(at)
                {
                    tpdo.end_inhibit_time();
                }
                self.start_tpdo(at, node);
            }
        }
        Ok(())
    }
}

impl Element for Pdo {
    const UNUSED: Self = Self::UNUSED;
}

impl Element for Transmission {
    const UNUSED: Self = Self::UNUSED;
}

impl Element for Reception {
    const UNUSED: Self = Self::UNUSED;
}

/// A set of TPDOs.
#[derive(Clone, Copy, Debug)]
struct Set(u16);

impl Set {
    const NONE: Self = Self(0);

    const fn is_empty(self) -> bool {
        self.0 == 0
    }

    const fn bit(at: usize) -> u16 {
        1 << (at % MAX_PDOS)
    }

    const fn has(self, at: usize) -> bool {
        self.0 & Self::bit(at) != 0
    }

    const fn add(&mut self, at: usize) {
        self.0 |= Self::bit(at);
    }

    const fn add_all(&mut self, others: Self) {
        self.0 |= others.0;
    }

    const fn remove(&mut self, at: usize) {
        self.0 &= !Self::bit(at);
    }

    const fn remove_all(&mut self, others: Self) {
        *self = self.without(others);
    }

    const fn without(self, others: Self) -> Self {
        Self(self.0 & !others.0)
    }

    const fn take_first(&mut self) -> Option<usize> {
        if self.is_empty() {
            return None;
        }
        let at = self.0.trailing_zeros() as usize;
        self.remove(at);
        Some(at)
    }
}

impl Iterator for Set {
    type Item = usize;

    fn next(&mut self) -> Option<usize> {
        self.take_first()
    }
}

/// The COB-ID of a PDO in the predefined connection set, to which the node-ID is added; `None` beyond that set.
const fn base(direction: Direction, at: usize) -> Option<u16> {
    let of_first = match direction {
        Direction::Transmit => 0x180,
        Direction::Receive => 0x200,
    };
    if at < PREDEFINED { Some(of_first + 0x100 * at as u16) } else { None }
}
