//! The node: joins LSS, NMT and heartbeat; frames, time and outcomes of stores in, actions out.

use crate::{
    BitRate, BitRates, Frame, Instant, NodeId, Settings,
    lss::{self, Reaction, Response, Slave, StoreError},
    nmt::{self, Command},
};

/// What the device is, as opposed to how it is set.
#[derive(Clone, Copy, Debug)]
pub struct Device {
    /// The LSS address, which is the identity object 1018h.
    pub address: lss::Address,
    /// The bit rates that the CAN controller can produce.
    pub bit_rates: BitRates,
}

/// What the board has to do now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Action {
    /// Send this frame. Frames of equal COB-ID leave in the order of their actions.
    Transmit(Frame),
    /// Receive what a node with this node-ID [`receives`](Node::receives).
    SetNodeId(Option<NodeId>),
    /// Start no frame from now on and drop those that wait; go on receiving and acknowledging.
    StopTransmitting,
    /// Run the controller at this bit rate, receiving and acknowledging only.
    SetBitRate(BitRate),
    /// Frames may be sent again.
    ResumeTransmitting,
    /// Make these settings persistent, then call [`Node::handle_stored`].
    Store(Settings),
    /// Reset the device as if the power had been cut; the node begins anew with the persistent settings.
    ResetDevice,
}

/// A CANopen node that an LSS master can configure.
///
/// It is driven by three calls:
/// - [`handle_frame`](Self::handle_frame) with every frame that the node [`receives`](Self::receives);
/// - [`handle_stored`](Self::handle_stored) with the outcome of an [`Action::Store`];
/// - [`handle_deadline`](Self::handle_deadline) first of all, after each of the other two, and when the
///   [`next_deadline`](Self::next_deadline) has come: again and again until it returns `None`.
///
/// Before the first call the controller runs at the [`bit_rate`](Self::bit_rate) and receives what the node wants.
/// A call that comes late or without need does no harm.
#[derive(Clone, Debug)]
pub struct Node {
    lss: Slave,
    /// [`nmt::State::Initialisation`] with a node-ID means that the boot-up is still to be sent.
    nmt: nmt::State,
    heartbeat_ms: u16,
    heartbeat_due: Instant,
    switch: Option<Switch>,
    /// An NMT command that came during a switch and is to be carried out now.
    command: Option<Command>,
    store: Store,
    /// Requests to store that have not been answered.
    stores: u8,
}

/// An activation of bit timing on its way (CiA 305, activate bit timing parameters).
#[derive(Clone, Copy, Debug)]
struct Switch {
    phase: Phase,
    /// The end of the phase.
    until: Instant,
    delay_micros: u32,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    OldRate,
    NewRate,
}

#[derive(Clone, Copy, Debug)]
enum Store {
    Idle,
    Running,
    Done(Result<(), StoreError>),
}

impl Node {
    /// A node after power-on with its persistent settings.
    pub const fn new(device: Device, persistent: Settings) -> Self {
        Self {
            lss: Slave::new(
                device.address,
                device.bit_rates,
                persistent.node_id,
                persistent.bit_rate,
            ),
            nmt: nmt::State::Initialisation,
            heartbeat_ms: persistent.heartbeat_ms,
            heartbeat_due: Instant::from_micros(0),
            switch: None,
            command: None,
            store: Store::Idle,
            stores: 0,
        }
    }

    /// The LSS slave within.
    pub const fn lss(&self) -> &Slave {
        &self.lss
    }

    /// The NMT state.
    pub const fn nmt_state(&self) -> nmt::State {
        self.nmt
    }

    /// The active node-ID.
    pub const fn node_id(&self) -> Option<NodeId> {
        self.lss.active_node_id()
    }

    /// The active bit rate.
    pub const fn bit_rate(&self) -> BitRate {
        self.lss.active_bit_rate()
    }

    /// The COB-IDs of the frames that the node wants to see; it ignores all others.
    pub const fn receives(&self) -> [u16; 2] {
        [lss::REQUEST_COB_ID, nmt::COMMAND_COB_ID]
    }

    /// Takes a received frame.
    pub fn handle_frame(&mut self, frame: &Frame, now: Instant) -> Option<Action> {
        match frame.cob_id() {
            lss::REQUEST_COB_ID => self.handle_lss(frame.eight_bytes()?, now),
            nmt::COMMAND_COB_ID => self.handle_nmt(Command::from_frame(frame, self.node_id())?),
            _ => None,
        }
    }

    /// Takes the outcome of the last [`Action::Store`].
    pub fn handle_stored(&mut self, outcome: Result<(), StoreError>) {
        self.store = Store::Done(outcome);
    }

    /// Does the next thing that is due at `now`; returns `None` when nothing is.
    pub fn handle_deadline(&mut self, now: Instant) -> Option<Action> {
        if let Some(switch) = self.switch {
            return self.advance(switch, now);
        }
        if let Some(command) = self.command.take() {
            return self.handle_nmt(command).or_else(|| self.handle_deadline(now));
        }
        if let Store::Done(outcome) = self.store {
            self.store = Store::Idle;
            self.stores = self.stores.saturating_sub(1);
            return answer(Response::StoreConfiguration(outcome));
        }
        if matches!(self.store, Store::Idle) && self.stores > 0 {
            self.store = Store::Running;
            return Some(Action::Store(Settings {
                node_id: self.lss.pending_node_id(),
                bit_rate: self.lss.pending_bit_rate(),
                heartbeat_ms: self.heartbeat_ms,
            }));
        }
        self.boot_up_or_heartbeat(now)
    }

    /// When [`handle_deadline`](Self::handle_deadline) must be called again, if no other call comes before.
    pub fn next_deadline(&self) -> Option<Instant> {
        match self.switch {
            Some(switch) => Some(switch.until),
            None => self.produces_heartbeat().then_some(self.heartbeat_due),
        }
    }

    fn handle_lss(&mut self, data: &[u8; 8], now: Instant) -> Option<Action> {
        if self.switch.is_some() {
            return None;
        }
        match self.lss.handle(data)? {
            Reaction::Answer(response) => answer(response),
            Reaction::ActivateBitTiming(delay_ms) => {
                let delay_micros = u32::from(delay_ms) * 1000;
                let until = now.plus_micros(delay_micros);
                self.switch = Some(Switch { phase: Phase::OldRate, until, delay_micros });
                Some(Action::StopTransmitting)
            }
            Reaction::StoreConfiguration => {
                self.stores = self.stores.saturating_add(1);
                None
            }
            Reaction::ResetCommunication => self.reset_communication(),
        }
    }

    fn handle_nmt(&mut self, command: Command) -> Option<Action> {
        if self.switch.is_some() {
            if command.is_reset() || !self.command.is_some_and(Command::is_reset) {
                self.command = Some(command);
            }
            return None;
        }
        let state = match command {
            Command::ResetNode => return Some(Action::ResetDevice),
            Command::ResetCommunication => return self.reset_communication(),
            Command::Start => nmt::State::Operational,
            Command::Stop => nmt::State::Stopped,
            Command::EnterPreOperational => nmt::State::PreOperational,
        };
        if self.nmt != nmt::State::Initialisation {
            self.nmt = state;
        }
        None
    }

    fn reset_communication(&mut self) -> Option<Action> {
        self.lss.reset_communication();
        self.nmt = nmt::State::Initialisation;
        Some(Action::SetNodeId(self.node_id()))
    }

    fn advance(&mut self, switch: Switch, now: Instant) -> Option<Action> {
        if !switch.until.has_come(now) {
            return None;
        }
        match switch.phase {
            Phase::OldRate => {
                let until = switch.until.plus_micros(switch.delay_micros);
                self.switch = Some(Switch { phase: Phase::NewRate, until, ..switch });
                let old_rate = self.bit_rate();
                self.lss.activate_bit_rate();
                if self.bit_rate() == old_rate {
                    return self.handle_deadline(now);
                }
                Some(Action::SetBitRate(self.bit_rate()))
            }
            Phase::NewRate => {
                self.switch = None;
                self.heartbeat_due = now;
                Some(Action::ResumeTransmitting)
            }
        }
    }

    fn boot_up_or_heartbeat(&mut self, now: Instant) -> Option<Action> {
        let node = self.node_id()?;
        let period = u32::from(self.heartbeat_ms) * 1000;
        let frame = nmt::error_control(node, self.nmt);
        if self.nmt == nmt::State::Initialisation {
            self.nmt = nmt::State::PreOperational;
            self.heartbeat_due = now.plus_micros(period);
        } else if self.produces_heartbeat() && self.heartbeat_due.has_come(now) {
            let next = self.heartbeat_due.plus_micros(period);
            // After a long delay: one heartbeat, not all that were missed.
            self.heartbeat_due = if next.has_come(now) { now.plus_micros(period) } else { next };
        } else {
            return None;
        }
        Some(Action::Transmit(frame))
    }

    fn produces_heartbeat(&self) -> bool {
        self.heartbeat_ms > 0 && self.nmt != nmt::State::Initialisation
    }
}

fn answer(response: Response) -> Option<Action> {
    Some(Action::Transmit(Frame::with_eight_bytes(lss::RESPONSE_COB_ID, response.to_bytes())))
}
