//! What an application that commands the network does with its node.

use super::{Action, Node, Task, Tasks, areas::Download};
use crate::{Application, BitRate, Frame, Instant};

impl<A: Application> Node<A> {
    /// Sends a frame of the application, unless the node may not send now. [`poll`](Self::poll) must follow.
    #[must_use = "an action that is not carried out is lost"]
    pub fn send(&mut self, frame: Frame, now: Instant) -> Option<Action> {
        if !A::IS_MASTER || !self.slave.may_send() {
            return None;
        }
        self.slave.note_sent(now);
        self.agenda.add(Tasks::of(&[Task::BitRate]));
        Some(Action::Transmit(frame))
    }

    /// Switches the bit rate with both delays, in milliseconds, as activate bit timing does (CiA 305). The next
    /// [`store_values`](Self::store_values) makes the rate persistent. Returns whether the rate is offered, and no other switch is in
    /// progress. [`poll`](Self::poll) must follow.
    pub fn switch_bit_rate(&mut self, rate: BitRate, delay_ms: u16, now: Instant) -> bool {
        if !A::IS_MASTER || !self.slave.switch_bit_rate(rate, delay_ms, now) {
            return false;
        }
        self.storing.written.note_bit_rate(rate);
        self.agenda.add(Tasks::of(&[Task::BitRate]));
        true
    }

    /// Stores the application's values, as 1010h:3 does for a client; [`Event::Stored`](crate::application::Event::Stored)
    /// tells the outcome. Returns false if another store waits to begin. [`poll`](Self::poll) must follow.
    pub fn store_values(&mut self) -> bool {
        if !A::IS_MASTER || self.storing.sdo_request.is_some() {
            return false;
        }
        self.storing.sdo_request = Some(Download::OWN);
        self.agenda.add(Tasks::of(&[Task::Store]));
        true
    }
}
