//! Process data (CiA 301, 7.2.2): PDOs with the values of the application, SYNC consumer and heartbeat consumer.
//!
//! A product declares its PDOs in [`Application::TPDOS`] and [`Application::RPDOS`]; their numbers are parameters of
//! [`Node`](crate::Node).

mod cob_id;
mod declaration;
mod heartbeats;
mod mapping;
mod pdo;
mod rpdo;
mod stored;
pub(crate) mod sync;
mod tables;
mod tpdo;

pub use declaration::{Rpdo, Tpdo};

use core::mem;

use crate::{
    Application, Frame, Instant, NodeId,
    application::Event,
    emergency::{COMMUNICATION, Errors},
    nmt::{self, ErrorBehaviour},
    object_dictionary::{Entry, Object},
    sdo::Abort,
};
use cob_id::PdoCobId;
use heartbeats::{Producer, Watch};
use mapping::{Direction, Mapping};
use pdo::Pdo;
use rpdo::Reception;
use stored::Configuration;
use sync::Sync;
use tpdo::Transmission;

/// The most TPDOs, and the most RPDOs, of a node: those with a COB-ID in the predefined connection set (CiA 301).
pub const MAX_PDOS: usize = 4;
/// The sub-index of the inhibit time in the communication parameter of a TPDO (CiA 301, 7.5.2.37).
const INHIBIT_TIME: u8 = 3;
/// The most heartbeat producers that a node watches.
pub const MAX_PRODUCERS: usize = 16;

/// The process data of a node. It is empty, and takes no code, if all numbers are 0.
#[derive(Clone, Debug)]
pub(crate) struct ProcessData<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> {
    current: Configuration<TPDOS, RPDOS, PRODUCERS>,
    persistent: Configuration<TPDOS, RPDOS, PRODUCERS>,
    /// What the store in progress makes persistent, if that changes.
    staged: Option<Configuration<TPDOS, RPDOS, PRODUCERS>>,
    tpdos: [Transmission; TPDOS],
    /// The TPDOs in use whose type is synchronous.
    synchronous: Tpdos,
    /// The other TPDOs in use.
    event_driven: Tpdos,
    /// The synchronous TPDOs that a SYNC has asked for, and the others that may have news.
    due: Tpdos,
    rpdos: [Reception; RPDOS],
    watches: [Watch; PRODUCERS],
    /// The latest SYNC had a wrong length.
    is_sync_wrong: bool,
    /// The node is NMT operational.
    is_running: bool,
    /// The COB-IDs to receive have changed since the board was informed.
    has_new_receives: bool,
}

impl<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    ProcessData<TPDOS, RPDOS, PRODUCERS>
{
    /// Whether there is anything to do.
    pub const IS_USED: bool = TPDOS + RPDOS + PRODUCERS > 0;
    const HAS_PDOS: bool = TPDOS + RPDOS > 0;

    /// The process data that the application declares. A wrong declaration does not compile.
    pub const fn new<A: Application>() -> Self {
        Self {
            current: Self::declared::<A>(),
            persistent: Self::declared::<A>(),
            staged: None,
            tpdos: [Transmission::UNUSED; TPDOS],
            synchronous: Tpdos::NONE,
            event_driven: Tpdos::NONE,
            due: Tpdos::NONE,
            rpdos: [Reception::UNUSED; RPDOS],
            watches: [Watch::Waiting; PRODUCERS],
            is_sync_wrong: false,
            is_running: false,
            has_new_receives: false,
        }
    }

    /// The parameters of a new device.
    const fn declared<A: Application>() -> Configuration<TPDOS, RPDOS, PRODUCERS> {
        const {
            assert!(
                TPDOS <= MAX_PDOS && RPDOS <= MAX_PDOS,
                "a node has at most 4 TPDOs and 4 RPDOs"
            );
            assert!(PRODUCERS <= MAX_PRODUCERS, "a node watches at most 16 heartbeat producers");
            assert!(
                !Self::IS_USED || !A::OBJECTS.is_empty(),
                "process data and the heartbeat consumer need an application with objects"
            );
            assert!(A::TPDOS.len() <= TPDOS, "more TPDOs are declared than the node has");
            assert!(A::RPDOS.len() <= RPDOS, "more RPDOs are declared than the node has");
            let mut tpdos = [Pdo::UNUSED; TPDOS];
            let mut at = 0;
            while at < A::TPDOS.len() {
                tpdos[at] = Pdo::declared_tpdo(&A::TPDOS[at], A::OBJECTS);
                at += 1;
            }
            let mut rpdos = [Pdo::UNUSED; RPDOS];
            let mut at = 0;
            while at < A::RPDOS.len() {
                rpdos[at] = Pdo::declared_rpdo(&A::RPDOS[at], A::OBJECTS);
                at += 1;
            }
            Configuration {
                tpdos,
                rpdos,
                producers: [Producer::UNUSED; PRODUCERS],
                sync: Sync::new(),
                error_behaviour: ErrorBehaviour::DEFAULT,
            }
        }
    }

    /// Restarts as after power-on, with the persistent parameters.
    pub fn reset(&mut self) {
        if Self::IS_USED {
            self.current = self.persistent;
            self.stop_pdos();
            self.watches.fill(Watch::Waiting);
            (self.is_sync_wrong, self.is_running, self.has_new_receives) = (false, false, false);
        }
    }

    fn stop_pdos(&mut self) {
        (self.synchronous, self.event_driven, self.due) = (Tpdos::NONE, Tpdos::NONE, Tpdos::NONE);
        self.tpdos.fill(Transmission::UNUSED);
        self.rpdos.fill(Reception::UNUSED);
    }

    /// Makes the parameters of a TPDO effective, and the TPDO due.
    fn start_tpdo(&mut self, at: usize, node: Option<NodeId>) {
        let (Some(tpdo), Some(pdo)) = (self.tpdos.get_mut(at), self.current.tpdos.get(at)) else {
            return;
        };
        for set in [&mut self.synchronous, &mut self.event_driven, &mut self.due] {
            set.remove(at);
        }
        let cob_id = pdo.cob_id.active(base(Direction::Transmit, at), node);
        let Some(cob_id) = cob_id.filter(|_| self.is_running && !pdo.mapping.is_empty()) else {
            return;
        };
        *tpdo = tpdo.renewed(cob_id);
        if pdo.transmission_type <= 240 {
            self.synchronous.add(at);
        } else {
            self.event_driven.add(at);
            self.due.add(at);
        }
    }

    /// Makes the parameters of an RPDO effective, and forgets what it has received.
    fn start_rpdo(&mut self, at: usize, node: Option<NodeId>) {
        let cob_id = self.rpdo_cob_id(at, node).filter(|_| self.is_running);
        if let Some(rpdo) = self.rpdos.get_mut(at) {
            *rpdo = Reception::new(cob_id);
        }
    }

    /// The COB-ID of SYNC, if there are PDOs.
    pub fn sync_cob_id(&self) -> Option<u16> {
        Self::HAS_PDOS.then(|| self.current.sync.cob_id())
    }

    /// The COB-ID of an RPDO, if it is valid.
    pub fn rpdo_cob_id(&self, at: usize, node: Option<NodeId>) -> Option<u16> {
        self.current.rpdos.get(at)?.cob_id.active(base(Direction::Receive, at), Some(node?))
    }

    /// The COB-ID of the heartbeat of a producer, if it is watched.
    pub fn producer_cob_id(&self, at: usize) -> Option<u16> {
        self.current.producers.get(at)?.cob_id()
    }

    /// Whether the COB-IDs to receive have changed since the last call.
    pub fn take_new_receives(&mut self) -> bool {
        Self::IS_USED && mem::take(&mut self.has_new_receives)
    }

    /// Follows the NMT state: PDOs live in NMT operational. Returns whether this state has ended.
    pub fn follow(&mut self, state: nmt::State, node: Option<NodeId>) -> bool {
        let is_running = state == nmt::State::Operational;
        let was_running = mem::replace(&mut self.is_running, is_running);
        if !Self::HAS_PDOS || is_running == was_running {
            return false;
        }
        self.stop_pdos();
        (0..TPDOS).for_each(|at| self.start_tpdo(at, node));
        (0..RPDOS).for_each(|at| self.start_rpdo(at, node));
        was_running
    }

    /// Makes all event-driven TPDOs due, since frames may have been dropped.
    pub fn note_resumed(&mut self) {
        self.tpdos.iter_mut().for_each(Transmission::restart);
        self.due = self.event_driven;
    }

    /// Records that values of the application may have changed.
    pub const fn note_values(&mut self) {
        self.due.add_all(self.event_driven);
    }

    /// Grants all producers a new period, since nobody has sent heartbeats during a switch of the bit rate.
    pub fn restart_producers(&mut self, now: Instant) {
        for (watch, producer) in self.watches.iter_mut().zip(&self.current.producers) {
            watch.restart(producer, now);
        }
    }

    /// Handles a frame that may belong to process data, or a heartbeat.
    pub fn handle_frame<A: Application>(
        &mut self,
        frame: &Frame,
        application: &mut A,
        errors: &mut Errors<'_>,
        now: Instant,
    ) {
        if Self::HAS_PDOS && self.is_running {
            if frame.cob_id() == self.current.sync.cob_id() {
                return self.handle_sync(frame, application, errors);
            }
            self.handle_pdo(frame, application, errors);
        }
        for (watch, producer) in self.watches.iter_mut().zip(&self.current.producers) {
            if let Some(event) = watch.handle(producer, frame, now) {
                application.handle(event);
            }
        }
    }

    fn handle_pdo<A: Application>(
        &mut self,
        frame: &Frame,
        application: &mut A,
        errors: &mut Errors<'_>,
    ) {
        for (number, (rpdo, pdo)) in (1..).zip(self.rpdos.iter_mut().zip(&self.current.rpdos)) {
            if !rpdo.receives(frame.cob_id()) {
                continue;
            }
            if let Some(code) = rpdo.check_length(pdo, frame) {
                errors.report(code, COMMUNICATION, [number, 0, 0, 0, 0]);
            }
            if rpdo.handle(pdo, frame, application) {
                application.handle(Event::Received(number));
            }
        }
    }

    fn handle_sync<A: Application>(
        &mut self,
        frame: &Frame,
        application: &mut A,
        errors: &mut Errors<'_>,
    ) {
        let counter = self.current.sync.counter(frame);
        let was_wrong = mem::replace(&mut self.is_sync_wrong, counter.is_err());
        let Ok(counter) = counter else {
            if !was_wrong {
                let len = frame.data().len() as u8;
                errors.report(sync::WRONG_LENGTH, COMMUNICATION, [len, 0, 0, 0, 0]);
            }
            return;
        };
        for (number, (rpdo, pdo)) in (1..).zip(self.rpdos.iter_mut().zip(&self.current.rpdos)) {
            if rpdo.handle_sync(pdo, application) {
                application.handle(Event::Received(number));
            }
        }
        application.handle(Event::Sync);
        for at in self.synchronous {
            if let (Some(tpdo), Some(pdo)) = (self.tpdos.get_mut(at), self.current.tpdos.get(at))
                && tpdo.handle_sync(pdo, counter)
            {
                self.due.add(at);
            }
        }
    }

    /// The next producer whose heartbeat is missing at `now`.
    pub fn next_lost(&mut self, errors: &mut Errors<'_>, now: Instant) -> Option<NodeId> {
        let at = self.watches.iter_mut().position(|watch| watch.poll(now))?;
        let lost = self.current.producers.get(at)?.node()?;
        errors.report(heartbeats::LOST, COMMUNICATION, [lost.get(), 0, 0, 0, 0]);
        Some(lost)
    }

    /// Ends the errors that are no longer present.
    pub fn end_errors(&self, errors: &mut Errors<'_>) {
        if !Self::IS_USED || errors.is_empty() {
            return;
        }
        let has = |code| self.rpdos.iter().any(|rpdo| rpdo.fault() == Some(code));
        for (code, is_present) in [
            (rpdo::TOO_SHORT, has(rpdo::TOO_SHORT)),
            (rpdo::TOO_LONG, has(rpdo::TOO_LONG)),
            (sync::WRONG_LENGTH, self.is_sync_wrong),
            (heartbeats::LOST, self.watches.iter().any(Watch::is_lost)),
        ] {
            if !is_present {
                errors.end(code);
            }
        }
    }

    /// The next TPDO to send at `now`, and whether only its event timer asks for it; `may_be_timed` says whether one may
    /// be sent for that.
    pub fn next_frame<A: Application>(
        &mut self,
        application: &A,
        may_be_timed: bool,
        now: Instant,
    ) -> Option<(Frame, bool)> {
        let mut timed_out = None;
        if !self.event_driven.is_empty() {
            for at in self.event_driven {
                if self.tpdos.get_mut(at).is_some_and(|tpdo| tpdo.ends_inhibit_time(now)) {
                    self.due.add(at);
                }
            }
            timed_out = self.first_timed_out(now).filter(|_| may_be_timed).map(|(at, _)| at);
            if let Some(at) = timed_out {
                self.due.add(at);
            }
        }
        while let Some(at) = self.due.take_first() {
            let (Some(tpdo), Some(pdo)) = (self.tpdos.get_mut(at), self.current.tpdos.get(at))
            else {
                continue;
            };
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
        let timed_out = self.event_driven.into_iter().filter_map(|at| {
            let end = self.tpdos.get(at)?.is_timed_out(self.current.tpdos.get(at)?, now)?;
            Some((at, end))
        });
        timed_out.reduce(|first, other| if first.1.has_come(other.1) { first } else { other })
    }

    /// The time at which [`next_frame`](Self::next_frame) has something to do; `postpone` says when a TPDO may be sent
    /// whose event timer is over.
    pub fn poll_at(&self, postpone: impl Fn(Instant) -> Option<Instant>) -> Option<Instant> {
        let at = |at| {
            let tpdo: &Transmission = self.tpdos.get(at)?;
            tpdo.inhibited_until().or_else(|| postpone(tpdo.event_at()?))
        };
        self.event_driven.into_iter().filter_map(at).reduce(Instant::earlier)
    }

    /// The time at which [`next_lost`](Self::next_lost) has something to do.
    pub fn producers_poll_at(&self) -> Option<Instant> {
        self.watches.iter().filter_map(Watch::poll_at).reduce(Instant::earlier)
    }

    fn pdo(&self, direction: Direction, at: usize) -> Result<&Pdo, Abort> {
        let pdos: &[Pdo] = match direction {
            Direction::Transmit => &self.current.tpdos,
            Direction::Receive => &self.current.rpdos,
        };
        pdos.get(at).ok_or(Abort::NoObject)
    }

    fn pdo_mut(&mut self, direction: Direction, at: usize) -> Result<&mut Pdo, Abort> {
        let pdos: &mut [Pdo] = match direction {
            Direction::Transmit => &mut self.current.tpdos,
            Direction::Receive => &mut self.current.rpdos,
        };
        pdos.get_mut(at).ok_or(Abort::NoObject)
    }

    /// The value of an object of process data.
    ///
    /// # Errors
    /// [`Abort::NoObject`] for any other object.
    pub fn read(&self, object: Object, node: Option<NodeId>) -> Result<u32, Abort> {
        use Direction::{Receive, Transmit};
        let (direction, part) = match object {
            Object::SyncCobId if Self::HAS_PDOS => return Ok(self.current.sync.cob_id().into()),
            Object::SyncCounterOverflow if Self::HAS_PDOS => {
                return Ok(self.current.sync.overflow().into());
            }
            Object::ConsumerHeartbeatTime(sub_index) => {
                let at = usize::from(sub_index.wrapping_sub(1));
                return self.current.producers.get(at).map(Producer::value).ok_or(Abort::NoObject);
            }
            Object::RpdoParameter(part) | Object::RpdoMapping(part) => (Receive, part),
            Object::TpdoParameter(part) | Object::TpdoMapping(part) => (Transmit, part),
            _ => return Err(Abort::NoObject),
        };
        let (at, sub_index) = (part.at(), part.sub_index());
        let pdo = self.pdo(direction, at)?;
        Ok(match object {
            Object::RpdoMapping(_) | Object::TpdoMapping(_) => pdo.mapping.value(sub_index),
            _ => pdo.parameter(direction, sub_index, base(direction, at), node),
        })
    }

    /// Writes an object of process data; `objects` are those of the application.
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
            Object::SyncCobId if Self::HAS_PDOS => {
                self.current.sync.set_cob_id(value)?;
                self.has_new_receives = true;
                return Ok(());
            }
            Object::SyncCounterOverflow if Self::HAS_PDOS => {
                return self.current.sync.set_overflow(value as u8);
            }
            Object::ConsumerHeartbeatTime(sub_index) => {
                let at = usize::from(sub_index.wrapping_sub(1));
                Producer::set(&mut self.current.producers, at, value)?;
                if let Some(watch) = self.watches.get_mut(at) {
                    *watch = Watch::Waiting;
                }
                self.has_new_receives = true;
                return Ok(());
            }
            Object::RpdoParameter(part) | Object::RpdoMapping(part) => (Receive, part),
            Object::TpdoParameter(part) | Object::TpdoMapping(part) => (Transmit, part),
            _ => return Err(Abort::NoObject),
        };
        let (at, sub_index) = (part.at(), part.sub_index());
        let pdo = self.pdo_mut(direction, at)?;
        if let Object::RpdoMapping(_) | Object::TpdoMapping(_) = object {
            return pdo.set_mapping(direction, sub_index, value, objects);
        }
        pdo.set_parameter(sub_index, value, base(direction, at), node)?;
        match direction {
            Receive => {
                self.start_rpdo(at, node);
                self.has_new_receives = true;
            }
            Transmit => {
                if sub_index == INHIBIT_TIME
                    && let Some(tpdo) = self.tpdos.get_mut(at)
                {
                    tpdo.end_inhibit_time();
                }
                self.start_tpdo(at, node);
            }
        }
        Ok(())
    }
}

/// A set of TPDOs.
#[derive(Clone, Copy, Debug)]
struct Tpdos(u8);

impl Tpdos {
    const NONE: Self = Self(0);

    const fn is_empty(self) -> bool {
        self.0 == 0
    }

    const fn bit(at: usize) -> u8 {
        1 << (at % MAX_PDOS)
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

    const fn take_first(&mut self) -> Option<usize> {
        if self.is_empty() {
            return None;
        }
        let at = self.0.trailing_zeros() as usize;
        self.remove(at);
        Some(at)
    }
}

impl Iterator for Tpdos {
    type Item = usize;

    fn next(&mut self) -> Option<usize> {
        self.take_first()
    }
}

/// The COB-ID of a PDO in the predefined connection set, to which the node-ID is added.
const fn base(direction: Direction, at: usize) -> u16 {
    let of_first = match direction {
        Direction::Transmit => 0x180,
        Direction::Receive => 0x200,
    };
    of_first + 0x100 * (at % MAX_PDOS) as u16
}
