//! A board of the model: the node of the library, and what the model knows of its controller and its memory.

use std::hash::{Hash, Hasher};

use canopen_node::{
    Action, BitRate, BitRateSetting, BitRates, BusEvent, Device, Frame, Instant, Node, NodeId,
    Services, Settings,
    lss::{self, Address, State, StoreError},
    nmt,
};

use crate::{digest::digest, mutation::Mutation};

/// The clock of the controller, which can produce 125, 50, 20 and 10 kbit/s.
const CLOCK_HZ: u32 = 1_000_000;
/// The bit rates of the network: the one of new boards, and the one that a master switches to.
pub const RATES: [BitRate; 2] = [BitRate::Kbit125, BitRate::Kbit50];
/// The number of errors in succession after which a controller is error passive: its error flags destroy no frames.
const PASSIVE: u8 = 16;

/// The LSS address of a board: the serial numbers differ in the two lowest bits.
pub const fn address(board: usize) -> Address {
    Address {
        vendor_id: 0x1111_1111,
        product_code: 0x2222_2222,
        revision_number: 0x3333_3333,
        serial_number: 0x4444_4444 + board as u32,
    }
}

/// A board, with or without power.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Board {
    number: usize,
    is_supervised: bool,
    mutation: Option<Mutation>,
    /// What the memory holds.
    pub stored: Kept,
    /// The settings of a store that failed, for [`Mutation::StoresWhatFailed`] only.
    failed: Option<Kept>,
    /// The settings that were confirmed, or found at a power-on, last.
    pub confirmed: Kept,
    /// The settings that were requested since, the latest last, without a double.
    pub newer: Vec<Kept>,
    /// The requests to store that wait for an answer.
    pub requests: Vec<Kept>,
    pub running: Option<Running>,
}

/// Stored settings: the node-ID as in LSS, and the bit rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Kept {
    pub node_id: u8,
    pub bit_rate: BitRate,
}

/// A board with power.
#[derive(Clone, Debug)]
pub struct Running {
    pub node: Node,
    pub now: Instant,
    /// `None` within a step of the model.
    digest: Option<u64>,
    pub bit_rate: BitRate,
    /// The controller sends no dominant bit.
    pub is_silent: bool,
    /// See [`Mutation::StaysSilent`].
    pub is_mute: bool,
    /// The end of the silence of a switch, which the node is in.
    silent_until: Option<Instant>,
    /// Errors since the last valid frame or the start of the controller, up to error passive.
    pub errors: u8,
    /// The LSS answers that have not left.
    pub answers: Vec<Frame>,
    /// The other frames to send, within one step of the model.
    pub messages: Vec<Frame>,
    /// The store in progress.
    pub store: Option<Kept>,
    /// See [`Mutation::LeavesItsSession`].
    has_left_its_session: bool,
}

impl Running {
    /// What distinguishes two boards.
    fn key(&self) -> impl PartialEq + Hash {
        let answers: Vec<_> = self.answers.iter().map(Frame::padded_data).collect();
        let flags = (self.is_silent, self.is_mute, self.is_switching(), self.errors);
        (self.digest, self.bit_rate.index(), flags, answers, self.store)
    }

    /// Whether its error flags destroy frames at other bit rates.
    pub const fn is_active(&self) -> bool {
        !self.is_silent && self.errors < PASSIVE
    }

    /// Whether the node is in the silence of a switch.
    pub const fn is_switching(&self) -> bool {
        self.silent_until.is_some()
    }

    /// Whether the node is in LSS configuration state.
    pub fn is_selected(&self) -> bool {
        self.node.lss().state() == State::Configuration && !self.has_left_its_session
    }
}

impl PartialEq for Running {
    fn eq(&self, other: &Self) -> bool {
        self.key() == other.key()
    }
}

impl Eq for Running {}

impl Hash for Running {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.key().hash(state);
    }
}

impl Kept {
    fn of(settings: Settings) -> Self {
        let BitRateSetting::Fixed(bit_rate) = settings.bit_rate else {
            panic!("no master of the model selects automatic detection")
        };
        Self { node_id: NodeId::to_lss(settings.node_id), bit_rate }
    }

    fn settings(self) -> Settings {
        let node_id = NodeId::from_lss(self.node_id).expect("it comes from settings");
        Settings::new(self.bit_rate.into()).with_node_id(node_id)
    }
}

impl Board {
    /// A new board with power and the first of [`RATES`].
    pub fn new(number: usize, is_supervised: bool, mutation: Option<Mutation>) -> Self {
        let stored = Kept { node_id: 0xFF, bit_rate: RATES[0] };
        let mut board = Self {
            number,
            is_supervised,
            mutation,
            stored,
            failed: None,
            confirmed: stored,
            newer: Vec::new(),
            requests: Vec::new(),
            running: None,
        };
        board.power_on();
        board
    }

    /// The LSS address.
    pub const fn address(&self) -> Address {
        address(self.number)
    }

    /// Starts the node with the stored settings.
    pub fn power_on(&mut self) {
        self.confirmed = self.stored;
        self.newer.clear();
        self.requests.clear();
        let device = Device::new(self.address(), BitRates::possible(CLOCK_HZ))
            .with_rescue(self.is_supervised);
        let node = Node::new(device, Some(self.stored.settings()));
        self.running = Some(Running {
            bit_rate: node.bit_rate(),
            node,
            now: Instant::from_micros(0),
            digest: None,
            is_silent: false,
            is_mute: false,
            silent_until: None,
            errors: 0,
            answers: Vec::new(),
            messages: Vec::new(),
            store: None,
            has_left_its_session: false,
        });
        self.settle();
    }

    /// Cuts the power. A store in progress may have been completed.
    pub fn cut(&mut self, is_store_completed: bool) {
        let store = self.running.take().and_then(|running| running.store);
        if let Some(store) = store.filter(|_| is_store_completed) {
            self.stored = store;
        }
    }

    /// The time until the node's next deadline in microseconds.
    pub fn micros_to_deadline(&self) -> Option<u32> {
        let running = self.running.as_ref()?;
        Some(running.node.poll_at()?.micros_after(running.now))
    }

    /// Lets time pass for this board.
    pub fn pass(&mut self, micros: u32) {
        let Some(running) = &mut self.running else { return };
        running.now = running.now.plus_micros(micros);
        self.settle();
    }

    /// The board receives a valid frame.
    pub fn receive(&mut self, frame: &Frame) {
        let Some(running) = &mut self.running else { return };
        running.errors = 0;
        let is_received = matches!(frame.cob_id(), lss::REQUEST_COB_ID | nmt::COMMAND_COB_ID);
        if !is_received && !running.node.is_listening() {
            return self.see(BusEvent::Received);
        }
        let leaves = running.node.node_id().is_none()
            && running.node.lss().pending_node_id().is_some()
            && self.mutation == Some(Mutation::LeavesItsSession);
        running.has_left_its_session = leaves;
        if leaves && frame.cob_id() == lss::REQUEST_COB_ID {
            return;
        }
        for frame in Mutation::received(self.mutation, self.number, frame) {
            let Some(running) = &mut self.running else { return };
            let was_selected = running.is_selected();
            let action = running.node.handle_frame(&frame, running.now);
            if frame.cob_id() == lss::REQUEST_COB_ID && was_selected && !running.is_switching() {
                if let [0x15, low, high, ..] = *frame.data() {
                    let delay = 1_000 * u32::from(u16::from_le_bytes([low, high]));
                    running.silent_until = Some(running.now.plus_micros(2 * delay));
                }
                if frame.data()[0] == 0x17 {
                    let pending = self.pending();
                    self.requests.push(pending);
                }
            }
            self.carry_out(action);
            self.settle();
        }
    }

    /// The controller detects an error of a frame.
    pub fn see_error(&mut self, event: BusEvent) {
        let Some(running) = &mut self.running else { return };
        running.errors = PASSIVE.min(running.errors + 1);
        self.see(event);
    }

    /// The node learns of an event of its controller.
    pub fn see(&mut self, event: BusEvent) {
        let Some(running) = &mut self.running else { return };
        if event == BusEvent::Acknowledged {
            running.errors = 0;
        }
        running.node.handle_bus_event(event, running.now);
        self.settle();
    }

    /// The store in progress ends.
    pub fn end_store(&mut self, outcome: Result<(), StoreError>) {
        let Some(running) = &mut self.running else { return };
        let Some(store) = running.store.take() else { return };
        match (outcome, self.mutation) {
            (Ok(()), Some(Mutation::ConfirmsWithoutStoring)) => {}
            (Ok(()), _) => self.stored = self.failed.take().unwrap_or(store),
            (Err(_), Some(Mutation::StoresWhatFailed)) => self.failed = Some(store),
            (Err(_), _) => {}
        }
        running.node.handle_stored(outcome);
        self.settle();
    }

    /// Does what is due.
    fn settle(&mut self) {
        if let Some(running) = &mut self.running {
            running.digest = None;
            let is_over = running.silent_until.take_if(|end| end.has_come(running.now)).is_some();
            running.is_mute |= is_over && self.mutation == Some(Mutation::StaysSilent);
        }
        while let Some(running) = &mut self.running
            && let Some(action) = running.node.poll(running.now)
        {
            self.carry_out(Some(action));
        }
        if self.running.is_some() && !self.requests.is_empty() {
            let pending = self.pending();
            self.newer.retain(|newer| *newer != pending);
            self.newer.push(pending);
        }
    }

    /// Updates the digest of the node, at the end of a step of the model.
    pub fn seal(&mut self) {
        if let Some(running) = &mut self.running {
            running.digest.get_or_insert_with(|| digest(&running.node, running.now));
        }
    }

    /// Whether no more than this number of answers are waiting, or in work. They have priority on the bus.
    pub fn is_at_most_late_by(&self, answers: usize) -> bool {
        let waiting = self.running.as_ref().map_or(0, |running| running.answers.len());
        waiting.max(self.requests.len()) <= answers
    }

    /// What a store would store now.
    fn pending(&self) -> Kept {
        let lss = self.running.as_ref().expect("a board with power").node.lss();
        let settings = Settings::new(lss.pending_bit_rate());
        Kept::of(settings.with_node_id(lss.pending_node_id()))
    }

    /// Whether a power-on would find the settings that were confirmed, or newer ones.
    pub fn keeps_its_word(&self) -> bool {
        self.stored == self.confirmed || self.newer.contains(&self.stored)
    }

    /// Records the answer to the oldest request to store.
    fn note_answer(&mut self, is_confirmed: bool) {
        let request = self.requests.remove(0);
        if is_confirmed {
            self.confirmed = request;
            // Older requests are out of date.
            if let Some(at) = self.newer.iter().position(|newer| *newer == request) {
                self.newer.drain(..=at);
            }
        }
    }

    fn carry_out(&mut self, action: Option<Action>) {
        let (Some(action), Some(running)) = (action, &mut self.running) else { return };
        match action {
            Action::Transmit(frame, _) => {
                let is_allowed = !running.is_switching() && !running.is_silent;
                assert!(is_allowed, "nothing is sent in a silent period");
                if running.is_mute {
                    return;
                }
                if frame.cob_id() != lss::RESPONSE_COB_ID {
                    running.messages.push(frame);
                    return;
                }
                running.answers.push(frame);
                if let [0x17, error, ..] = *frame.data() {
                    self.note_answer(error == 0);
                }
            }
            Action::Drop(Services::ALL) => {
                running.answers.clear();
                running.messages.clear();
            }
            Action::SetBitRate(rate) | Action::Listen(rate) => {
                running.is_silent = matches!(action, Action::Listen(_));
                running.bit_rate = rate;
                running.errors = 0;
                running.answers.clear();
                running.messages.clear();
            }
            Action::Store(settings) => running.store = Some(Kept::of(settings)),
            Action::ResetDevice => {
                self.cut(false);
                self.power_on();
            }
            Action::SetNodeId(_) => running.messages.clear(),
            Action::SetReceives | Action::Drop(_) => {}
        }
    }
}
