//! Process data, heartbeat consumer and errors of the application, as parts of the node.

use super::{Action, Node, Service, Task, Tasks, communication::Communication};
use crate::{Application, Frame, Instant, application::Event};

impl<A: Application> Node<A> {
    /// Whether the node has PDOs or a heartbeat consumer.
    const HAS_PROCESS_DATA: bool = Communication::<A::Numbers>::IS_USED;

    pub(super) fn handle_process_data(&mut self, frame: &Frame, now: Instant) {
        let is_served = self.node_id().is_some() && !self.slave.bit_rate().is_switching();
        if !Self::HAS_PROCESS_DATA || !is_served {
            return;
        }
        let Self { product, emergency, .. } = self;
        let application = &mut product.application;
        let has_deadline = product.communication.handle_frame(frame, application, emergency, now);
        if has_deadline || emergency.has_process_data_errors() {
            self.agenda.add(Tasks::of(&[Task::Producers, Task::Messages]));
        }
        self.note_values();
    }

    /// Records that values of the application may have changed.
    pub(super) const fn note_values(&mut self) {
        if Self::HAS_PROCESS_DATA {
            self.product.communication.pdos.note_values();
            self.agenda.add(Tasks::of(&[Task::Pdos]));
        }
    }

    /// Informs the application and process data of a new NMT state and bit rate.
    pub(super) fn inform(&mut self) {
        let (state, rate, node) = (self.nmt_state(), self.bit_rate(), self.node_id());
        self.product.inform(state, rate, node);
        self.agenda.add(Tasks::of(&[Task::Producers]));
        self.note_values();
    }

    /// Reports producers whose heartbeat is missing and RPDOs that are late, and ends the errors of process data that are
    /// over.
    pub(super) fn watch_producers(&mut self, now: Instant) {
        let mut is_any_lost = false;
        let Self { product, emergency, nmt, agenda, .. } = self;
        while let Some(producer) = product.communication.consumer.next_lost(emergency, now) {
            nmt.handle_communication_error();
            product.application.handle(Event::HeartbeatLost(producer));
            is_any_lost = true;
        }
        while let Some(number) = product.communication.pdos.next_late(emergency, now) {
            product.application.handle(Event::Late(number));
            product.communication.pdos.note_values();
            agenda.add(Tasks::of(&[Task::Pdos]));
        }
        if emergency.has_process_data_errors() {
            product.communication.end_errors(emergency);
            agenda.add(Tasks::of(&[Task::Messages]));
        }
        if is_any_lost {
            self.lock_lss();
            self.agenda.add(Tasks::of(&[Task::State, Task::Messages]));
            self.note_values();
        }
    }

    /// The next frame of process data, or the action for new COB-IDs.
    pub(super) fn next_pdo(&mut self, now: Instant) -> Option<Action> {
        if !Self::HAS_PROCESS_DATA {
            return None;
        }
        let Self { product, periodic, .. } = self;
        if product.communication.take_new_receives() {
            return Some(Action::SetReceives);
        }
        let may_be_timed = || periodic.is_free(now);
        let (frame, is_timed) =
            product.communication.pdos.next_frame(&mut product.application, may_be_timed, now)?;
        if is_timed {
            self.note_periodic(Service::Tpdo, &frame, now);
        }
        Some(Action::Transmit(frame, Service::Tpdo))
    }
}
