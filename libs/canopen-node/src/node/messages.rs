//! NMT, and the messages that the node sends by itself (boot-up, emergency messages and heartbeat), as parts of the node.

use super::{Action, Node, Service, Services, Task, Tasks};
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
        self.reset_parameters();
        self.storing.verification.reset();
        self.frames_dropped();
        self.end_sdo();
        self.agenda.add(Tasks::ALL);
        Action::SetNodeId(self.node_id())
    }

    /// The services for which an acknowledge makes a difference.
    pub(super) const AWAITED: Services = Services::of_all(&[Service::BootUp, Service::Emergency]);

    /// Tells every service that the board has dropped the pending frames.
    pub(super) fn frames_dropped(&mut self) {
        self.emergency.frames_dropped();
        self.nmt.frames_dropped();
        self.product.communication.pdos.frames_dropped();
        self.end_periodic(Services::ALL);
    }

    /// Has the board drop what names another NMT state, or what the present one forbids.
    pub(super) fn drop_stale(&mut self) -> Option<Action> {
        let mut stale = self.nmt.take_stale();
        if stale.has(Service::Emergency) {
            self.emergency.frames_dropped();
        }
        if !self.end_periodic(stale) {
            stale = stale.without(Services::of(Service::Heartbeat));
        }
        (!stale.is_empty()).then_some(Action::Drop(stale))
    }

    /// Ends the wait for a frame of these services; returns whether it is a heartbeat, which is then due again.
    fn end_periodic(&mut self, dropped: Services) -> bool {
        let is_heartbeat = self.periodic.frames_dropped(dropped) == Some(Service::Heartbeat);
        if is_heartbeat {
            self.nmt.request_heartbeat();
        }
        is_heartbeat
    }

    /// Locks or releases LSS after a possible change of the NMT state.
    #[inline(never)] // Inlined, it takes 40 to 84 bytes more.
    pub(super) fn lock_lss(&mut self) {
        let is_operational = self.nmt_state() == nmt::State::Operational;
        self.slave.lss_mut().set_locked(self.product.device.lss_lock && is_operational);
    }

    /// Passes an acknowledge to its services, and to the bit rate.
    #[inline(never)]
    pub(super) fn note_acknowledge(&mut self, sent: Services, now: Instant) {
        if sent.has(Service::BootUp) {
            self.nmt.note_acknowledge();
            self.agenda.add(Tasks::of(&[Task::Messages]));
        }
        if sent.has(Service::Emergency) {
            self.emergency.note_acknowledge();
            self.agenda.add(Tasks::of(&[Task::Messages]));
        }
        if !sent.is_empty() {
            self.inform_bit_rate(BusEvent::Acknowledged, now);
        }
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
                if self.periodic.note_none_pending(now) == Some(Service::Heartbeat) {
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
        if self.nmt.is_boot_up_due() {
            let boot_up = self.nmt.next_boot_up(node, now);
            self.agenda.add(Tasks::of(&[Task::State, Task::Sdo]));
            return Some(Action::Transmit(boot_up, Service::BootUp));
        }
        let is_guest = self.slave.bit_rate().is_guest();
        let allowed = self.nmt.emergencies();
        if let Some(emergency) = self.emergency.next(node, is_guest, allowed, now) {
            return Some(Action::Transmit(emergency, Service::Emergency));
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
        self.note_periodic(Service::Heartbeat, &heartbeat, now);
        Some(Action::Transmit(heartbeat, Service::Heartbeat))
    }

    /// Records a frame of a periodic service, for which the others wait.
    pub(super) fn note_periodic(&mut self, service: Service, frame: &Frame, now: Instant) {
        self.periodic.note_sent(service, frame.longest_micros(self.bit_rate()), now);
        self.agenda.add(Tasks::of(&[Task::Messages, Task::Pdos]));
    }
}
