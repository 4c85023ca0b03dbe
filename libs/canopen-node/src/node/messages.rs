//! NMT, and the messages that the node sends by itself (boot-up, emergency messages and heartbeat), as parts of the node.

use super::{Action, Node, Task, Tasks, periodic::Sender};
use crate::{
    Application, BusEvent, Frame, Instant,
    emergency::{ErrorCounters, Fault},
    nmt::{self, Command},
};

impl<A: Application> Node<A> {
    pub(super) fn carry_out(&mut self, command: Command) -> Option<Action> {
        let state = match command {
            Command::ResetNode => return Some(Action::ResetDevice),
            Command::ResetCommunication => return Some(self.reset_communication()),
            Command::Start if !A::MAY_OPERATE => return None,
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
        self.slave.reset_communication();
        self.nmt.reset_communication();
        let communication = &mut self.product.communication;
        self.nmt.configure(communication.heartbeat_ms(), communication.error_behaviour());
        self.emergency.configure(communication.emergency());
        communication.reset();
        self.storing.verification.reset();
        self.note_dropped();
        self.end_sdo();
        self.agenda.add(Tasks::ALL);
        Action::SetNodeId(self.node_id())
    }

    /// Records that the board has dropped the pending frames.
    pub(super) fn note_dropped(&mut self) {
        self.emergency.note_dropped();
        self.nmt.note_dropped();
        self.periodic.note_dropped();
    }

    /// Locks or releases LSS after a possible change of the NMT state.
    #[inline(never)] // Inlined, it takes 40 to 84 bytes more.
    pub(super) fn lock_lss(&mut self) {
        let is_operational = self.nmt_state() == nmt::State::Operational;
        self.slave.lss_mut().set_locked(self.product.device.lss_lock && is_operational);
    }

    pub(super) fn awaits_acknowledge(&self) -> bool {
        self.nmt.awaits_acknowledge() || self.emergency.awaits_acknowledge()
    }

    /// Handles an event for all but the bit rate.
    pub(super) fn handle_event(&mut self, event: BusEvent, now: Instant) {
        let tasks: &[Task] = match event {
            BusEvent::ErrorCounters { transmit, receive } => {
                let counters = ErrorCounters { transmit, receive };
                self.emergency
                    .handle_error_counters(counters, self.slave.bit_rate().is_listening());
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
                self.emergency.report_fault(Fault::Overrun);
                &[Task::Messages]
            }
            BusEvent::BusOffRecovered => {
                self.emergency.report_fault(Fault::BusOffRecovered);
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
            // They concern only the bit rate.
            _ => &[],
        };
        self.agenda.add(Tasks::of(tasks));
    }

    /// Returns the next boot-up, emergency message or heartbeat.
    pub(super) fn next_message(&mut self, now: Instant) -> Option<Action> {
        self.emergency.end_inhibit_time(now);
        let node = self.node_id().filter(|_| self.slave.bit_rate().may_report())?;
        if let Some(boot_up) = self.nmt.next_boot_up(node, now) {
            self.agenda.add(Tasks::of(&[Task::State, Task::Sdo]));
            return Some(Action::Transmit(boot_up));
        }
        let is_guest = self.slave.bit_rate().is_guest();
        if self.nmt.allows_emergencies()
            && let Some(emergency) = self.emergency.next(node, is_guest, now)
        {
            return Some(Action::Transmit(emergency));
        }
        if is_guest {
            return None;
        }
        let due_since = self.nmt.heartbeat_due_since(now)?;
        let tpdo = self.product.communication.pdos.first_timed_out(now);
        if !self.periodic.is_free(now) || tpdo.is_some_and(|(_, end)| !due_since.has_come(end)) {
            return None;
        }
        let heartbeat = self.nmt.next_heartbeat(node, now);
        self.note_periodic(Sender::Heartbeat, &heartbeat, now);
        Some(Action::Transmit(heartbeat))
    }

    /// Records a frame of a periodic service, for which the others wait.
    pub(super) fn note_periodic(&mut self, sender: Sender, frame: &Frame, now: Instant) {
        self.periodic.note_sent(sender, frame.longest_micros(self.bit_rate()), now);
        self.agenda.add(Tasks::of(&[Task::Messages, Task::Pdos]));
    }
}
