//! The node, which joins LSS, bit rate control, NMT, SDO, emergency, storing and process data. Inputs are `handle_*`
//! and `poll`; outputs are actions.

mod action;
mod agenda;
mod areas;
mod bit_rate;
mod communication;
mod messages;
mod objects;
mod outgoing;
mod periodic;
mod process;
mod product;
mod program;
mod receives;
mod settings_object;
mod stored;
mod verification;

use lss_slave::Slave;

use crate::{
    BitRate, BitRateSetting, BusEvent, Device, Frame, Instant, NodeId, Settings,
    application::{Application, NoApplication},
    emergency::{APPLICATION, Emergency, Fault, own},
    lss::{self, Response, StateMachine, StoreError},
    nmt::{self, Command, slave::NmtSlave},
    numbers::{List, Numbers},
    object_dictionary::{self, DefaultValue, Description, Entry, Object},
    sdo::{self, Abort, Message, Objects},
    settings::parameters::{Packer, Parameter},
};
pub use action::Action;
use agenda::{Agenda, Task, Tasks};
use areas::{Area, Change, Owed};
use communication::Communication;
use objects::NodeObjects;
pub use outgoing::{Service, Services};
use periodic::Periodic;
use product::Product;
pub use program::Program;
pub use receives::Receives;
use settings_object::Written;
use verification::Verification;

/// The time of accesses to objects that do not depend on it.
const START: Instant = Instant::from_micros(0);

/// A CANopen node that an LSS master can configure.
///
/// These calls drive it:
/// - [`restore`](Self::restore) with each stored parameter, before all others, if it has an application;
/// - [`handle_frame`](Self::handle_frame) with every frame that the node [`receives`](Self::receives);
/// - [`handle_sent`](Self::handle_sent) when frames of the node were acknowledged, and
///   [`handle_bus_event`](Self::handle_bus_event) with the controller's other events;
/// - [`handle_stored`](Self::handle_stored) with the outcome of an [`Action::Store`];
/// - [`handle_fault`](Self::handle_fault) with a fault of the board;
/// - [`poll`](Self::poll) at the start, after each of the others, and at [`poll_at`](Self::poll_at), repeatedly until
///   it returns `None`. Actions that are due come before the next received frame. [`is_due`](Self::is_due) is a cheap
///   check that saves an unnecessary call.
///
/// Before the first call the controller runs at the [`bit_rate`](Self::bit_rate) and receives the node's COB-IDs. A
/// late or unnecessary call does no harm.
///
/// The application `A` is that of a product, with its PDOs.
#[derive(Clone, Debug)]
pub struct Node<A: Application = NoApplication> {
    slave: Slave,
    nmt: NmtSlave,
    emergency: Emergency,
    sdo: sdo::Server<A::SdoBuffer>,
    storing: Storing,
    product: Product<A>,
    agenda: Agenda,
    periodic: Periodic,
}

/// The persistent settings, and the requests to change them: one store at a time, for LSS before an SDO client.
#[derive(Clone, Debug)]
struct Storing {
    persistent: Settings,
    store: Store,
    /// LSS store configuration requests that have not been answered.
    lss_requests: u8,
    /// The parameters of communication in use are still those that the store in progress has packed.
    is_as_packed: bool,
    /// An SDO request whose store has not begun.
    sdo_request: Option<Owed>,
    verification: Verification,
    written: Written,
}

#[derive(Clone, Copy, Debug)]
enum Store {
    Idle,
    Running(Settings, Requester),
    Done(Result<(), StoreError>, Requester),
}

/// The requester that waits for the outcome of a store.
#[derive(Clone, Copy, Debug)]
enum Requester {
    Lss,
    Sdo(Owed),
    /// An SDO client that a reset or its abort has cancelled.
    Nobody(Owed),
}

impl Storing {
    /// The SDO download that the store in progress carries out; `None` for one for LSS.
    const fn download(&self) -> Option<Owed> {
        match self.store {
            Store::Running(_, Requester::Sdo(download) | Requester::Nobody(download)) => {
                Some(download)
            }
            _ => None,
        }
    }

    /// Cancels the SDO client's request; a store in progress continues.
    fn forget_sdo(&mut self) {
        self.sdo_request = None;
        if let Store::Running(_, requester) | Store::Done(_, requester) = &mut self.store
            && let Requester::Sdo(download) = *requester
        {
            *requester = Requester::Nobody(download);
        }
    }
}

impl Node {
    /// A node after power-on, with the stored settings or the device's defaults.
    pub const fn new(device: Device, stored: Option<Settings>) -> Self {
        Self::with_application(device, stored, NoApplication)
    }
}

impl<A: Application> Node<A> {
    /// The greatest number of bytes that the stored parameters take.
    pub const STORED_LEN: usize = {
        // A product has the length in a type, so that `cargo check` finds a wrong declaration here.
        let _ = Communication::<A::Numbers>::new::<A>();
        A::STORED_LEN + stored::len::<A>()
    };

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
        let slave = device.slave(persistent);
        Self {
            product: Product::new(device, application, slave.bit_rate().in_use()),
            slave,
            nmt: NmtSlave::new(device.heartbeat_ms, A::ERROR_BEHAVIOUR),
            emergency: Emergency::new(),
            sdo: sdo::Server::NEW,
            storing: Storing {
                persistent,
                store: Store::Idle,
                lss_requests: 0,
                is_as_packed: false,
                sdo_request: None,
                verification: Verification::new(),
                written: Written::NOTHING,
            },
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

    /// Sends the TPDO with this number, from 1, though no value has changed: at once, or after its inhibit time if it is
    /// event-driven; at the next SYNC if its transmission type is 0. One of another type, one that is not valid, and any
    /// outside of NMT operational stay as they are. [`poll`](Self::poll) must follow.
    pub fn send_tpdo(&mut self, number: u8) {
        if A::Numbers::TPDOS > 0 {
            self.product.communication.pdos.request(number);
            self.agenda.add(Tasks::of(&[Task::Pdos]));
        }
    }

    /// Whether frames of the node wait until those before them have left, as in an SDO block upload or after a heartbeat.
    /// The next of them follow [`BusEvent::NonePending`].
    pub fn wants_to_send_more(&self) -> bool {
        NodeObjects::<A>::BLOCK_UPLOAD && self.sdo.is_sending_block() || self.periodic.is_waiting()
    }

    /// Records that a debugger has halted the program, and that the board has dropped all frames since. Ends an SDO
    /// transfer; a boot-up or an emergency message that nobody acknowledged is sent again.
    pub fn note_halt(&mut self) {
        // A deadline may be more than half a turn of the clock ago.
        self.agenda.add(Tasks::ALL);
        self.end_sdo_transfer();
        self.frames_dropped();
    }

    /// The LSS state machine of the node.
    pub const fn lss(&self) -> &StateMachine {
        self.slave.lss()
    }

    /// The NMT state.
    pub const fn nmt_state(&self) -> nmt::State {
        self.nmt.state()
    }

    /// The active node-ID.
    pub const fn node_id(&self) -> Option<NodeId> {
        self.slave.lss().active_node_id()
    }

    /// The bit rate at which the controller runs or listens.
    pub const fn bit_rate(&self) -> BitRate {
        self.slave.bit_rate().in_use()
    }

    /// The active bit rate (CiA 305): the rate stored at power-on, activated since, or found by the supervision.
    /// Automatic detection stays active after it has found a rate.
    pub const fn active_bit_rate(&self) -> BitRateSetting {
        self.slave.bit_rate().active()
    }

    /// Whether the node only listens, in search of the bit rate.
    pub const fn is_listening(&self) -> bool {
        self.slave.bit_rate().is_listening()
    }

    /// The frames that the node uses; it ignores all others. They change with [`Action::SetNodeId`],
    /// [`Action::SetReceives`], [`Action::SetBitRate`] and [`Action::Listen`].
    pub fn receives(&self) -> Receives<A::Numbers> {
        const UNUSED: u16 = lss::REQUEST_COB_ID;
        let node = self.node_id();
        // Without a node-ID only LSS and NMT are received.
        let sdo = self.sdo_request_cob_id().unwrap_or(UNUSED);
        let sync = self.product.communication.pdos.sync_cob_id().unwrap_or(UNUSED);
        let Communication { pdos, consumer, .. } = &self.product.communication;
        Receives {
            all: self.slave.bit_rate().needs_all_frames(),
            services: [lss::REQUEST_COB_ID, nmt::COMMAND_COB_ID, sdo, sync],
            rpdos: List::from_fn(|at| pdos.rpdo_cob_id(at, node).unwrap_or(UNUSED)),
            heartbeats: List::from_fn(|at| consumer.cob_id(at).unwrap_or(UNUSED)),
        }
    }

    /// Handles a received frame and returns the answer to a request of LSS or SDO, if there is one at once.
    /// [`poll`](Self::poll) returns all other actions.
    #[must_use = "an action that is not carried out is lost"]
    pub fn handle_frame(&mut self, frame: &Frame, now: Instant) -> Option<Action> {
        let bit_rate = self.slave.bit_rate();
        let is_served = bit_rate.is_settled() || !bit_rate.is_listening();
        if !bit_rate.is_settled() {
            self.agenda.add(Tasks::of(&[Task::BitRate]));
        }
        match self.slave.handle_frame(frame, now) {
            Some(lss_slave::Action::Transmit(answer)) => {
                return Some(Action::Transmit(answer, Service::Lss));
            }
            Some(action) => self.react(action),
            None if frame.cob_id() != lss::REQUEST_COB_ID && is_served => {
                return self.handle_other(frame, now).map(Action::sdo);
            }
            // A request of LSS may have begun a switch.
            None if !self.slave.bit_rate().is_settled() => {
                self.agenda.add(Tasks::of(&[Task::BitRate]));
            }
            None => {}
        }
        None
    }

    /// Makes a reaction of LSS due.
    #[cold]
    fn react(&mut self, action: lss_slave::Action) {
        match action {
            lss_slave::Action::Store => {
                self.storing.lss_requests = self.storing.lss_requests.saturating_add(1);
                self.agenda.add(Tasks::of(&[Task::Store]));
            }
            lss_slave::Action::ResetCommunication => {
                self.nmt.handle(Command::ResetCommunication);
                self.agenda.add(Tasks::of(&[Task::Command]));
            }
            _ => {}
        }
    }

    #[inline(never)] // Inlined, it slows the answers of LSS.
    fn handle_other(&mut self, frame: &Frame, now: Instant) -> Option<Frame> {
        let cob_id = frame.cob_id();
        if Some(cob_id) == self.sdo_request_cob_id() {
            return self.handle_sdo(Message::from_bytes(*frame.eight_bytes()?), now);
        }
        if cob_id == nmt::COMMAND_COB_ID {
            if let Some(command) = Command::from_frame(frame, self.node_id()) {
                self.nmt.handle(command);
                self.agenda.add(Tasks::of(&[Task::Command]));
            }
        } else {
            self.handle_process_data(frame, now);
        }
        None
    }

    /// Queues an emergency message about a fault of the board, such as [`Fault::SettingsLost`].
    pub fn handle_fault(&mut self, fault: Fault) {
        self.emergency.report_fault(fault);
        self.agenda.add(Tasks::of(&[Task::Messages]));
    }

    /// Handles an event of the controller at `now`. A repeated event does no harm, but each [`BusEvent::Overrun`] and
    /// [`BusEvent::BusOffRecovered`] is counted.
    pub fn handle_bus_event(&mut self, event: BusEvent, now: Instant) {
        self.handle_event(event, now);
        self.inform_bit_rate(event, now);
    }

    /// Handles that frames of these services were sent and acknowledged since the last call.
    #[inline(always)] // Most acknowledges make no difference.
    pub fn handle_sent(&mut self, sent: Services, now: Instant) {
        if sent.has_any(Self::AWAITED) || !self.slave.bit_rate().is_settled() {
            self.note_acknowledge(sent, now);
        }
    }

    fn inform_bit_rate(&mut self, event: BusEvent, now: Instant) {
        if self.slave.bit_rate().is_settled() {
            return;
        }
        self.agenda.add(Tasks::of(&[Task::BitRate]));
        self.slave.handle_bus_event(event, now);
    }

    /// Reports an error of the application by an emergency message (CiA 301, 7.2.7): its error code, bits of the error
    /// register 1001h (bit 0 is added) and the manufacturer's bytes. The error stays in the error register until
    /// [`end_report`](Self::end_report); the message enters the history 1003h when it has left. An error that is reported
    /// again is sent again.
    ///
    /// Returns whether it was taken: up to eight errors of the application may be present at a time. A further one, the
    /// error code 0, and [those of the node](crate::emergency::OwnCode) have no effect;
    /// [`error_code!`](crate::error_code) finds them at compile time.
    pub fn report(&mut self, code: u16, register: u8, information: [u8; 5]) -> bool {
        if own::is_own(code) {
            return false;
        }
        self.agenda.add(Tasks::of(&[Task::Messages]));
        self.emergency.report(APPLICATION, code, register, information)
    }

    /// Ends an error of the application; does nothing if it is not present. A message with error code 0 follows when no
    /// error is left.
    pub fn end_report(&mut self, code: u16) {
        self.emergency.end(APPLICATION, code);
        self.agenda.add(Tasks::of(&[Task::Messages]));
    }

    /// Takes a stored parameter in place of the default, if the node has it with this data type and the value is within
    /// its limits; returns whether it was taken. [`Application::accept`] is not called. Pass all parameters before the
    /// first [`poll`](Self::poll), with [`Log::restore`](crate::settings::Log::restore).
    pub fn restore(&mut self, parameter: &Parameter<'_>) -> bool {
        if Area::of(parameter.index) == Area::Application {
            return areas::restore(&mut self.product.application, parameter);
        }
        let is_taken = self.objects(START).0.take(parameter).is_some();
        self.reset_parameters();
        self.storing.verification.current = self.storing.verification.persistent;
        is_taken
    }

    /// Packs the parameters that the store in progress makes persistent, and returns the number of bytes. These are the
    /// `persistent` ones, where the request renews a part by the current values or, for 1011h, leaves it out. The
    /// buffer must have [`STORED_LEN`](Self::STORED_LEN) bytes.
    ///
    /// All values are those of this moment, so call it once, when the board begins to store.
    pub fn write_parameters(&mut self, persistent: &[u8], to: &mut [u8]) -> usize {
        let mut packer = Packer::new(to);
        let download = self.storing.download();
        for area in Area::ALL {
            match (area.change(download), download) {
                (Change::Keep, _) | (_, None) => area.keep(persistent, &mut packer),
                (Change::Remove, _) => {}
                (Change::Renew, _) if area == Area::Application => {
                    areas::save(&self.product.application, &mut packer);
                }
                (Change::Renew, Some(Owed { sub_index, .. })) => {
                    let is_right = self.storing.verification.is_right_after(sub_index);
                    if area == Area::Communication || is_right {
                        self.objects(START).0.save(area, &mut packer);
                    }
                }
            }
        }
        let len = packer.len();
        self.storing.is_as_packed = true;
        len
    }

    /// Records the outcome of the last [`Action::Store`]: the packed parameters that are persistent now, as
    /// [`write_parameters`](Self::write_parameters) has returned them, or why nothing was stored.
    pub fn handle_stored(&mut self, outcome: Result<&[u8], StoreError>) {
        let Store::Running(settings, requester) = self.storing.store else {
            return;
        };
        if let (Ok(parameters), Some(download)) = (outcome, self.storing.download()) {
            self.replace_persistent(parameters, Area::Communication.change(Some(download)));
        }
        self.storing.store = Store::Done(outcome.map(|_| ()), requester);
        if outcome.is_ok() {
            self.storing.persistent = settings;
            self.emergency.end_fault(Fault::SettingsLost);
        }
        self.agenda.add(Tasks::of(&[Task::Store, Task::Messages]));
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
        if !self.slave.bit_rate().is_settled() {
            self.agenda.add(Tasks::of(&[Task::BitRate]));
        }
        while let Some(task) = self.agenda.first() {
            if let Some(action) = self.perform(task, now) {
                return Some(action);
            }
        }
        self.agenda.find_next();
        None
    }

    /// The latest time of the next [`poll`](Self::poll), if there is no other call before.
    pub const fn poll_at(&self) -> Option<Instant> {
        self.agenda.next_deadline()
    }

    /// The objects of the node in no certain order, with their descriptions, for an EDS or a page of documentation. The
    /// image does not contain them.
    pub fn entries(device: &Device) -> impl Iterator<Item = (Entry, Description)> + use<A> {
        let own =
            object_dictionary::TABLE.iter().copied().zip(object_dictionary::descriptions(device));
        own.map(|(entry, description)| match entry.object {
            Object::DeviceType => {
                let default = DefaultValue::Number(A::DEVICE_TYPE);
                (entry, Description { default, ..description })
            }
            Object::CommunicationErrorBehaviour => {
                let default = DefaultValue::Number(A::ERROR_BEHAVIOUR as u32);
                (entry, Description { default, ..description })
            }
            _ => (entry, description),
        })
        .chain(Communication::<A::Numbers>::entries::<A>())
        .chain(A::OBJECTS.iter().copied().zip(A::descriptions()))
        .chain(A::SETTINGS_BY_SDO.then(settings_object::entries).into_iter().flatten())
        .chain(A::PROGRAM_DOWNLOAD.then(program::entries).into_iter().flatten())
    }

    /// Performs a step of a task. Without an action the task is over.
    fn perform(&mut self, task: Task, now: Instant) -> Option<Action> {
        let action = match task {
            Task::BitRate if self.has_steps() || self.agenda.is_holding() => self.next_step(now),
            Task::BitRate => None,
            Task::State => {
                // In NMT stopped there are neither SDO transfers nor emergency messages.
                self.agenda.add(Tasks::SENDING);
                self.inform();
                self.drop_stale()
            }
            Task::Command => self.nmt.take_command().and_then(|command| self.carry_out(command)),
            Task::Producers => {
                self.watch_producers(now);
                None
            }
            Task::Sdo => self.answer_sdo(now).map(Action::sdo),
            Task::Store => self.answer_or_store(),
            Task::Messages => self.next_message(now),
            Task::Pdos => self.next_pdo(now),
        };
        match action {
            None => {
                let deadline = self.deadline(task, now);
                self.agenda.end(task, deadline);
            }
            Some(Action::Transmit(..)) => self.slave.note_sent(now),
            Some(_) => {}
        }
        action
    }

    /// Whether the bit rate may have steps: at a proven one there are none before the next switch.
    const fn has_steps(&self) -> bool {
        !self.slave.bit_rate().is_settled()
    }

    /// The deadline of a task that has ended at `now`.
    fn deadline(&self, task: Task, now: Instant) -> Option<Instant> {
        let Self { slave, nmt, emergency, sdo, product, periodic, .. } = self;
        let postpone = |due| periodic.postpone(due, now);
        match task {
            Task::BitRate if self.has_steps() => slave.poll_at(),
            Task::Producers => product.communication.late_at(),
            Task::Sdo => sdo.poll_at::<NodeObjects<'_, A>>(),
            Task::Messages if !slave.bit_rate().is_guest() => {
                let heartbeat = nmt.poll_at().and_then(postpone);
                Instant::earliest(heartbeat, emergency.inhibited_until())
            }
            Task::Pdos => product.communication.pdos.poll_at(postpone),
            _ => None,
        }
    }

    /// Begins the store that LSS, or else an SDO client, has asked for, unless one is in progress.
    fn begin_store(&mut self) -> Option<Action> {
        let Storing { persistent, store: Store::Idle, lss_requests, sdo_request, .. } =
            self.storing
        else {
            return None;
        };
        let (settings, requester) = if lss_requests > 0 {
            let Settings { node_id, bit_rate, .. } = self.slave.lss().pending();
            (persistent.with_node_id(node_id).with_bit_rate(bit_rate), Requester::Lss)
        } else {
            let download = sdo_request?;
            self.storing.sdo_request = None;
            if Area::Verification.change(Some(download)) == Change::Remove {
                self.storing.verification.clear();
            }
            let mut settings = persistent;
            // Their object is in this area.
            let change = Area::Application.change(Some(download));
            if A::SETTINGS_BY_SDO && change == Change::Renew {
                settings = self.storing.written.apply(settings, self.slave.lss());
            }
            (settings, Requester::Sdo(download))
        };
        self.storing.store = Store::Running(settings, requester);
        Some(Action::Store(settings))
    }

    /// Answers the store that has ended, or begins the next.
    fn answer_or_store(&mut self) -> Option<Action> {
        if let Store::Done(outcome, requester) = self.storing.store {
            self.storing.store = Store::Idle;
            match requester {
                Requester::Lss => {
                    self.storing.lss_requests = self.storing.lss_requests.saturating_sub(1);
                    let answer = Response::StoreConfiguration(outcome);
                    return Some(Action::Transmit(answer.to_frame(), Service::Lss));
                }
                // Unless the NMT state has changed since the request.
                Requester::Sdo(download) if self.serves_sdo() => {
                    let answer = download.answer(outcome.map_err(Abort::from));
                    return self.sdo_frame(answer).map(Action::sdo);
                }
                Requester::Sdo(_) | Requester::Nobody(_) => {}
            }
        }
        self.begin_store()
    }
}
