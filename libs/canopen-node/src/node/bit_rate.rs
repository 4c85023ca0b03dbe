//! Switch and supervision of the bit rate, as parts of the node.

use super::{Action, Node, Task, Tasks};
use crate::{
    Application, Instant,
    bit_rate::{self, Step},
    emergency::Fault,
};

impl<A: Application> Node<A> {
    /// The next step of a switch or of the supervision. Without one, lets those tasks wait that a later one allows.
    pub(super) fn next_step(&mut self, now: Instant) -> Option<Action> {
        use bit_rate::Next::*;
        loop {
            let next = self.bit_rate.poll(self.lss.state(), now);
            self.follow_bit_rate();
            // The NMT state is known.
            let _ = self.inform();
            match next {
                Some(StopTransmitting) => return Some(Action::StopTransmitting),
                Some(Activate { silent_until }) => self.activate_bit_rate(silent_until),
                Some(EndSwitch) => {
                    // By now the frame has left that was on the bus when the others were dropped.
                    self.note_dropped();
                    self.nmt.restart_heartbeat(now);
                    self.product.communication.restart(now);
                }
                Some(Step(step)) => return Some(self.take_step(step)),
                Some(ResumeTransmitting) => {
                    self.nmt.note_resumed();
                    self.product.communication.pdos.note_resumed();
                    return Some(Action::ResumeTransmitting);
                }
                Some(KeepSilent) => {
                    self.agenda.hold(Tasks::AFTER_SWITCH);
                    return None;
                }
                Some(Settled) => return Some(Action::SetReceives),
                None => break,
            }
        }
        self.agenda.hold(match self.bit_rate.may_send() {
            true if self.bit_rate.is_guest() => Tasks::of(&[Task::Pdos]),
            true => Tasks::NONE,
            false => Tasks::SENDING,
        });
        None
    }

    fn activate_bit_rate(&mut self, silent_until: Instant) {
        let setting = self.lss.activate_bit_rate(self.bit_rate.active());
        self.bit_rate.activate(setting, silent_until);
        let rate = self.bit_rate();
        self.emergency.end_fault(Fault::AwayFromHomeRate { in_use: rate, home: rate });
    }

    /// Reports a bit rate that the supervision has found, or a return home.
    fn follow_bit_rate(&mut self) {
        let Some(in_use) = self.bit_rate.take_change() else {
            return;
        };
        match self.bit_rate.home() {
            Some(home) if home != in_use => {
                self.emergency.report_fault(Fault::AwayFromHomeRate { in_use, home });
            }
            _ => self.emergency.end_fault(Fault::AwayFromHomeRate { in_use, home: in_use }),
        }
    }

    /// Carries out a step of the supervision, which drops the pending frames.
    fn take_step(&mut self, step: Step) -> Action {
        self.end_sdo_transfer();
        self.note_dropped();
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
}
