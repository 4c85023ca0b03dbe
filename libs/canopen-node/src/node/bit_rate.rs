//! Switch and supervision of the bit rate, as parts of the node.

use super::{Action, Node, Services, Task, Tasks};
use crate::{Application, Instant, emergency::Fault};

impl<A: Application> Node<A> {
    /// The next step of a switch or of the supervision. Without one, lets those tasks wait that a later one allows.
    pub(super) fn next_step(&mut self, now: Instant) -> Option<Action> {
        let was_switching = self.slave.bit_rate().is_switching();
        let action = self.slave.poll(now);
        self.follow_bit_rate();
        self.inform();
        let is_switching = self.slave.bit_rate().is_switching();
        if was_switching && !is_switching {
            // By now the frame has left that was on the bus when the others were dropped.
            self.frames_dropped();
            self.nmt.restart_heartbeat(now);
            self.product.communication.restart(now);
        }
        let Some(action) = action else {
            let released = self.agenda.hold(match self.slave.may_send() {
                _ if is_switching => Tasks::AFTER_SWITCH,
                true if self.slave.bit_rate().is_guest() => Tasks::of(&[Task::Pdos]),
                true => Tasks::NONE,
                false => Tasks::SENDING,
            });
            if released.has(Task::Messages) {
                self.nmt.request_heartbeat();
            }
            return None;
        };
        let action = match action {
            lss_slave::Action::DropFrames => Action::Drop(Services::ALL),
            lss_slave::Action::SetBitRate(rate) => Action::SetBitRate(rate),
            lss_slave::Action::Listen(rate) => Action::Listen(rate),
            lss_slave::Action::FilterFrames => return Some(Action::SetReceives),
            _ => return None,
        };
        if is_switching && matches!(action, Action::Drop(_)) {
            // A frame that is on the bus now may finish.
            self.end_sdo();
        } else {
            self.end_sdo_transfer();
            self.frames_dropped();
        }
        Some(action)
    }

    /// Reports a bit rate that the supervision has found, or a return home.
    fn follow_bit_rate(&mut self) {
        let change = self.slave.take_change();
        let bit_rate = self.slave.bit_rate();
        let in_use = bit_rate.in_use();
        match bit_rate.home() {
            Some(home) if home != in_use && change.is_some() => {
                self.emergency.report_fault(Fault::AwayFromHomeRate { in_use, home });
            }
            _ if change.is_some() || bit_rate.is_switching() => {
                self.emergency.end_fault(Fault::AwayFromHomeRate { in_use, home: in_use });
            }
            _ => {}
        }
    }
}
