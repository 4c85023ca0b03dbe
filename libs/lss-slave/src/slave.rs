//! The whole LSS slave: the services, and the bit rate that they set.

use crate::{
    BitRate, BitRates, BusEvent, Frame, Instant, Settings,
    bit_rate::{Control, Next, Step},
    cob_id,
    lss::{Address, REQUEST_COB_ID, Reaction, Response, StateMachine, StoreError},
};

/// A whole LSS slave (CiA 305): the services, the switch of the bit rate with both delays, automatic detection, and the
/// supervision of the bit rate.
///
/// These calls drive it:
/// - [`handle_frame`](Self::handle_frame) with every frame that the controller receives;
/// - [`handle_bus_event`](Self::handle_bus_event) when a frame of the node was acknowledged, and with the controller's
///   errors: only rescue and automatic detection need it;
/// - [`note_sent`](Self::note_sent) with every frame that the node sends apart from LSS;
/// - [`handle_stored`](Self::handle_stored) with the outcome of each [`Action::Store`];
/// - [`reset_communication`](Self::reset_communication) when the node performs that NMT command;
/// - [`poll`](Self::poll) at the start, after each of the others, and at [`poll_at`](Self::poll_at), until it returns
///   `None`.
///
/// The node serves other frames unless [`is_listening`](Control::is_listening) was true before
/// [`handle_frame`](Self::handle_frame), and sends its own if [`may_send`](Self::may_send). Before the first call the
/// controller runs at the bit rate [in use](Control::in_use).
#[derive(Clone, Debug)]
pub struct Slave {
    lss: StateMachine,
    bit_rate: Control,
    /// The outcome of the last store, and the answers with it that are still to be sent.
    stored: (Result<(), StoreError>, u8),
}

/// An action for the node to carry out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[must_use]
pub enum Action {
    /// Send this answer as soon as a mailbox is free; the slave does not repeat it.
    Transmit(Frame),
    /// Make the [pending](StateMachine::pending) settings persistent, and pass the outcome to [`Slave::handle_stored`].
    Store,
    /// Perform NMT reset communication, with [`Slave::reset_communication`]: the slave had no node-ID until now.
    ResetCommunication,
    /// Drop the pending frames: a switch of the bit rate begins, or nobody acknowledges them. Keep receiving and
    /// acknowledging.
    DropFrames,
    /// Drop the pending frames and run the controller at this bit rate, leaving bus-off if necessary.
    SetBitRate(BitRate),
    /// Run the controller silently at this bit rate: drop the pending frames and send no dominant bit, not even an
    /// acknowledge.
    Listen(BitRate),
    /// Until the next [`SetBitRate`](Self::SetBitRate) or [`Listen`](Self::Listen) the slave needs only the requests of
    /// LSS: the bit rate is proven. Who passes all frames may ignore it.
    FilterFrames,
}

impl Slave {
    /// A slave after power-on, with its settings and the bit rates that the controller can produce. A stored rate that
    /// is not among them leads to automatic detection, which needs the controller's errors.
    pub const fn new(address: Address, rates: BitRates, settings: Settings) -> Self {
        let bit_rate = rates.or_automatic(settings.bit_rate);
        Self {
            lss: StateMachine::new(address, rates, settings.node_id, bit_rate),
            bit_rate: Control::new(bit_rate, rates),
            stored: (Ok(()), 0),
        }
    }

    /// Adds the search for a network at another bit rate: while no frame has proven the node's own, it listens at the
    /// others in turn when the controller reports errors.
    #[cfg(feature = "rescue")]
    #[must_use]
    pub const fn with_rescue(self) -> Self {
        let serial_number = self.lss.address().serial_number;
        Self { bit_rate: self.bit_rate.with_rescue(serial_number), ..self }
    }

    /// The LSS state, the node-ID and the pending settings.
    pub const fn lss(&self) -> &StateMachine {
        &self.lss
    }

    /// The same, to be changed by services other than LSS.
    pub const fn lss_mut(&mut self) -> &mut StateMachine {
        &mut self.lss
    }

    /// The bit rates in use, active and last commanded.
    pub const fn bit_rate(&self) -> &Control {
        &self.bit_rate
    }

    /// Whether the node may send frames now: it is in no switch of the bit rate, and does not listen silently.
    pub const fn may_send(&self) -> bool {
        self.bit_rate.may_send() && !self.bit_rate.is_switching()
    }

    /// Handles a received frame, and returns the immediate reaction to a request of LSS, if it has one.
    /// [`poll`](Self::poll) returns all other actions. Requests within a switch of the bit rate are ignored.
    #[inline(always)] // The one who waits for the answer holds up the whole network.
    #[must_use = "an action that is not carried out is lost"]
    pub fn handle_frame(&mut self, frame: &Frame, now: Instant) -> Option<Action> {
        // A copy, so that a settled node has the frame in registers.
        let is_served = self.bit_rate.is_settled() || self.admit(&{ *frame }, now);
        if !is_served || frame.cob_id() != REQUEST_COB_ID {
            return None;
        }
        match self.lss.handle(frame.eight_bytes()?)? {
            Reaction::Answer(answer) => {
                self.note_sent(now);
                Some(Action::Transmit(answer))
            }
            Reaction::ActivateBitTiming(delay_ms) => {
                self.bit_rate.switch(delay_ms, now);
                None
            }
            Reaction::StoreConfiguration => Some(Action::Store),
            Reaction::ResetCommunication => Some(Action::ResetCommunication),
        }
    }

    /// Passes a frame to the bit rate, and returns whether it is served.
    #[inline(never)] // A settled slave does not call it.
    fn admit(&mut self, frame: &Frame, now: Instant) -> bool {
        self.bit_rate.handle_frame(frame, now) && !self.bit_rate.is_switching()
    }

    /// Handles an acknowledge or another event of the controller. A repeated event does no harm.
    pub fn handle_bus_event(&mut self, event: BusEvent, now: Instant) {
        if !self.bit_rate.is_settled() {
            self.bit_rate.handle_bus(event, now);
        }
    }

    /// Records that the node has sent a frame.
    pub fn note_sent(&mut self, now: Instant) {
        if !self.bit_rate.is_settled() {
            self.bit_rate.note_sent(now);
        }
    }

    /// Records a request, apart from LSS, that the node will answer. At a bit rate that it has found, a node speaks only
    /// after that.
    pub const fn note_asked(&mut self) {
        self.bit_rate.note_asked();
    }

    /// Records the outcome of [`Action::Store`]. [`poll`](Self::poll) returns the answer to store configuration when it
    /// may be sent: after the silence of a switch, if one has begun.
    pub fn handle_stored(&mut self, outcome: Result<(), StoreError>) {
        // Each store makes all that is pending persistent: the last outcome holds for those before it, too.
        self.stored = (outcome, self.stored.1.saturating_add(1));
    }

    /// Performs NMT reset communication: activates the pending node-ID and enters LSS waiting state. A node with a
    /// node-ID sends its boot-up afterwards.
    pub const fn reset_communication(&mut self) {
        self.lss.reset_communication();
        self.note_asked();
    }

    /// The boot-up message of the node; `None` without a node-ID.
    pub fn boot_up(&self) -> Option<Frame> {
        let node_id = self.lss.active_node_id()?;
        Some(Frame::with_one_byte(cob_id::ERROR_CONTROL + u16::from(node_id.get()), 0))
    }

    /// The bit rate in use, once after each change that no master has commanded.
    pub fn take_change(&mut self) -> Option<BitRate> {
        self.bit_rate.take_change()
    }

    /// Returns the next action that is due at `now`; `None` when nothing is due.
    #[must_use = "an action that is not carried out is lost"]
    #[inline(never)] // Inlined, it takes 500 bytes more.
    pub fn poll(&mut self, now: Instant) -> Option<Action> {
        loop {
            let Some(next) = self.bit_rate.poll(self.lss.state(), now) else {
                return self.answer_store(now);
            };
            return Some(match next {
                Next::Step(Step::DropFrames) => Action::DropFrames,
                Next::Activate { silent_until } => {
                    let setting = self.lss.activate_bit_rate(self.bit_rate.active());
                    self.bit_rate.activate(setting, silent_until);
                    continue;
                }
                Next::Step(Step::TakePart(rate)) => Action::SetBitRate(rate),
                Next::Step(Step::Listen(rate)) => {
                    // Elsewhere it may miss the request to leave the LSS configuration state, and must take none meant
                    // for others.
                    if !self.bit_rate.is_detecting() && !self.bit_rate.is_trusted() {
                        self.lss.discard_session();
                    }
                    Action::Listen(rate)
                }
                Next::Settled => Action::FilterFrames,
            });
        }
    }

    /// The answer to a store that has ended, if it may be sent.
    fn answer_store(&mut self, now: Instant) -> Option<Action> {
        let (outcome, waiting) = self.stored;
        let rest = waiting.checked_sub(1).filter(|_| self.may_send())?;
        self.stored.1 = rest;
        self.note_sent(now);
        Some(Action::Transmit(Response::StoreConfiguration(outcome).to_frame()))
    }

    /// The latest time of the next [`poll`](Self::poll), if there is no other call before.
    pub fn poll_at(&self) -> Option<Instant> {
        self.bit_rate.poll_at()
    }
}
