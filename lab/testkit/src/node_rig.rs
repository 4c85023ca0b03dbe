//! A board in the process: drives a [`Node`] in virtual time as its documentation prescribes, with its settings in a
//! flash.

use canopen_node::{
    Action, Application, BitRate, BitRates, BusEvent, Device, Frame, Instant, Node, NodeId,
    Receives, Service, Services, Settings,
    application::NoApplication,
    lss::{Address, StoreError},
    settings::{Found, Log, parameters::unpack},
};

use super::{
    flash::BoardFlash,
    frames::{self, Frames},
};

/// The default LSS address of a board: no byte occurs twice, the serial number has its top bit set.
pub const ADDRESS: Address = Address {
    vendor_id: 0x1122_3344,
    product_code: 0x5566_7788,
    revision_number: 0x0001_0203,
    serial_number: 0xDEAD_BEEF,
};

/// The bytes for parameters in the settings log of a board.
const ROOM: usize = 2048;
/// More actions than are ever due at one time.
const ENDLESS: usize = 1000;

/// A board with a node on it.
pub struct NodeRig<A: Application = NoApplication> {
    pub node: Node<A>,
    /// The application as it is at each power-on.
    new_application: A,
    /// A handle to the chip that holds the settings.
    pub flash: BoardFlash,
    /// The result of opening the settings log at the last power-on.
    pub found: Found,
    /// Whether other nodes acknowledge the node's frames.
    pub is_acknowledged: bool,
    device: Device,
    log: Log<BoardFlash, ROOM>,
    /// Microseconds since the rig was created.
    now: u64,
    /// The node's clock at that time.
    clock_at_start: u32,
    /// The controller's state.
    bit_rate: BitRate,
    /// Nothing was sent since all pending frames were dropped.
    pub is_quiet: bool,
    receives: Receives<A::Numbers>,
    /// The store in progress, if stores take time.
    /// The settings and parameters of the store in progress.
    running_store: Option<(Settings, Vec<u8>)>,
    stores_take_time: bool,
    actions: Vec<(u64, Action)>,
    /// The time of the last call of `timeline`.
    timeline_from: u64,
}

/// A device with all eight bit rates.
pub const fn device(address: Address) -> Device {
    Device::new(address, BitRates::possible(40_000_000))
        .with_name("Test board")
        .with_versions("A", "1.2.3")
}

/// The factory defaults of a board: 1 Mbit/s, no heartbeat.
pub fn defaults(node_id: u8) -> Settings {
    let node_id = NodeId::from_lss(node_id).expect("1..=127 or FF");
    Settings::new(BitRate::Kbit1000.into()).with_node_id(node_id)
}

impl NodeRig {
    /// A new board without a node-ID, just powered on.
    pub fn unconfigured() -> Self {
        Self::with_defaults(defaults(0xFF))
    }

    /// A new board with this default node-ID, just powered on.
    pub fn with_node_id(node_id: u8) -> Self {
        Self::with_defaults(defaults(node_id))
    }

    /// A new board with node-ID 40h, just powered on, whose stores last until [`finish_store`](Self::finish_store).
    pub fn with_slow_stores() -> Self {
        let mut board = Self::with_node_id(0x40);
        board.let_stores_take_time();
        board
    }

    pub fn with_heartbeat(node_id: u8, heartbeat_ms: u16) -> Self {
        Self::with_heartbeat_and(defaults(node_id), heartbeat_ms)
    }

    pub fn with_heartbeat_and(defaults: Settings, heartbeat_ms: u16) -> Self {
        Self::of(device(ADDRESS).with_defaults(defaults).with_heartbeat_ms(heartbeat_ms))
    }

    pub fn with_defaults(defaults: Settings) -> Self {
        Self::new(ADDRESS, defaults, BoardFlash::blank(0), 0)
    }

    pub fn with_address(address: Address) -> Self {
        Self::new(address, defaults(0xFF), BoardFlash::blank(0), 0)
    }

    /// A board that is powered on when its clock is at `clock_at_start` microseconds.
    pub fn new(
        address: Address,
        defaults: Settings,
        flash: BoardFlash,
        clock_at_start: u32,
    ) -> Self {
        Self::with_device(device(address).with_defaults(defaults), flash, clock_at_start)
    }

    pub fn with_device(device: Device, flash: BoardFlash, clock_at_start: u32) -> Self {
        Self::with_application(device, flash, clock_at_start, NoApplication)
    }

    /// A new board of this device, just powered on.
    pub fn of(device: Device) -> Self {
        Self::with_device(device, BoardFlash::blank(0), 0)
    }
}

impl<A: Application + Clone> NodeRig<A> {
    /// A new board with node-ID 40h and an application, just powered on.
    pub fn running(application: A) -> Self {
        let device = device(ADDRESS).with_defaults(defaults(0x40));
        Self::with_application(device, BoardFlash::blank(0), 0, application)
    }

    /// A board with an application.
    pub fn with_application(
        device: Device,
        flash: BoardFlash,
        clock_at_start: u32,
        application: A,
    ) -> Self {
        let (log, node, found) = start(device, &flash, application.clone());
        let mut board = Self {
            new_application: application,
            bit_rate: node.bit_rate(),
            is_quiet: node.is_listening(),
            receives: node.receives(),
            node,
            flash,
            found,
            is_acknowledged: true,
            device,
            log,
            now: 0,
            clock_at_start,
            running_store: None,
            stores_take_time: false,
            actions: Vec::new(),
            timeline_from: 0,
        };
        board.run();
        board
    }

    /// Sends the node a request of the LSS master; returns the frames that the node sends at once.
    pub fn lss(&mut self, request: &str) -> Frames {
        self.receive(&frames::request(request))
    }

    /// Switches the node to LSS configuration state and sends it requests of the LSS master, `11 05, 17`; returns the
    /// answers.
    pub fn configure(&mut self, requests: &str) -> Frames {
        self.lss("04 01");
        Frames(requests.split(", ").flat_map(|request| self.lss(request).0).collect())
    }

    /// Sends the node an NMT command; returns the frames that the node sends at once.
    pub fn nmt(&mut self, command: &str) -> Frames {
        self.receive(&frames::command(command))
    }

    pub fn receive(&mut self, frame: &Frame) -> Frames {
        let before = self.actions.len();
        let action = self.node.handle_frame(frame, self.instant());
        self.carry_out(action);
        self.run();
        self.sent_since(before)
    }

    /// Reports an event of the controller, without polling the node.
    pub fn report(&mut self, event: BusEvent) {
        self.node.handle_bus_event(event, self.instant());
    }

    /// Reports an event of the controller; returns the frames that the node sends at once.
    pub fn see(&mut self, event: BusEvent) -> Frames {
        self.report(event);
        self.pass_us(0)
    }

    /// Acknowledges a frame of this service; returns the frames that the node sends at once.
    pub fn acknowledge(&mut self, service: Service) -> Frames {
        self.node.handle_sent(Services::of(service), self.instant());
        self.pass_us(0)
    }

    /// The node-ID that the node reports; `None` in LSS waiting state, where it does not answer.
    pub fn inquired_node_id(&mut self) -> Option<u8> {
        self.lss("5E").0.first().map(|answer| answer.data()[1])
    }

    pub fn is_in_configuration_state(&mut self) -> bool {
        self.inquired_node_id().is_some()
    }

    /// Lets time pass, with a call at each deadline; returns the frames that the node sends.
    pub fn pass_ms(&mut self, ms: u64) -> Frames {
        self.pass_us(ms * 1000)
    }

    pub fn pass_us(&mut self, us: u64) -> Frames {
        let before = self.actions.len();
        let end = self.now + us;
        while let Some(us) = self.us_to_deadline()
            && self.now + us < end
        {
            self.now += us;
            self.run();
        }
        self.now = end;
        self.run();
        self.sent_since(before)
    }

    /// Lets time pass without a call until its end, as on a busy board.
    pub fn be_late_ms(&mut self, ms: u64) -> Frames {
        let before = self.actions.len();
        self.now += ms * 1000;
        self.run();
        self.sent_since(before)
    }

    pub fn us_to_deadline(&self) -> Option<u64> {
        Some(self.node.poll_at()?.micros_after(self.instant()).into())
    }

    /// Cuts and restores the power; returns the frames that the node sends then.
    pub fn power_cycle(&mut self) -> Frames {
        let before = self.actions.len();
        self.restart();
        self.run();
        self.sent_since(before)
    }

    /// Makes stores last until [`finish_store`](Self::finish_store).
    pub fn let_stores_take_time(&mut self) {
        self.stores_take_time = true;
    }

    pub fn is_storing(&self) -> bool {
        self.running_store.is_some()
    }

    /// Executes the store in progress; returns the frames that the node sends then.
    pub fn finish_store(&mut self) -> Frames {
        let (settings, parameters) = self.running_store.clone().expect("a store is running");
        let outcome = self.log.store_with_parameters(settings, &parameters);
        self.end_store(outcome.map_err(StoreError::from))
    }

    /// Begins the store in progress only now, as a busy board does.
    pub fn begin_store_late(&mut self) {
        let (settings, _) = self.running_store.take().expect("a store is running");
        self.running_store = Some((settings, self.parameters_to_store()));
    }

    fn parameters_to_store(&mut self) -> Vec<u8> {
        let mut parameters = vec![0; ROOM];
        let len = self.node.write_parameters(self.log.parameters(), &mut parameters);
        parameters.truncate(len);
        parameters
    }

    /// Ends the store in progress with the given outcome; returns the frames that the node sends then.
    pub fn end_store(&mut self, outcome: Result<(), StoreError>) -> Frames {
        let before = self.actions.len();
        let parameters =
            self.running_store.take().map(|(_, parameters)| parameters).unwrap_or_default();
        self.node.handle_stored(outcome.map(|()| &parameters[..]));
        self.run();
        self.sent_since(before)
    }

    /// The persistent parameters that the node has taken or stored, packed.
    pub fn stored_parameters(&self) -> &[u8] {
        self.log.parameters()
    }

    /// The persistent heartbeat time, if it has been stored.
    pub fn stored_heartbeat_ms(&self) -> Option<u16> {
        let value =
            unpack(self.log.parameters()).find(|parameter| parameter.index == 0x1017)?.value;
        Some(u16::from_le_bytes(value.try_into().expect("two bytes")))
    }

    /// The persistent settings.
    pub fn stored(&self) -> Option<Settings> {
        self.log.settings()
    }

    /// The bit rate of the controller.
    pub fn bit_rate(&self) -> BitRate {
        self.bit_rate
    }

    /// Carries out an action that no frame and no time has led to, such as an answer that was due.
    pub fn act(&mut self, action: Option<Action>) {
        self.carry_out(action);
        self.run();
    }

    /// The node's actions since the last call of this or of `timeline`.
    pub fn take_actions(&mut self) -> Vec<Action> {
        self.take_timed_actions().map(|(_, action)| action).collect()
    }

    /// The same, each with its time in microseconds since the rig was created.
    pub fn take_timed_actions(&mut self) -> impl Iterator<Item = (u64, Action)> {
        self.actions.drain(..)
    }

    /// The actions that `take_actions` would return.
    pub fn actions(&self) -> impl Iterator<Item = Action> {
        self.actions.iter().map(|&(_, action)| action)
    }

    /// Microseconds since the rig was created.
    pub fn now(&self) -> u64 {
        self.now
    }

    /// The board's actions since the last call, with their times relative to it: `2 ms 704: 7F`.
    pub fn timeline(&mut self) -> Vec<String> {
        let from = self.timeline_from;
        self.timeline_from = self.now;
        let line = |(at, action): (u64, Action)| {
            let what = match action {
                Action::Transmit(frame, _) => frames::text(&frame),
                Action::SetNodeId(id) => format!("node-ID {:02X}", NodeId::to_lss(id)),
                Action::SetReceives => "receives".into(),
                Action::Drop(Services::ALL) => "drop all".into(),
                Action::Drop(_) => "drop".into(),
                Action::SetBitRate(rate) => format!("{} kbit/s", rate.kbit_per_s()),
                Action::Store(_) => "store".into(),
                Action::ResetDevice => "reset".into(),
                Action::Listen(rate) => format!("listen at {} kbit/s", rate.kbit_per_s()),
            };
            format!("{} ms {what}", (at - from) as f64 / 1000.0)
        };
        self.actions.drain(..).map(line).collect()
    }

    fn instant(&self) -> Instant {
        Instant::from_micros(self.clock_at_start).plus_micros(self.now as u32)
    }

    fn sent_since(&self, index: usize) -> Frames {
        let frame = |(_, action): &(u64, Action)| match action {
            Action::Transmit(frame, _) => Some(*frame),
            _ => None,
        };
        Frames(self.actions[index..].iter().filter_map(frame).collect())
    }

    fn run(&mut self) {
        let before = self.actions.len();
        loop {
            while let Some(action) = self.node.poll(self.instant()) {
                self.carry_out(Some(action));
                assert!(self.actions.len() - before < ENDLESS, "the actions come to an end");
            }
            if !self.is_acknowledged || !self.node.wants_to_send_more() {
                break;
            }
            self.report(BusEvent::NonePending);
        }
        assert_eq!(self.receives, self.node.receives(), "the board knows the COB-IDs");
        assert_eq!(self.bit_rate, self.node.bit_rate(), "the board runs at the active bit rate");
        assert_ne!(self.us_to_deadline(), Some(0), "what was due has been done");
    }

    fn carry_out(&mut self, action: Option<Action>) {
        let Some(action) = action else { return };
        self.actions.push((self.now, action));
        match action {
            Action::Transmit(_, service) => {
                assert!(!self.node.is_listening(), "a listener sends nothing");
                self.is_quiet = false;
                if self.is_acknowledged {
                    self.node.handle_sent(Services::of(service), self.instant());
                }
            }
            Action::SetNodeId(id) => {
                assert_eq!(id, self.node.node_id());
                self.receives = self.node.receives();
            }
            Action::SetReceives => self.receives = self.node.receives(),
            Action::Drop(services) => self.is_quiet |= services == Services::ALL,
            Action::SetBitRate(rate) => {
                let is_change = rate != self.bit_rate;
                assert!(self.is_quiet || !is_change, "it changes in a silent period");
                self.bit_rate = rate;
                self.receives = self.node.receives();
            }
            Action::Store(settings) => {
                assert!(self.running_store.is_none(), "one store at a time");
                let parameters = self.parameters_to_store();
                if self.stores_take_time {
                    self.running_store = Some((settings, parameters));
                    return;
                }
                let outcome = self.log.store_with_parameters(settings, &parameters);
                self.node
                    .handle_stored(outcome.map(|()| &parameters[..]).map_err(StoreError::from));
            }
            Action::ResetDevice => self.restart(),
            Action::Listen(rate) => {
                self.is_quiet = true;
                self.bit_rate = rate;
                self.receives = self.node.receives();
            }
        }
    }

    /// Cuts and restores the power; the node has not been polled then.
    pub fn restart(&mut self) {
        let application = self.new_application.clone();
        (self.log, self.node, self.found) = start(self.device, &self.flash, application);
        self.bit_rate = self.node.bit_rate();
        self.receives = self.node.receives();
        self.is_quiet = self.node.is_listening();
        self.running_store = None;
    }
}

/// A node after power-on, with what its flash holds.
fn start<A: Application>(
    device: Device,
    flash: &BoardFlash,
    application: A,
) -> (Log<BoardFlash, ROOM>, Node<A>, Found) {
    const { assert!(Node::<A>::STORED_LEN <= ROOM) };
    let (mut log, mut found) = Log::open_with_parameters(flash.clone());
    let mut node = Node::with_application(device, log.settings(), application);
    if let Err(error) = log.restore(|parameter| node.restore(parameter)) {
        found = Found::MediumFailed(error);
    }
    (log, node, found)
}
