//! The node on its board: hands over what arrives, carries out what the node answers.

use cortex_m::peripheral::SCB;
use lss_slave::{Action, Instant, Node, NodeId, Settings, lss::StoreError};
use rtic_sync::signal::SignalWriter;

use crate::{can::Controller, clock};

/// The node and its controller.
pub struct Slave {
    node: Node,
    can: Controller,
    /// Begins a store; its outcome comes back by [`Slave::handle_stored`].
    store: SignalWriter<'static, Settings>,
    deadline: Option<Instant>,
    /// Tells the task that waits for the deadline that there is another.
    deadline_changed: SignalWriter<'static, ()>,
}

impl Slave {
    /// A node that has just been switched on, and its controller, which is set up as the node wants it.
    pub fn new(
        node: Node,
        can: Controller,
        store: SignalWriter<'static, Settings>,
        deadline_changed: SignalWriter<'static, ()>,
    ) -> Self {
        Self { node, can, store, deadline: None, deadline_changed }
    }

    /// Frames have been received.
    pub fn handle_received(&mut self) {
        while let Some(frame) = self.can.receive() {
            if let Some(action) = self.node.handle_frame(&frame, clock::now()) {
                self.act(action);
            }
            self.settle();
        }
    }

    /// A frame has been sent or aborted.
    pub fn handle_transmitted(&mut self) {
        self.can.handle_transmitted();
    }

    /// The controller's error state has changed.
    pub fn handle_status(&mut self) {
        defmt::warn!("CAN: error {}", self.can.handle_status());
    }

    /// A store has come to its end.
    pub fn handle_stored(&mut self, outcome: Result<(), StoreError>) {
        self.node.handle_stored(outcome);
        self.settle();
    }

    /// The deadline may have come; returns the next one.
    pub fn handle_deadline(&mut self) -> Option<Instant> {
        self.act_until_nothing_is_due();
        self.deadline = self.node.next_deadline();
        self.deadline
    }

    /// Looks after the controller, a few times a second.
    pub fn supervise(&mut self) {
        self.can.supervise();
    }

    fn settle(&mut self) {
        self.act_until_nothing_is_due();
        let deadline = self.node.next_deadline();
        if deadline != self.deadline {
            self.deadline = deadline;
            self.deadline_changed.write(());
        }
    }

    fn act_until_nothing_is_due(&mut self) {
        while let Some(action) = self.node.handle_deadline(clock::now()) {
            self.act(action);
        }
    }

    fn act(&mut self, action: Action) {
        match action {
            Action::Transmit(frame) => self.can.transmit(frame),
            Action::SetNodeId(id) => {
                defmt::info!("node-ID {=u8:#x}", NodeId::to_lss(id));
                self.can.set_receives(self.node.receives());
            }
            Action::StopTransmitting => {
                defmt::info!("activate bit timing: silent from now on");
                self.can.stop_transmitting();
            }
            Action::SetBitRate(rate) => {
                defmt::info!("bit rate {=u16} kbit/s", rate.kbit_per_s());
                self.can.set_bit_rate(rate);
            }
            Action::ResumeTransmitting => self.can.resume_transmitting(),
            Action::Store(settings) => self.store.write(settings),
            Action::ResetDevice => {
                defmt::info!("NMT reset node");
                SCB::sys_reset();
            }
        }
    }
}
