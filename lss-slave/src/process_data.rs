//! Process data (CiA 301, 7.2.2): PDOs with the values of the application, SYNC consumer and heartbeat consumer.
//!
//! A product declares its PDOs in [`Application::TPDOS`] and [`Application::RPDOS`]; their numbers are parameters of
//! [`Node`](crate::Node).

mod cob_id;
mod declaration;
mod heartbeats;
mod mapping;
mod rpdo;
mod stored;
mod sync;
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
use heartbeats::Producer;
use mapping::{Direction, Mapping};
use rpdo::ReceivePdo;
use stored::Configuration;
use sync::Sync;
use tpdo::TransmitPdo;

/// The most TPDOs, and the most RPDOs, of a node: those with a COB-ID in the predefined connection set (CiA 301).
pub const MAX_PDOS: usize = 4;
/// The most heartbeat producers that a node watches.
pub const MAX_PRODUCERS: usize = 16;

/// The process data of a node. It is empty, and takes no code, if all numbers are 0.
#[derive(Clone, Debug)]
pub(crate) struct ProcessData<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> {
    tpdos: [TransmitPdo; TPDOS],
    rpdos: [ReceivePdo; RPDOS],
    producers: [Producer; PRODUCERS],
    sync: Sync,
    /// The node is NMT operational.
    is_running: bool,
    /// The COB-IDs to receive have changed since the board was informed.
    has_new_receives: bool,
    /// What is persistent; `None`: what the application declares.
    persistent: Option<Configuration<TPDOS, RPDOS, PRODUCERS>>,
    /// What the store in progress makes persistent, if that changes.
    staged: Option<Configuration<TPDOS, RPDOS, PRODUCERS>>,
}

impl<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    ProcessData<TPDOS, RPDOS, PRODUCERS>
{
    /// Whether there is anything to do.
    pub const IS_USED: bool = TPDOS + RPDOS + PRODUCERS > 0;
    const HAS_PDOS: bool = TPDOS + RPDOS > 0;

    /// The process data that the application declares. A wrong declaration does not compile.
    pub const fn new<A: Application>() -> Self {
        let Configuration { tpdos, rpdos, producers, sync, .. } = Self::declared::<A>();
        Self {
            tpdos,
            rpdos,
            producers,
            sync,
            is_running: false,
            has_new_receives: false,
            persistent: None,
            staged: None,
        }
    }

    /// The parameters of a new device.
    const fn declared<A: Application>() -> Configuration<TPDOS, RPDOS, PRODUCERS> {
        let (tpdos, rpdos) = const {
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
            let mut tpdos = [TransmitPdo::UNUSED; TPDOS];
            let mut at = 0;
            while at < A::TPDOS.len() {
                tpdos[at] = TransmitPdo::declared(&A::TPDOS[at], A::OBJECTS);
                at += 1;
            }
            let mut rpdos = [ReceivePdo::UNUSED; RPDOS];
            let mut at = 0;
            while at < A::RPDOS.len() {
                rpdos[at] = ReceivePdo::declared(&A::RPDOS[at], A::OBJECTS);
                at += 1;
            }
            (tpdos, rpdos)
        };
        Configuration {
            tpdos,
            rpdos,
            producers: [Producer::UNUSED; PRODUCERS],
            sync: Sync::new(),
            error_behaviour: ErrorBehaviour::DEFAULT,
        }
    }

    /// Restarts as after power-on, with the persistent parameters.
    pub fn reset<A: Application>(&mut self) {
        if Self::IS_USED {
            let Configuration { tpdos, rpdos, producers, sync, .. } = self.persistent::<A>();
            (self.tpdos, self.rpdos, self.producers, self.sync) = (tpdos, rpdos, producers, sync);
            (self.is_running, self.has_new_receives) = (false, false);
            self.tpdos.iter_mut().for_each(TransmitPdo::restart);
            self.rpdos.iter_mut().for_each(ReceivePdo::restart);
        }
    }

    /// The COB-ID of SYNC, if there are PDOs.
    pub fn sync_cob_id(&self) -> Option<u16> {
        Self::HAS_PDOS.then(|| self.sync.cob_id())
    }

    /// The COB-ID of an RPDO, if it is valid.
    pub fn rpdo_cob_id(&self, at: usize, node: Option<NodeId>) -> Option<u16> {
        self.rpdos.get(at)?.cob_id.active(rpdo_base(at), Some(node?))
    }

    /// The COB-ID of the heartbeat of a producer, if it is watched.
    pub fn producer_cob_id(&self, at: usize) -> Option<u16> {
        self.producers.get(at)?.cob_id()
    }

    /// Whether the COB-IDs to receive have changed since the last call.
    pub fn take_new_receives(&mut self) -> bool {
        Self::IS_USED && mem::take(&mut self.has_new_receives)
    }

    /// Follows the NMT state: PDOs live in NMT operational.
    pub fn follow(&mut self, state: nmt::State) {
        let is_running = state == nmt::State::Operational;
        if Self::HAS_PDOS && mem::replace(&mut self.is_running, is_running) != is_running {
            self.tpdos.iter_mut().for_each(TransmitPdo::restart);
            self.rpdos.iter_mut().for_each(ReceivePdo::restart);
        }
    }

    /// Makes all event-driven TPDOs due, since frames may have been dropped.
    pub fn note_resumed(&mut self) {
        self.tpdos.iter_mut().for_each(TransmitPdo::restart);
    }

    /// Grants all producers a new period, since nobody has sent heartbeats during a switch of the bit rate.
    pub fn restart_producers(&mut self, now: Instant) {
        self.producers.iter_mut().for_each(|producer| producer.restart(now));
    }

    /// Handles a frame that may belong to process data, or a heartbeat.
    pub fn handle_frame<A: Application>(
        &mut self,
        frame: &Frame,
        node: NodeId,
        application: &mut A,
        errors: &mut Errors<'_>,
        now: Instant,
    ) {
        if Self::HAS_PDOS && self.is_running {
            if frame.cob_id() == self.sync.cob_id() {
                return self.handle_sync(frame, application, errors);
            }
            self.handle_pdo(frame, node, application, errors);
        }
        for producer in &mut self.producers {
            if let Some(event) = producer.handle(frame, now) {
                application.handle(event);
            }
        }
    }

    fn handle_pdo<A: Application>(
        &mut self,
        frame: &Frame,
        node: NodeId,
        application: &mut A,
        errors: &mut Errors<'_>,
    ) {
        for (at, rpdo) in self.rpdos.iter_mut().enumerate() {
            if rpdo.cob_id.active(rpdo_base(at), Some(node)) != Some(frame.cob_id()) {
                continue;
            }
            let number = at as u8 + 1;
            if let Some(code) = rpdo.check_length(frame) {
                errors.report(code, COMMUNICATION, [number, 0, 0, 0, 0]);
            }
            if rpdo.handle(frame, application) {
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
        let counter = match self.sync.handle(frame) {
            Ok(counter) => counter,
            Err(sync::WrongLength { is_new }) => {
                if is_new {
                    let len = frame.data().len() as u8;
                    errors.report(sync::WRONG_LENGTH, COMMUNICATION, [len, 0, 0, 0, 0]);
                }
                return;
            }
        };
        for (at, rpdo) in self.rpdos.iter_mut().enumerate() {
            if rpdo.handle_sync(application) {
                application.handle(Event::Received(at as u8 + 1));
            }
        }
        application.handle(Event::Sync);
        self.tpdos.iter_mut().for_each(|tpdo| tpdo.handle_sync(counter));
    }

    /// The next producer whose heartbeat is missing at `now`.
    pub fn next_lost(&mut self, errors: &mut Errors<'_>, now: Instant) -> Option<NodeId> {
        let lost = self.producers.iter_mut().find_map(|producer| producer.poll(now))?;
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
            (sync::WRONG_LENGTH, self.sync.is_length_wrong()),
            (heartbeats::LOST, self.producers.iter().any(Producer::is_lost)),
        ] {
            if !is_present {
                errors.end(code);
            }
        }
    }

    /// The next TPDO to send at `now`.
    pub fn next_frame<A: Application>(
        &mut self,
        node: NodeId,
        application: &A,
        now: Instant,
    ) -> Option<Frame> {
        if !self.is_running {
            return None;
        }
        self.tpdos.iter_mut().enumerate().find_map(|(at, tpdo)| {
            let cob_id = tpdo.cob_id.active(tpdo_base(at), Some(node))?;
            tpdo.poll(cob_id, application, now)
        })
    }

    /// The time at which [`next_frame`](Self::next_frame) has something to do.
    pub fn poll_at(&self) -> Option<Instant> {
        let tpdos = self.tpdos.iter().filter(|_| self.is_running);
        tpdos.filter_map(TransmitPdo::poll_at).reduce(Instant::earlier)
    }

    /// The time at which [`next_lost`](Self::next_lost) has something to do.
    pub fn producers_poll_at(&self) -> Option<Instant> {
        self.producers.iter().filter_map(Producer::poll_at).reduce(Instant::earlier)
    }

    /// The value of an object of process data.
    ///
    /// # Errors
    /// [`Abort::NoObject`] for any other object.
    pub fn read(&self, object: Object, node: Option<NodeId>) -> Result<u32, Abort> {
        let value = match object {
            Object::SyncCobId if Self::HAS_PDOS => Some(self.sync.cob_id().into()),
            Object::SyncCounterOverflow if Self::HAS_PDOS => Some(self.sync.overflow().into()),
            Object::ConsumerHeartbeatTime(sub_index) => {
                let at = usize::from(sub_index.wrapping_sub(1));
                self.producers.get(at).map(|producer| producer.value())
            }
            Object::RpdoParameter(part) => self
                .rpdos
                .get(part.at())
                .map(|rpdo| rpdo.parameter(part.sub_index(), rpdo_base(part.at()), node)),
            Object::TpdoParameter(part) => self
                .tpdos
                .get(part.at())
                .map(|tpdo| tpdo.parameter(part.sub_index(), tpdo_base(part.at()), node)),
            Object::RpdoMapping(part) => {
                self.rpdos.get(part.at()).map(|rpdo| rpdo.mapping.value(part.sub_index()))
            }
            Object::TpdoMapping(part) => {
                self.tpdos.get(part.at()).map(|tpdo| tpdo.mapping.value(part.sub_index()))
            }
            _ => None,
        };
        value.ok_or(Abort::NoObject)
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
        objects: &[Entry],
    ) -> Result<(), Abort> {
        match object {
            Object::SyncCobId if Self::HAS_PDOS => {
                self.sync.set_cob_id(value)?;
                self.has_new_receives = true;
            }
            Object::SyncCounterOverflow if Self::HAS_PDOS => self.sync.set_overflow(value as u8)?,
            Object::ConsumerHeartbeatTime(sub_index) => {
                let at = usize::from(sub_index.wrapping_sub(1));
                Producer::set(&mut self.producers, at, value)?;
                self.has_new_receives = true;
            }
            Object::RpdoParameter(part) => {
                let base = rpdo_base(part.at());
                let rpdo = self.rpdos.get_mut(part.at()).ok_or(Abort::NoObject)?;
                rpdo.set_parameter(part.sub_index(), value, base, node)?;
                self.has_new_receives = true;
            }
            Object::TpdoParameter(part) => {
                let base = tpdo_base(part.at());
                let tpdo = self.tpdos.get_mut(part.at()).ok_or(Abort::NoObject)?;
                tpdo.set_parameter(part.sub_index(), value, base, node)?;
            }
            Object::RpdoMapping(part) => {
                let rpdo = self.rpdos.get_mut(part.at()).ok_or(Abort::NoObject)?;
                rpdo.mapping.set(Direction::Receive, rpdo.cob_id, part, value, objects)?;
            }
            Object::TpdoMapping(part) => {
                let tpdo = self.tpdos.get_mut(part.at()).ok_or(Abort::NoObject)?;
                tpdo.mapping.set(Direction::Transmit, tpdo.cob_id, part, value, objects)?;
            }
            _ => return Err(Abort::NoObject),
        }
        Ok(())
    }
}

/// The COB-ID of a TPDO in the predefined connection set, to which the node-ID is added.
const fn tpdo_base(at: usize) -> u16 {
    0x180 + 0x100 * (at % MAX_PDOS) as u16
}

/// The COB-ID of an RPDO in the predefined connection set, to which the node-ID is added.
const fn rpdo_base(at: usize) -> u16 {
    0x200 + 0x100 * (at % MAX_PDOS) as u16
}
