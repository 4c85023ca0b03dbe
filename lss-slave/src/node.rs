//! The node, which joins LSS, bit rate control, NMT, SDO, emergency, storing and process data. Inputs are `handle_*`
//! and `poll`; outputs are actions.

mod agenda;
mod bit_rate_control;
mod nmt_slave;
mod objects;
mod parameters;
mod periodic;
mod process;
mod product;
mod receives;
mod storing;

use core::array;

use crate::{
    BitRate, BitRateSetting, BusEvent, Device, Frame, Instant, NodeId, Settings,
    application::{Application, NoApplication},
    emergency::{Emergency, ErrorCounters, Fault},
    lss::{self, Reaction, Response, Slave, StoreError},
    nmt::{self, Command},
    object_dictionary::Entry,
    process_data::ProcessData,
    sdo::{self, Message},
    settings::parameters::{Packer, Parameter, Parameters},
    supervision::Step,
};
use agenda::{Agenda, Task, Tasks};
use bit_rate_control::BitRateControl;
use nmt_slave::NmtSlave;
use objects::Parts;
use parameters::{Change, Part};
use periodic::{Periodic, Sender};
use product::Product;
pub use receives::Receives;
use storing::Storing;

/// An action for the board to carry out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[must_use]
pub enum Action {
    /// Send this frame. Frames of equal COB-ID must leave in the order of their actions. A PDO may replace an older one
    /// of its COB-ID that has not left.
    Transmit(Frame),
    /// Receive the COB-IDs that a node with this node-ID [`receives`](Node::receives). Drop all pending frames except
    /// those of COB-ID 7E4h: they carry the previous COB-IDs. A frame that is on the bus now may finish; later frames
    /// of the node leave after it.
    SetNodeId(Option<NodeId>),
    /// Receive the COB-IDs that the node [`receives`](Node::receives): a master has changed one of process data.
    SetReceives,
    /// Drop the pending PDOs, those frames whose COB-ID [`is_pdo`](Node::is_pdo): the node has left NMT operational. A
    /// frame that is on the bus now may finish.
    DropPdos,
    /// Start no frame from now on and drop the pending ones; keep receiving and acknowledging.
    StopTransmitting,
    /// Drop the pending frames and run the controller at this bit rate, leaving bus-off if necessary. After
    /// [`StopTransmitting`](Self::StopTransmitting) or [`Listen`](Self::Listen) it only receives and acknowledges.
    SetBitRate(BitRate),
    /// Allow frames to be sent again.
    ResumeTransmitting,
    /// Run the controller silently at this bit rate: drop the pending frames and send no dominant bit, not even an
    /// acknowledge. Receive all frames, and report the first frame and the first error to [`Node::handle_bus`].
    Listen(BitRate),
    /// Make these settings persistent, then call [`Node::handle_stored`]. A node with parameters also has
    /// [`write_parameters`](Node::write_parameters).
    Store(Settings),
    /// Reset the device as after a power cut; the node restarts with the persistent settings.
    ResetDevice,
}

/// A CANopen node that an LSS master can configure.
///
/// These calls drive it:
/// - [`restore`](Self::restore) with each stored parameter, before all others, if it has an application;
/// - [`handle_frame`](Self::handle_frame) with every frame that the node [`receives`](Self::receives);
/// - [`handle_bus`](Self::handle_bus) when a frame of the node was acknowledged, and with the controller's other
///   events;
/// - [`handle_stored`](Self::handle_stored) with the outcome of an [`Action::Store`];
/// - [`handle_fault`](Self::handle_fault) with a fault of the board;
/// - [`poll`](Self::poll) at the start, after each of the others, and at [`poll_at`](Self::poll_at), repeatedly until
///   it returns `None`. Actions that are due come before the next received frame. [`is_due`](Self::is_due) is a cheap
///   check that saves an unnecessary call.
///
/// Before the first call the controller runs at the [`bit_rate`](Self::bit_rate) and receives the node's COB-IDs. A
/// late or unnecessary call does no harm.
///
/// The application `A` is that of a product. `TPDOS` and `RPDOS` are its numbers of PDOs, each 0 to 4; `PRODUCERS` is
/// the number of nodes whose heartbeat can be watched, 0 to 16.
#[derive(Clone, Debug)]
pub struct Node<
    A: Application = NoApplication,
    const TPDOS: usize = 0,
    const RPDOS: usize = 0,
    const PRODUCERS: usize = 0,
> {
    lss: Slave,
    bit_rate: BitRateControl,
    nmt: NmtSlave,
    emergency: Emergency<A::Errors>,
    sdo: sdo::Server<A::SdoBuffer>,
    storing: Storing,
    product: Product<A, TPDOS, RPDOS, PRODUCERS>,
    agenda: Agenda,
    periodic: Periodic,
}

impl Node {
    /// A node after power-on, with the stored settings or the device's defaults.
    pub const fn new(device: Device, stored: Option<Settings>) -> Self {
        Self::with_application(device, stored, NoApplication)
    }
}

impl<A: Application, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    Node<A, TPDOS, RPDOS, PRODUCERS>
{
    /// Whether the node may send PDOs.
    pub const HAS_TPDOS: bool = TPDOS > 0;
    /// The greatest number of bytes that the stored parameters take.
    pub const PARAMETERS: usize =
        <A as Parameters>::LEN + ProcessData::<TPDOS, RPDOS, PRODUCERS>::stored_len::<A>();

    /// A node after power-on, as [`new`](Node::new) makes it, with an application.
    pub const fn with_application(
        device: Device,
        stored: Option<Settings>,
        application: A,
    ) -> Self {
        let persistent = match stored {
            Some(settings) => settings,
            None => device.defaults,
        };
        // An image with other clocks may have stored a rate that this one does not offer.
        let bit_rate = match persistent.bit_rate {
            BitRateSetting::Fixed(rate) if !device.bit_rates.contains(rate) => {
                BitRateSetting::Automatic
            }
            bit_rate => bit_rate,
        };
        let bit_rate_control = BitRateControl::new(bit_rate, &device);
        Self {
            lss: Slave::new(device.address, device.bit_rates, persistent.node_id, bit_rate),
            product: Product::new(device, application, bit_rate_control.in_use()),
            bit_rate: bit_rate_control,
            nmt: NmtSlave::new(persistent.heartbeat_ms),
            emergency: Emergency::new(),
            sdo: sdo::Server::NEW,
            storing: Storing::new(persistent),
            agenda: Agenda::new(),
            periodic: Periodic::Free,
        }
    }

    /// The application of the node.
    pub const fn application(&self) -> &A {
        &self.product.application
    }

    /// The application of the node, to be changed. [`poll`](Self::poll) must follow.
    pub const fn application_mut(&mut self) -> &mut A {
        self.note_values();
        &mut self.product.application
    }

    /// Whether frames of the node wait until those before them have left, as in an SDO block upload or after a heartbeat.
    /// The next of them follow [`BusEvent::NonePending`].
    pub fn wants_to_send_more(&self) -> bool {
        self.sdo.is_sending_block() || self.periodic.is_waiting()
    }

    /// The LSS slave of the node.
    pub const fn lss(&self) -> &Slave {
        &self.lss
    }

    /// The NMT state.
    pub const fn nmt_state(&self) -> nmt::State {
        self.nmt.state()
    }

    /// The active node-ID.
    pub const fn node_id(&self) -> Option<NodeId> {
        self.lss.active_node_id()
    }

    /// The bit rate at which the controller runs or listens.
    pub const fn bit_rate(&self) -> BitRate {
        self.bit_rate.in_use()
    }

    /// The active bit rate (CiA 305): the rate stored at power-on, activated since, or found by the supervision.
    /// Automatic detection stays active after it has found a rate.
    pub const fn active_bit_rate(&self) -> BitRateSetting {
        self.bit_rate.active()
    }

    /// Whether the node only listens, in search of the bit rate.
    pub const fn is_listening(&self) -> bool {
        self.bit_rate.is_listening()
    }

    /// The COB-IDs of the frames that the node uses; it ignores all others. They change with [`Action::SetNodeId`] and
    /// [`Action::SetReceives`].
    #[inline(never)] // It has two callers.
    pub fn receives(&self) -> Receives<RPDOS, PRODUCERS> {
        const UNUSED: u16 = lss::REQUEST_COB_ID;
        let node = self.node_id();
        // Without a node-ID only LSS and NMT are received.
        let sdo = self.sdo_request_cob_id().unwrap_or(UNUSED);
        let sync = self.product.process_data.sync_cob_id().unwrap_or(UNUSED);
        Receives {
            services: [lss::REQUEST_COB_ID, nmt::COMMAND_COB_ID, sdo, sync],
            rpdos: array::from_fn(|at| {
                self.product.process_data.rpdo_cob_id(at, node).unwrap_or(UNUSED)
            }),
            heartbeats: array::from_fn(|at| {
                self.product.process_data.producer_cob_id(at).unwrap_or(UNUSED)
            }),
        }
    }

    /// Handles a received frame and returns the immediate answer to an LSS request, if it has one. [`poll`](Self::poll)
    /// returns all other actions.
    #[must_use = "an action that is not carried out is lost"]
    pub fn handle_frame(&mut self, frame: &Frame, now: Instant) -> Option<Action> {
        // A copy, so that a settled node has the frame in registers.
        if !self.bit_rate.is_settled() && !self.admit(&{ *frame }, now) {
            return None;
        }
        if frame.cob_id() == lss::REQUEST_COB_ID {
            return self.handle_lss(frame.eight_bytes()?, now);
        }
        self.handle_other(frame, now);
        None
    }

    /// Passes a frame to the bit rate control, and returns whether it is served.
    #[inline(never)] // A settled node does not call it.
    fn admit(&mut self, frame: &Frame, now: Instant) -> bool {
        self.agenda.add(Tasks::of(&[Task::BitRate]));
        let is_served = self.bit_rate.handle_frame(frame, now);
        is_served && (!self.bit_rate.is_switching() || frame.cob_id() != lss::REQUEST_COB_ID)
    }

    fn handle_other(&mut self, frame: &Frame, now: Instant) {
        let cob_id = frame.cob_id();
        if cob_id == nmt::COMMAND_COB_ID {
            if let Some(command) = Command::from_frame(frame, self.node_id()) {
                self.nmt.handle(command);
                self.agenda.add(Tasks::of(&[Task::Command]));
            }
        } else if Some(cob_id) == self.sdo_request_cob_id() {
            if let Some(request) = frame.eight_bytes() {
                self.sdo.handle(Message::from_bytes(*request), self.serves_sdo());
                self.agenda.add(Tasks::of(&[Task::Sdo]));
            }
        } else {
            self.handle_process_data(frame, now);
        }
    }

    /// Records a fault of the board, such as [`Fault::SettingsLost`], in the history 1003h and queues an emergency
    /// message.
    pub fn handle_fault(&mut self, fault: Fault) {
        self.emergency.faults.report(fault);
        self.agenda.add(Tasks::of(&[Task::Messages]));
    }

    /// Handles an event of the controller at `now`. A repeated event does no harm, but each [`BusEvent::Overrun`] and
    /// [`BusEvent::BusOffRecovered`] is counted.
    pub fn handle_bus(&mut self, event: BusEvent, now: Instant) {
        if self.bit_rate.is_settled() {
            if event != BusEvent::Acknowledged || self.awaits_acknowledge() {
                self.handle_event(event, now);
            }
            return;
        }
        self.handle_event(event, now);
        self.agenda.add(Tasks::of(&[Task::BitRate]));
        match event {
            BusEvent::ErrorCounters { .. }
            | BusEvent::NonePending
            | BusEvent::Overrun
            | BusEvent::BusOffRecovered => {}
            _ => self.bit_rate.handle_bus(event, now),
        }
    }

    fn awaits_acknowledge(&self) -> bool {
        self.nmt.awaits_acknowledge() || self.emergency.awaits_acknowledge()
    }

    /// Handles an event for all but the bit rate.
    #[inline(never)] // It has two callers.
    fn handle_event(&mut self, event: BusEvent, now: Instant) {
        let tasks: &[Task] = match event {
            BusEvent::ErrorCounters { transmit, receive } => {
                let counters = ErrorCounters { transmit, receive };
                self.emergency.faults.handle_error_counters(counters, self.bit_rate.is_listening());
                &[Task::Messages]
            }
            BusEvent::NonePending => {
                self.sdo.note_sent();
                if self.periodic.note_none_pending(now) == Some(Sender::Heartbeat) {
                    self.nmt.skip_heartbeats(now);
                }
                &[Task::Sdo, Task::Messages, Task::Pdos]
            }
            BusEvent::Overrun => {
                self.emergency.faults.report(Fault::Overrun);
                &[Task::Messages]
            }
            BusEvent::BusOffRecovered => {
                self.emergency.faults.report(Fault::BusOffRecovered);
                &[Task::Messages]
            }
            BusEvent::Acknowledged => {
                self.nmt.note_acknowledge();
                self.emergency.note_acknowledge();
                &[Task::Messages]
            }
            BusEvent::BusOff => {
                self.nmt.handle_communication_error();
                self.lock_lss();
                &[Task::State]
            }
            BusEvent::Received | BusEvent::Error | BusEvent::FormError | BusEvent::HeldDominant => {
                &[]
            }
        };
        self.agenda.add(Tasks::of(tasks));
    }

    /// Takes a stored parameter in place of the default, if the node has it with this data type and the value is within
    /// its limits; returns whether it was taken. [`Application::accept`] is not called. Pass all parameters before the
    /// first [`poll`](Self::poll), with [`Log::restore`](crate::settings::Log::restore).
    pub fn restore(&mut self, parameter: &Parameter<'_>) -> bool {
        let is_taken = self.product.restore(parameter);
        self.nmt.set_error_behaviour(self.product.process_data.error_behaviour::<A>());
        is_taken
    }

    /// Packs the parameters that the store in progress makes persistent, and returns the number of bytes. These are the
    /// `persistent` ones, where the request renews a part by the current values or, for 1011h, leaves it out. The
    /// buffer must have [`PARAMETERS`](Self::PARAMETERS) bytes.
    ///
    /// Call it in one piece with taking the [`Action::Store`], so that all values are of the same time.
    pub fn write_parameters(&self, persistent: &[u8], to: &mut [u8]) -> usize {
        let mut packer = Packer::new(to);
        if Self::PARAMETERS == 0 {
            return 0;
        }
        for part in Part::ALL {
            match (part.change(self.storing.download()), part) {
                (Change::Keep, _) => part.keep(persistent, &mut packer),
                (Change::Remove, _) => {}
                // The heartbeat time is among the settings.
                (Change::Renew, Part::Communication) => {
                    self.product.process_data.save::<A>(&mut packer);
                }
                (Change::Renew, Part::Application) => self.product.application.save(&mut packer),
            }
        }
        packer.len()
    }

    /// Records the outcome of the last [`Action::Store`].
    pub fn handle_stored(&mut self, outcome: Result<(), StoreError>) {
        if self.storing.handle_stored(outcome) {
            self.product.process_data.end_store::<A>(outcome.is_ok());
            if outcome.is_ok() {
                self.emergency.faults.end(Fault::SettingsLost);
            }
            self.agenda.add(Tasks::of(&[Task::Store, Task::Messages]));
        }
    }

    /// Whether [`poll`](Self::poll) may have something to do at `now`: a cheap check.
    pub const fn is_due(&self, now: Instant) -> bool {
        self.agenda.is_due(now)
    }

    /// Performs the next step that is due at `now`; returns `None` when nothing is due.
    #[must_use = "an action that is not carried out is lost"]
    pub fn poll(&mut self, now: Instant) -> Option<Action> {
        if !self.is_due(now) {
            return None;
        }
        self.agenda.begin(now);
        if !self.bit_rate.is_settled() {
            self.agenda.add(Tasks::of(&[Task::BitRate]));
        }
        while let Some(task) = self.agenda.first() {
            if let Some(action) = self.perform(task, now) {
                return Some(action);
            }
        }
        self.find_deadlines(now);
        None
    }

    /// The latest time of the next [`poll`](Self::poll), if there is no other call before.
    pub const fn poll_at(&self) -> Option<Instant> {
        self.agenda.next_deadline()
    }

    /// Performs a step of a task. Without an action the task is over.
    fn perform(&mut self, task: Task, now: Instant) -> Option<Action> {
        let action = match task {
            Task::BitRate => self.next_step(now),
            Task::State => {
                // In NMT stopped there are neither SDO transfers nor emergency messages.
                self.agenda.add(Tasks::SENDING);
                self.inform()
            }
            Task::Command => self.nmt.take_command().and_then(|command| self.carry_out(command)),
            Task::Producers => {
                self.watch_producers(now);
                None
            }
            Task::Sdo => self.answer_sdo(now),
            Task::Store => self.store_or_answer(),
            Task::Messages => self.next_message(now),
            Task::Pdos => self.next_pdo(now),
        };
        match action {
            None => self.agenda.end(task),
            Some(Action::Transmit(_)) if !self.bit_rate.is_settled() => {
                self.bit_rate.note_sent(now)
            }
            Some(_) => {}
        }
        action
    }

    /// The next step of a switch or of the supervision. Without one, lets those tasks wait that a later one allows.
    fn next_step(&mut self, now: Instant) -> Option<Action> {
        use bit_rate_control::Next::*;
        loop {
            let next = self.bit_rate.poll(now);
            self.follow_bit_rate();
            // The NMT state is known.
            let _ = self.inform();
            match next {
                Some(StopTransmitting) => {
                    self.periodic.note_dropped();
                    return Some(Action::StopTransmitting);
                }
                Some(Activate { silent_until }) => self.activate_bit_rate(silent_until),
                Some(EndSwitch) => {
                    self.nmt.restart_heartbeat(now);
                    self.product.process_data.restart_producers(now);
                }
                Some(Step(step)) => return Some(self.take_step(step)),
                Some(ResumeTransmitting) => {
                    self.nmt.note_resumed();
                    self.product.process_data.note_resumed();
                    return Some(Action::ResumeTransmitting);
                }
                Some(KeepSilent) => {
                    self.agenda.hold(Tasks::AFTER_SWITCH);
                    return None;
                }
                None => break,
            }
        }
        let may_send = self.bit_rate.may_send();
        self.agenda.hold(if may_send { Tasks::NONE } else { Tasks::SENDING });
        None
    }

    #[inline(never)] // It has two callers.
    fn find_deadlines(&mut self, now: Instant) {
        let may_report = !self.bit_rate.is_switching() && self.bit_rate.may_send();
        let Self { agenda, bit_rate, nmt, sdo, product, periodic, .. } = self;
        agenda.find_deadlines(|task| match task {
            Task::BitRate => bit_rate.poll_at(),
            Task::Producers => {
                product.process_data.producers_poll_at().filter(|_| !bit_rate.is_switching())
            }
            _ if !may_report => None,
            Task::Sdo => sdo.poll_at::<Parts<'_, A, TPDOS, RPDOS, PRODUCERS>>(),
            Task::Messages => periodic.postpone(nmt.poll_at()?, now),
            Task::Pdos => product.process_data.poll_at(|at| periodic.postpone(at, now)),
            Task::State | Task::Command | Task::Store => None,
        });
    }

    fn handle_lss(&mut self, data: &[u8; 8], now: Instant) -> Option<Action> {
        match self.lss.handle(data)? {
            Reaction::Answer(answer) => {
                if !self.bit_rate.is_settled() {
                    self.bit_rate.note_sent(now);
                }
                return Some(Action::Transmit(answer));
            }
            Reaction::ActivateBitTiming(delay_ms) => {
                self.bit_rate.switch(delay_ms, now);
                self.end_sdo();
                self.agenda.add(Tasks::of(&[Task::BitRate]));
            }
            Reaction::StoreConfiguration => {
                self.storing.request_by_lss();
                self.agenda.add(Tasks::of(&[Task::Store]));
            }
            Reaction::ResetCommunication => {
                self.nmt.handle(Command::ResetCommunication);
                self.agenda.add(Tasks::of(&[Task::Command]));
            }
        }
        None
    }

    fn activate_bit_rate(&mut self, silent_until: Instant) {
        let active = self.bit_rate.active();
        let setting = self.lss.activate_bit_rate(active);
        // A detection that continues keeps its result.
        if active == BitRateSetting::Automatic && setting == BitRateSetting::Automatic {
            return;
        }
        self.bit_rate.activate(setting, silent_until);
        let rate = self.bit_rate();
        self.emergency.faults.end(Fault::AwayFromHomeRate { in_use: rate, home: rate });
    }

    /// Reports a bit rate that the supervision has found, or a return home.
    fn follow_bit_rate(&mut self) {
        let Some(in_use) = self.bit_rate.take_change() else {
            return;
        };
        match self.bit_rate.home() {
            Some(home) if home != in_use => {
                self.emergency.faults.report(Fault::AwayFromHomeRate { in_use, home });
            }
            _ => self.emergency.faults.end(Fault::AwayFromHomeRate { in_use, home: in_use }),
        }
    }

    /// Carries out a step of the supervision, which drops the pending frames.
    fn take_step(&mut self, step: Step) -> Action {
        self.end_sdo_transfer();
        self.emergency.note_dropped();
        self.nmt.note_dropped();
        self.periodic.note_dropped();
        match step {
            Step::TakePart(rate) => Action::SetBitRate(rate),
            Step::Listen(rate) => {
                // It may miss the request to leave the LSS configuration state, and must take none meant for others.
                if !self.bit_rate.is_detecting() {
                    self.lss.discard_session();
                }
                Action::Listen(rate)
            }
            Step::DropFrames => Action::StopTransmitting,
        }
    }

    fn carry_out(&mut self, command: Command) -> Option<Action> {
        let state = match command {
            Command::ResetNode => return Some(Action::ResetDevice),
            Command::ResetCommunication => return Some(self.reset_communication()),
            Command::Start => nmt::State::Operational,
            Command::Stop => nmt::State::Stopped,
            Command::EnterPreOperational => nmt::State::PreOperational,
        };
        self.nmt.enter(state);
        self.lock_lss();
        self.agenda.add(Tasks::of(&[Task::State]));
        None
    }

    fn reset_communication(&mut self) -> Action {
        self.lss.reset_communication();
        let error_behaviour = self.product.process_data.error_behaviour::<A>();
        self.nmt.reset_communication(self.storing.persistent().heartbeat_ms, error_behaviour);
        self.product.process_data.reset();
        self.periodic.note_dropped();
        self.end_sdo();
        self.agenda.add(Tasks::ALL);
        Action::SetNodeId(self.node_id())
    }

    /// Locks or releases LSS after a possible change of the NMT state.
    #[inline(never)] // It has two callers.
    fn lock_lss(&mut self) {
        let is_operational = self.nmt_state() == nmt::State::Operational;
        self.lss.set_locked(self.product.device.lss_lock && is_operational);
    }

    const fn serves_sdo(&self) -> bool {
        !self.bit_rate.is_switching() && self.nmt.serves_sdo()
    }

    fn sdo_request_cob_id(&self) -> Option<u16> {
        self.node_id().map(|id| sdo::REQUEST_COB_ID + u16::from(id.get()))
    }

    fn answer_sdo(&mut self, now: Instant) -> Option<Action> {
        if !self.serves_sdo() {
            self.end_sdo_transfer();
            self.sdo.reset();
        }
        if self.nmt.is_boot_up_due() {
            return None;
        }
        let mut objects = Parts {
            device: &self.product.device,
            lss: &self.lss,
            bit_rate: &self.bit_rate,
            nmt: &mut self.nmt,
            emergency: &mut self.emergency,
            storing: &mut self.storing,
            process_data: &mut self.product.process_data,
            application: &mut self.product.application,
            now,
        };
        let answer = self.sdo.poll(&mut objects, now);
        // A write may concern any of them.
        self.agenda.add(Tasks::of(&[Task::Producers, Task::Store, Task::Messages]));
        self.note_values();
        self.transmit_by_sdo(answer?)
    }

    fn transmit_by_sdo(&self, answer: Message) -> Option<Action> {
        let cob_id = sdo::RESPONSE_COB_ID + u16::from(self.node_id()?.get());
        Some(Action::Transmit(Frame::with_eight_bytes(cob_id, answer.to_bytes())))
    }

    /// Discards pending SDO requests and transfers.
    #[inline(never)] // It has two callers: 40 bytes.
    fn end_sdo(&mut self) {
        self.end_sdo_transfer();
        self.sdo.reset();
        self.storing.forget_sdo();
    }

    /// Discards the current SDO transfer without an answer to the client.
    #[inline(never)] // It has several callers.
    fn end_sdo_transfer(&mut self) {
        if let Some(Entry { index, sub_index, .. }) = self.sdo.domain() {
            self.product.application.abort_domain(*index, *sub_index);
        }
        self.sdo.end_transfer();
    }

    fn store_or_answer(&mut self) -> Option<Action> {
        use storing::Next::*;
        loop {
            let (node_id, bit_rate) = (self.lss.pending_node_id(), self.lss.pending_bit_rate());
            match self.storing.poll(node_id, bit_rate)? {
                Store(settings) => {
                    match Part::Communication.change(self.storing.download()) {
                        Change::Keep => {}
                        Change::Renew => {
                            let error_behaviour = self.nmt.error_behaviour();
                            self.product.process_data.stage::<A>(error_behaviour);
                        }
                        Change::Remove => self.product.process_data.stage_declared::<A>(),
                    }
                    return Some(Action::Store(settings));
                }
                AnswerLss(outcome) => {
                    return Some(Action::Transmit(
                        Response::StoreConfiguration(outcome).to_frame(),
                    ));
                }
                AnswerSdo(download, outcome) if self.serves_sdo() => {
                    return self.transmit_by_sdo(match outcome {
                        Ok(()) => download.confirmation,
                        Err(error) => {
                            Message::store_failed(download.index, download.sub_index, error)
                        }
                    });
                }
                // The NMT state has changed since the request.
                AnswerSdo(..) => {}
            }
        }
    }

    /// Returns the next boot-up, emergency message or heartbeat.
    fn next_message(&mut self, now: Instant) -> Option<Action> {
        let node = self.node_id()?;
        if let Some(boot_up) = self.nmt.next_boot_up(node, now) {
            self.agenda.add(Tasks::of(&[Task::State, Task::Sdo]));
            return Some(Action::Transmit(boot_up));
        }
        if self.nmt.allows_emergencies()
            && let Some(emergency) = self.emergency.next(node)
        {
            return Some(Action::Transmit(emergency));
        }
        let due_since = self.nmt.heartbeat_due_since(now)?;
        let tpdo = self.product.process_data.first_timed_out(now);
        if !self.periodic.is_free(now) || tpdo.is_some_and(|(_, at)| !due_since.has_come(at)) {
            return None;
        }
        let heartbeat = self.nmt.next_heartbeat(node, now);
        self.note_periodic(Sender::Heartbeat, &heartbeat, now);
        Some(Action::Transmit(heartbeat))
    }

    /// Records a frame of a periodic service.
    fn note_periodic(&mut self, sender: Sender, frame: &Frame, now: Instant) {
        self.periodic.note_sent(sender, frame.longest_micros(self.bit_rate()), now);
    }
}
