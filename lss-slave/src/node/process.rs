//! Process data, heartbeat consumer and errors of the application, as parts of the node.

use super::{
    Action, Node,
    agenda::{Task, Tasks},
    periodic::Sender,
};
use crate::{
    Application, Device, Frame, Instant,
    application::Event,
    emergency, lss, nmt,
    object_dictionary::{self, DefaultValue, Description, Entry, Object, TABLE},
    process_data::ProcessData,
    sdo,
};

impl<A: Application, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    Node<A, TPDOS, RPDOS, PRODUCERS>
{
    /// Whether the node has PDOs or a heartbeat consumer.
    pub const HAS_PROCESS_DATA: bool = ProcessData::<TPDOS, RPDOS, PRODUCERS>::IS_USED;
    /// Whether there is an application, which may have process data and report errors.
    pub(super) const HAS_APPLICATION: bool = !A::OBJECTS.is_empty();

    /// Reports an error of the application by an emergency message (CiA 301, 7.2.7): its error code, bits of the error
    /// register 1001h (bit 0 is added) and the manufacturer's bytes. The error stays in the error register until
    /// [`end_report`](Self::end_report), and in the history 1003h. An error that is reported again is sent again.
    ///
    /// Up to eight errors may be present at a time; a further one only enters the history. The error code 0 has no
    /// effect.
    pub fn report(&mut self, code: u16, register: u8, information: [u8; 5]) {
        if code != 0 && Self::HAS_APPLICATION {
            self.emergency.errors().report(code, register, information);
            self.agenda.add(Tasks::of(&[Task::Messages]));
        }
    }

    /// Ends an error of the application; does nothing if it is not present. A message with error code 0 follows when no
    /// error is left.
    pub fn end_report(&mut self, code: u16) {
        if Self::HAS_APPLICATION {
            self.emergency.errors().end(code);
            self.agenda.add(Tasks::of(&[Task::Messages]));
        }
    }

    /// The objects of the node in no certain order, with their descriptions, for an EDS or a page of documentation. The
    /// image does not contain them.
    pub fn entries(
        device: &Device,
    ) -> impl Iterator<Item = (Entry, Description)> + use<A, TPDOS, RPDOS, PRODUCERS> {
        let own = TABLE.iter().copied().zip(object_dictionary::descriptions(device));
        own.map(|(entry, description)| match entry.object {
            Object::DeviceType => {
                let default = DefaultValue::Number(A::DEVICE_TYPE);
                (entry, Description { default, ..description })
            }
            _ => (entry, description),
        })
        .chain(ProcessData::<TPDOS, RPDOS, PRODUCERS>::entries::<A>())
        .chain(A::OBJECTS.iter().copied().zip(A::descriptions()))
    }

    pub(super) fn handle_process_data(&mut self, frame: &Frame, now: Instant) {
        let is_served = self.node_id().is_some() && !self.bit_rate.is_switching();
        if !Self::HAS_PROCESS_DATA || !is_served {
            return;
        }
        let mut errors = self.emergency.errors();
        self.product.process_data.handle_frame(
            frame,
            &mut self.product.application,
            &mut errors,
            now,
        );
        if PRODUCERS > 0 || !errors.is_empty() {
            self.agenda.add(Tasks::of(&[Task::Producers, Task::Messages]));
        }
        self.note_values();
    }

    /// Records that values of the application may have changed.
    pub(super) const fn note_values(&mut self) {
        if Self::HAS_PROCESS_DATA {
            self.product.process_data.note_values();
            self.agenda.add(Tasks::of(&[Task::Pdos]));
        }
    }

    /// Informs the application and process data of a new NMT state and bit rate.
    pub(super) fn inform(&mut self) -> Option<Action> {
        if !Self::HAS_APPLICATION {
            return None;
        }
        let (state, rate, node) = (self.nmt_state(), self.bit_rate(), self.node_id());
        let has_left_operational = self.product.inform(state, rate, node);
        self.agenda.add(Tasks::of(&[Task::Producers]));
        self.note_values();
        if !has_left_operational || TPDOS == 0 {
            return None;
        }
        self.periodic.note_pdos_dropped();
        Some(Action::DropPdos)
    }

    /// Reports producers whose heartbeat is missing, and ends the errors of process data that are over.
    pub(super) fn watch_producers(&mut self, now: Instant) {
        let mut is_any_lost = false;
        let mut errors = self.emergency.errors();
        while let Some(producer) = self.product.process_data.next_lost(&mut errors, now) {
            self.nmt.handle_communication_error();
            self.product.application.handle(Event::HeartbeatLost(producer));
            is_any_lost = true;
        }
        self.product.process_data.end_errors(&mut errors);
        if !errors.is_empty() {
            self.agenda.add(Tasks::of(&[Task::Messages]));
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
        if product.process_data.take_new_receives() {
            return Some(Action::SetReceives);
        }
        let may_be_timed = periodic.is_free(now);
        let (frame, is_timed) =
            product.process_data.next_frame(&product.application, may_be_timed, now)?;
        if is_timed {
            self.note_periodic(Sender::Tpdo, &frame, now);
        }
        Some(Action::Transmit(frame))
    }

    /// Whether a frame of this COB-ID that the node has sent is a PDO.
    pub fn is_pdo(&self, cob_id: u16) -> bool {
        let services = [emergency::COB_ID, sdo::RESPONSE_COB_ID, nmt::ERROR_CONTROL_COB_ID];
        let is_of =
            |base: u16| self.node_id().is_some_and(|node| cob_id == base + u16::from(node.get()));
        Self::HAS_TPDOS && cob_id != lss::RESPONSE_COB_ID && !services.into_iter().any(is_of)
    }
}
