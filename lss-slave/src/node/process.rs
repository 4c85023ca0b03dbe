//! Process data, heartbeat consumer and errors of the application, as parts of the node.

use super::{Action, Due, Node};
use crate::{
    Application, Device, Frame, Instant,
    application::Event,
    object_dictionary::{self, DefaultValue, Description, Entry, Object, TABLE},
    process_data::ProcessData,
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
            self.due = Due::Now;
        }
    }

    /// Ends an error of the application; does nothing if it is not present. A message with error code 0 follows when no
    /// error is left.
    pub fn end_report(&mut self, code: u16) {
        if Self::HAS_APPLICATION {
            self.emergency.errors().end(code);
            self.due = Due::Now;
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
        if !Self::HAS_PROCESS_DATA || self.bit_rate.is_switching() {
            return;
        }
        let Some(node) = self.node_id() else {
            return;
        };
        let mut errors = self.emergency.errors();
        self.product.process_data.handle_frame(
            frame,
            node,
            &mut self.product.application,
            &mut errors,
            now,
        );
        self.due = Due::Now;
    }

    pub(super) fn inform_application(&mut self) {
        if Self::HAS_APPLICATION {
            self.product.inform(self.nmt_state(), self.bit_rate());
        }
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
        if is_any_lost {
            self.lock_lss();
        }
    }

    /// The next frame of process data, or the action for new COB-IDs.
    pub(super) fn next_pdo(&mut self, now: Instant) -> Option<Action> {
        if !Self::HAS_PROCESS_DATA {
            return None;
        }
        if self.product.process_data.take_new_receives() {
            return Some(Action::SetReceives);
        }
        let frame = self.product.process_data.next_frame(
            self.node_id()?,
            &self.product.application,
            now,
        )?;
        Some(Action::Transmit(frame))
    }

    /// The next deadline of process data; `may_send` says whether frames may be sent.
    pub(super) fn process_data_at(&self, may_send: bool) -> Option<Instant> {
        if !Self::HAS_PROCESS_DATA {
            return None;
        }
        let tpdos = self.product.process_data.poll_at().filter(|_| may_send);
        let producers = self.product.process_data.producers_poll_at();
        Instant::earliest(tpdos, producers.filter(|_| !self.bit_rate.is_switching()))
    }
}
