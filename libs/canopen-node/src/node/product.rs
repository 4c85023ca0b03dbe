//! The product around the protocol: its description, its application and its process data.

use super::{areas::Owed, communication::Communication};
use crate::{
    Application, BitRate, Device, NodeId,
    application::Event,
    emergency,
    nmt::{self, ErrorBehaviour},
};

#[derive(Clone, Debug)]
pub(super) struct Product<A: Application> {
    pub device: Device,
    pub application: A,
    pub communication: Communication<A::Numbers>,
    pub persistent: Persistent,
    /// The download that [`Program`](crate::Program) answers later.
    pub owed: Option<Owed>,
    /// The NMT state and the bit rate that the application knows.
    known: (nmt::State, BitRate),
}

impl<A: Application> Product<A> {
    /// A product after power-on.
    pub const fn new(device: Device, application: A, rate: BitRate) -> Self {
        let known = (nmt::State::Initialisation, rate);
        Self {
            device,
            application,
            communication: Communication::new::<A>(),
            persistent: Persistent::declared::<A>(device.heartbeat_ms),
            owed: None,
            known,
        }
    }

    /// Informs the application and process data of the NMT state and the bit rate, if they are new.
    pub fn inform(&mut self, state: nmt::State, rate: BitRate, node: Option<NodeId>) {
        let (known_state, known_rate) = self.known;
        self.known = (state, rate);
        if rate != known_rate {
            self.application.handle(Event::BitRate(rate));
        }
        if state != known_state {
            self.communication.pdos.follow(state, node);
            self.application.handle(Event::Nmt(state));
        }
    }
}

/// The persistent parameters of a node without process data.
#[derive(Clone, Copy, Debug)]
pub(super) struct Persistent {
    pub heartbeat_ms: u16,
    pub error_behaviour: ErrorBehaviour,
    pub emergency: emergency::Configuration,
}

impl Persistent {
    /// The parameters of a new device with this producer heartbeat time.
    pub const fn declared<A: Application>(heartbeat_ms: u16) -> Self {
        let error_behaviour = A::ERROR_BEHAVIOUR;
        Self { heartbeat_ms, error_behaviour, emergency: emergency::Configuration::DEFAULT }
    }
}
