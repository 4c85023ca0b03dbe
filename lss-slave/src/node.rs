//! The node: joins LSS, NMT, SDO and emergency; frames, time and what the board sees in, actions out.

mod bit_rate;
mod objects;
mod storing;

use core::mem;

use crate::{
    BitRate, BitRateSetting, BitRates, Frame, Instant, NodeId, Settings,
    emergency::{Emergency, Fault},
    lss::{self, Reaction, Slave},
    nmt::{self, Command, ErrorBehaviour},
    sdo,
    supervision::{BusEvent, Supervision},
};
use bit_rate::{Phase, Switch};
use storing::Store;

/// What the device is, as opposed to how it is set.
#[derive(Clone, Copy, Debug)]
pub struct Device {
    /// The LSS address, which is the identity object 1018h.
    pub address: lss::Address,
    /// The bit rates that the CAN controller can produce.
    pub bit_rates: BitRates,
    /// The producer heartbeat time 1017h, in milliseconds, that 1011h restores.
    pub heartbeat_ms: u16,
    /// Manufacturer device name 1008h.
    pub name: &'static str,
    /// Manufacturer hardware version 1009h.
    pub hardware_version: &'static str,
    /// Manufacturer software version 100Ah.
    pub software_version: &'static str,
    /// Whether the bit rate is supervised: lasting errors without a valid frame make the node look for the rate of the others
    /// (see `docs/bit-rates.md`).
    pub rescue: bool,
    /// Whether the LSS state stays waiting while the node is NMT operational, so that nobody configures a running machine.
    pub lss_lock: bool,
}

/// What the board has to do now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Action {
    /// Send this frame. Frames of equal COB-ID leave in the order of their actions.
    Transmit(Frame),
    /// Receive what a node with this node-ID [`receives`](Node::receives), and drop all frames that wait to be sent but those
    /// of COB-ID 7E4h: they carry the COB-IDs of before. One that is on the bus now may go on; what the node sends next leaves
    /// after it.
    SetNodeId(Option<NodeId>),
    /// Start no frame from now on and drop those that wait; go on receiving and acknowledging.
    StopTransmitting,
    /// Drop the frames that wait and run the controller at this bit rate, out of bus-off if need be. If
    /// [`StopTransmitting`](Self::StopTransmitting) or [`Listen`](Self::Listen) came before, it receives and acknowledges only.
    SetBitRate(BitRate),
    /// Frames may be sent again.
    ResumeTransmitting,
    /// Run the controller silently at this bit rate: drop the frames that wait, send no dominant bit, not even to
    /// acknowledge; receive all frames, and report the first frame and the first error to [`Node::handle_bus`].
    Listen(BitRate),
    /// Make these settings persistent, then call [`Node::handle_stored`].
    Store(Settings),
    /// Reset the device as if the power had been cut; the node begins anew with the persistent settings.
    ResetDevice,
}

/// A CANopen node that an LSS master can configure.
///
/// It is driven by these calls:
/// - [`handle_frame`](Self::handle_frame) with every frame that the node [`receives`](Self::receives);
/// - [`handle_bus`](Self::handle_bus) when a frame of the node was acknowledged, and with what else the controller tells;
/// - [`handle_stored`](Self::handle_stored) with the outcome of an [`Action::Store`];
/// - [`handle_fault`](Self::handle_fault) with a fault of the board, [`note_error_counters`](Self::note_error_counters)
///   with those of the controller;
/// - [`handle_deadline`](Self::handle_deadline) first of all, after each of the others, and when the
///   [`next_deadline`](Self::next_deadline) has come: again and again until it returns `None`. A deadline that has come
///   goes before a frame. Where each instruction counts, [`is_due`](Self::is_due) says whether there is any need.
///
/// Before the first call the controller runs at the [`bit_rate`](Self::bit_rate) and receives what the node wants.
/// A call that comes late or without need does no harm.
#[derive(Clone, Debug)]
pub struct Node {
    device: Device,
    lss: Slave,
    supervision: Supervision,
    /// A frame was received, and the supervision has not been told.
    is_proof_due: bool,
    /// Frames may be sent again, and the board has not been told.
    is_resume_due: bool,
    sdo: sdo::Server,
    /// Received, and to be answered now.
    sdo_request: Option<[u8; 8]>,
    emergency: Emergency,
    /// TEC and REC, as last told.
    error_counters: (u8, u8),
    /// [`nmt::State::Initialisation`] with a node-ID means that the boot-up is still to be sent.
    nmt: nmt::State,
    is_boot_up_acknowledged: bool,
    heartbeat_ms: u16,
    heartbeat_due: Instant,
    /// The heartbeat time has been written, but not seen by a call that knows the time.
    heartbeat_is_new: bool,
    /// Frames may have been dropped: a boot-up that was among them or a heartbeat is due beside the regular ones.
    is_extra_heartbeat_due: bool,
    error_behaviour: ErrorBehaviour,
    switch: Option<Switch>,
    /// An NMT command that is to be carried out, after a switch that is on its way.
    command: Option<Command>,
    persistent: Settings,
    store: Store,
    /// Store configuration requests of LSS that have not been answered.
    lss_stores: u8,
    /// A store by SDO that has not begun: index and sub-index for its answer, and the heartbeat time.
    sdo_store: Option<(u16, u8, u16)>,
    due: Due,
}

/// A controller with an error counter from here on is error passive (ISO 11898-1).
const ERROR_PASSIVE_LIMIT: u8 = 128;

/// When [`Node::handle_deadline`] has something to do.
#[derive(Clone, Copy, Debug)]
enum Due {
    /// Whatever has happened may have made something due.
    Now,
    At(Instant),
    Never,
}

impl Node {
    /// A node after power-on with its persistent settings.
    pub const fn new(device: Device, persistent: Settings) -> Self {
        // Another image, with other clocks, may have stored a rate that this one has not.
        let bit_rate = match persistent.bit_rate {
            BitRateSetting::Fixed(rate) if !device.bit_rates.contains(rate) => {
                BitRateSetting::Automatic
            }
            bit_rate => bit_rate,
        };
        Self {
            supervision: Supervision::new(bit_rate, device.bit_rates, device.rescue),
            is_proof_due: false,
            is_resume_due: false,
            lss: Slave::new(device.address, device.bit_rates, persistent.node_id, bit_rate),
            device,
            sdo: sdo::Server::new(),
            sdo_request: None,
            emergency: Emergency::new(),
            error_counters: (0, 0),
            nmt: nmt::State::Initialisation,
            is_boot_up_acknowledged: false,
            heartbeat_ms: persistent.heartbeat_ms,
            heartbeat_due: Instant::from_micros(0),
            heartbeat_is_new: false,
            is_extra_heartbeat_due: false,
            error_behaviour: ErrorBehaviour::EnterPreOperational,
            switch: None,
            command: None,
            persistent,
            store: Store::Idle,
            lss_stores: 0,
            sdo_store: None,
            due: Due::Now,
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

    /// The bit rate at which the controller runs, or listens.
    pub const fn bit_rate(&self) -> BitRate {
        self.supervision.bit_rate()
    }

    /// Whether the node only listens, in search of the bit rate.
    pub const fn is_listening(&self) -> bool {
        self.supervision.is_listening()
    }

    /// The COB-IDs of the frames that the node wants to see; it ignores all others. They change with the node-ID.
    pub fn receives(&self) -> [u16; 3] {
        // Without a node-ID there is nothing but LSS and NMT to see.
        let sdo = self.sdo_request_cob_id().unwrap_or(lss::REQUEST_COB_ID);
        [lss::REQUEST_COB_ID, nmt::COMMAND_COB_ID, sdo]
    }

    /// Takes a received frame; returns the answer to a request of LSS that has one at once. All else comes from
    /// [`handle_deadline`](Self::handle_deadline).
    #[must_use = "an action that is not carried out is lost"]
    pub fn handle_frame(&mut self, frame: &Frame, now: Instant) -> Option<Action> {
        if !self.supervision.is_at_ease() {
            // Its sender may be as lost as this node, and repeat its boot-up for want of an acknowledge.
            if self.supervision.is_elsewhere() && nmt::is_boot_up(frame) {
                return None;
            }
            let was_listening = self.is_listening();
            if self.supervision.is_at_home() {
                // The answer leaves first.
                self.is_proof_due = true;
                self.due = Due::Now;
            } else {
                self.handle_bus(BusEvent::Received, now);
            }
            // Its sender repeats it if nobody has acknowledged it.
            if was_listening {
                return None;
            }
        }
        match frame.cob_id() {
            lss::REQUEST_COB_ID => return self.handle_lss(frame.eight_bytes()?, now),
            nmt::COMMAND_COB_ID => {
                self.handle_nmt(Command::from_frame(frame, self.node_id())?);
            }
            id if Some(id) == self.sdo_request_cob_id() && self.serves_sdo() => {
                self.sdo_request = Some(*frame.eight_bytes()?);
                self.due = Due::Now;
            }
            _ => {}
        }
        None
    }

    /// Takes note of a fault that the board has seen: an emergency message reports it, and the history 1003h keeps it.
    pub fn handle_fault(&mut self, fault: Fault) {
        self.emergency.report(fault);
        self.due = Due::Now;
    }

    /// Takes note of the controller's error counters, TEC and REC: for object 2000h, and to report when the controller is
    /// error passive. To be called when it has become so and a few times a second; more often does no harm.
    pub fn note_error_counters(&mut self, transmit: u8, receive: u8) {
        /// The error warning limit (ISO 11898-1). One valid frame takes a receiver that is error passive to 119..=127 and the
        /// next error back: that is no end.
        const WARNING_LIMIT: u8 = 96;
        self.error_counters = (transmit, receive);
        let is_passive = transmit >= ERROR_PASSIVE_LIMIT || receive >= ERROR_PASSIVE_LIMIT;
        if !is_passive && receive < WARNING_LIMIT {
            self.emergency.end(Fault::ErrorPassive);
        } else if is_passive && !self.emergency.has(Fault::ErrorPassive) && !self.is_listening() {
            // Whoever only listens takes no part in the bus.
            self.emergency.report(Fault::ErrorPassive);
        }
        self.due = Due::Now;
    }

    /// Whether [`handle_deadline`](Self::handle_deadline) may have something to do at `now`: a cheap question.
    pub const fn is_due(&self, now: Instant) -> bool {
        match self.due {
            Due::Now => true,
            Due::At(instant) => instant.has_come(now),
            Due::Never => false,
        }
    }

    /// Does the next thing that is due at `now`; returns `None` when nothing is.
    #[must_use = "an action that is not carried out is lost"]
    pub fn handle_deadline(&mut self, now: Instant) -> Option<Action> {
        if !self.is_due(now) {
            return None;
        }
        let action = self.do_next(now);
        if action.is_none() {
            self.due = self.find_deadline().map_or(Due::Never, Due::At);
        }
        action
    }

    /// When [`handle_deadline`](Self::handle_deadline) must be called again, if no other call comes before.
    pub fn next_deadline(&self) -> Option<Instant> {
        match self.due {
            Due::Now => self.find_deadline(),
            Due::At(instant) => Some(instant),
            Due::Never => None,
        }
    }

    fn do_next(&mut self, now: Instant) -> Option<Action> {
        if mem::take(&mut self.is_proof_due) {
            self.handle_bus(BusEvent::Received, now);
        }
        if let Some(action) = self.supervise(now) {
            return Some(action);
        }
        while let Some(switch) = self.switch {
            if !switch.until.has_come(now) {
                return None;
            }
            if let Some(action) = self.advance(switch, now) {
                return Some(action);
            }
        }
        if !self.is_listening() && mem::take(&mut self.is_resume_due) {
            self.is_extra_heartbeat_due = true;
            return Some(Action::ResumeTransmitting);
        }
        if let Some(command) = self.command.take()
            && let Some(action) = self.carry_out(command)
        {
            return Some(action);
        }
        if !self.may_send() {
            return None;
        }
        let sdo_request = self.sdo_request.take();
        let action = match sdo_request.and_then(|request| sdo::handle(request, self)) {
            Some(answer) => self.answer_sdo(answer),
            None => self.store_or_answer().or_else(|| self.tell(now)),
        };
        if let Some(Action::Transmit(_)) = action {
            self.supervision.note_sent(now);
        }
        action
    }

    #[inline(never)] // It has two callers.
    fn find_deadline(&self) -> Option<Instant> {
        let supervision = self.supervision.poll_at().filter(|_| self.is_supervised());
        let other = match self.switch {
            Some(switch) => Some(switch.until),
            None => (self.produces_heartbeat() && self.may_send()).then_some(self.heartbeat_due),
        };
        match (supervision, other) {
            (Some(a), Some(b)) => Some(a.earlier(b)),
            (a, b) => a.or(b),
        }
    }

    fn handle_lss(&mut self, data: &[u8; 8], now: Instant) -> Option<Action> {
        if self.switch.is_some() {
            return None;
        }
        match self.lss.handle(data)? {
            Reaction::Answer(answer) => {
                self.supervision.note_sent(now);
                return Some(Action::Transmit(answer));
            }
            Reaction::ActivateBitTiming(delay_ms) => {
                let delay_micros = u32::from(delay_ms) * 1000;
                self.switch = Some(Switch { phase: Phase::Requested, until: now, delay_micros });
                self.sdo.reset();
                self.forget_sdo_store();
            }
            Reaction::StoreConfiguration => self.lss_stores = self.lss_stores.saturating_add(1),
            Reaction::ResetCommunication => self.command = Some(Command::ResetCommunication),
        }
        self.due = Due::Now;
        None
    }

    fn handle_nmt(&mut self, command: Command) {
        let counts = match self.command {
            Some(Command::ResetNode) => false,
            Some(Command::ResetCommunication) => command.is_reset(),
            _ => true,
        };
        if counts {
            self.command = Some(command);
            self.due = Due::Now;
        }
    }

    fn carry_out(&mut self, command: Command) -> Option<Action> {
        let state = match command {
            Command::ResetNode => return Some(Action::ResetDevice),
            Command::ResetCommunication => return self.reset_communication(),
            Command::Start => nmt::State::Operational,
            Command::Stop => nmt::State::Stopped,
            Command::EnterPreOperational => nmt::State::PreOperational,
        };
        self.enter(state);
        None
    }

    fn enter(&mut self, state: nmt::State) {
        if self.nmt != nmt::State::Initialisation {
            self.nmt = state;
            self.lss.set_locked(self.device.lss_lock && state == nmt::State::Operational);
        }
    }

    /// Does what the error behaviour 1029h says of a communication error (CiA 301).
    fn handle_communication_error(&mut self) {
        match self.error_behaviour {
            ErrorBehaviour::EnterPreOperational if self.nmt == nmt::State::Operational => {
                self.enter(nmt::State::PreOperational);
            }
            ErrorBehaviour::EnterStopped => self.enter(nmt::State::Stopped),
            ErrorBehaviour::EnterPreOperational | ErrorBehaviour::KeepState => {}
        }
    }

    const fn serves_sdo(&self) -> bool {
        self.switch.is_none()
            && matches!(self.nmt, nmt::State::PreOperational | nmt::State::Operational)
    }

    fn answer_sdo(&self, answer: [u8; 8]) -> Option<Action> {
        let cob_id = sdo::RESPONSE_COB_ID + u16::from(self.node_id()?.get());
        Some(Action::Transmit(Frame::with_eight_bytes(cob_id, answer)))
    }

    fn sdo_request_cob_id(&self) -> Option<u16> {
        self.node_id().map(|id| sdo::REQUEST_COB_ID + u16::from(id.get()))
    }

    fn reset_communication(&mut self) -> Option<Action> {
        self.lss.reset_communication();
        self.heartbeat_ms = self.persistent.heartbeat_ms;
        self.error_behaviour = ErrorBehaviour::EnterPreOperational;
        self.sdo.reset();
        self.forget_sdo_store();
        self.nmt = nmt::State::Initialisation;
        Some(Action::SetNodeId(self.node_id()))
    }

    /// Boot-up, emergency, heartbeat.
    fn tell(&mut self, now: Instant) -> Option<Action> {
        let node = self.node_id()?;
        let period = u32::from(self.heartbeat_ms) * 1000;
        let error_control = nmt::error_control(node, self.nmt);
        if mem::take(&mut self.heartbeat_is_new) {
            self.heartbeat_due = now.plus_micros(period);
        }
        let is_ahead = |instant: Instant| {
            // What lies further ahead than a period is left over from half an hour ago.
            !instant.has_come(now) && instant.has_come(now.plus_micros(period))
        };
        let is_late = !is_ahead(self.heartbeat_due);
        if self.nmt == nmt::State::Initialisation {
            self.nmt = nmt::State::PreOperational;
            self.is_boot_up_acknowledged = false;
            if !mem::take(&mut self.is_extra_heartbeat_due) || is_late {
                self.heartbeat_due = now.plus_micros(period);
            }
            return Some(Action::Transmit(error_control));
        }
        // It would overtake a boot-up that waits for the bus; and where nothing but errors is heard it would disturb others
        // who may run at another bit rate.
        if self.is_boot_up_acknowledged
            && self.error_counters.1 < ERROR_PASSIVE_LIMIT
            && self.nmt != nmt::State::Stopped
            && let Some(emergency) = self.emergency.next(node)
        {
            return Some(Action::Transmit(emergency));
        }
        let is_due = mem::take(&mut self.is_extra_heartbeat_due) || is_late;
        if !self.produces_heartbeat() || !is_due {
            return None;
        }
        if is_late {
            let next = self.heartbeat_due.plus_micros(period);
            // After a long delay: one heartbeat, not all that were missed.
            self.heartbeat_due = if is_ahead(next) { next } else { now.plus_micros(period) };
        }
        Some(Action::Transmit(error_control))
    }

    fn produces_heartbeat(&self) -> bool {
        self.heartbeat_ms > 0 && self.nmt != nmt::State::Initialisation
    }
}
