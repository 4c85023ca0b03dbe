//! The transmission of a TPDO: the times at which it is sent (CiA 301, 7.5.2.37).

use super::Pdo;
use crate::{Application, Deadline, Frame, Instant};

/// The state of a TPDO in NMT operational.
#[derive(Clone, Copy, Debug)]
pub(super) struct Transmission {
    cob_id: u16,
    /// The data last sent.
    sent: [u8; 8],
    /// The bits of the data whose change sends it.
    heeded: [u8; 8],
    /// It is sent at the next opportunity even if the data has not changed.
    is_due: bool,
    /// The number of SYNCs since it was last sent; `None` before the SYNC with the start value.
    syncs: Option<u8>,
    /// The end of the inhibit time.
    inhibited_until: Option<Deadline>,
    /// The end of the event timer.
    event_at: Option<Deadline>,
}

impl Transmission {
    /// A TPDO that is not in use.
    pub const UNUSED: Self = Self {
        cob_id: 0,
        sent: [0; 8],
        heeded: [0; 8],
        is_due: true,
        syncs: None,
        inhibited_until: None,
        event_at: None,
    };

    /// A TPDO that is due, as in a node that enters NMT operational.
    const fn new(cob_id: u16, heeded: [u8; 8]) -> Self {
        Self { cob_id, heeded, ..Self::UNUSED }
    }

    /// The same with other parameters. The inhibit time goes on.
    pub fn renewed(&self, cob_id: u16, pdo: &Pdo) -> Self {
        // Else a master that writes the parameters again could make it send too often.
        let inhibited_until = self.inhibited_until;
        Self { inhibited_until, ..Self::new(cob_id, pdo.mapping.heeded().to_le_bytes()) }
    }

    /// Makes it due.
    pub fn restart(&mut self) {
        *self = Self::new(self.cob_id, self.heeded);
    }

    /// Makes it due without a change.
    pub const fn request(&mut self) {
        self.is_due = true;
    }

    /// Ends the inhibit time.
    pub const fn end_inhibit_time(&mut self) {
        self.inhibited_until = None;
    }

    /// Counts a SYNC with this counter, if it has one; returns whether it asks for the TPDO.
    pub fn handle_sync(&mut self, pdo: &Pdo, counter: Option<u8>) -> bool {
        // The SYNC with the start value is regarded as the first (CiA 301, 7.5.2.37).
        let is_awaited = self.syncs.is_none() && pdo.sync_start_value != 0;
        if is_awaited && counter.is_some_and(|counter| counter != pdo.sync_start_value) {
            return false;
        }
        let syncs = self.syncs.unwrap_or(0).saturating_add(1);
        let is_asked_for = syncs >= pdo.transmission_type;
        self.syncs = Some(if is_asked_for { 0 } else { syncs });
        is_asked_for
    }

    /// Ends the inhibit time if it is over; returns whether it is.
    pub fn ends_inhibit_time(&mut self, now: Instant) -> bool {
        self.inhibited_until.take_if(|until| until.is_over(now)).is_some()
    }

    /// The end of the event timer, if it is over and the TPDO may be sent.
    pub fn is_timed_out(&self, now: Instant) -> Option<Instant> {
        // An event timer that ends within the inhibit time waits for the end of that.
        let event_at = self.event_at.filter(|_| self.inhibited_until.is_none())?;
        event_at.is_over(now).then_some(event_at.end())
    }

    /// The frame that a SYNC has asked for. Type 0 has none without a change.
    pub fn answer_sync<A: Application>(&mut self, pdo: &Pdo, application: &mut A) -> Option<Frame> {
        let data = pdo.mapping.read(application);
        let is_sent = pdo.transmission_type != 0 || self.has_changed(data);
        is_sent.then(|| self.send(pdo, data))
    }

    /// The frame of an event-driven TPDO that has changed or whose event timer `is_timed_out`; whether only the latter.
    pub fn poll<A: Application>(
        &mut self,
        pdo: &Pdo,
        application: &mut A,
        is_timed_out: bool,
        now: Instant,
    ) -> Option<(Frame, bool)> {
        if self.inhibited_until.is_some() {
            return None;
        }
        let data = pdo.mapping.read(application);
        let has_changed = self.has_changed(data);
        if !has_changed && !is_timed_out {
            return None;
        }
        self.inhibited_until = Deadline::after(now, u32::from(pdo.inhibit_time) * 100);
        self.event_at = Deadline::after(now, pdo.event_timer_micros());
        Some((self.send(pdo, data), !has_changed))
    }

    const fn has_changed(&self, data: u64) -> bool {
        let [sent, heeded] = [u64::from_le_bytes(self.sent), u64::from_le_bytes(self.heeded)];
        self.is_due || (data ^ sent) & heeded != 0
    }

    const fn send(&mut self, pdo: &Pdo, data: u64) -> Frame {
        (self.sent, self.is_due) = (data.to_le_bytes(), false);
        Frame::with_bytes(self.cob_id, pdo.mapping.len(), self.sent)
    }

    /// The end of the inhibit time.
    pub fn inhibited_until(&self) -> Option<Instant> {
        self.inhibited_until.map(Deadline::end)
    }

    /// The end of the event timer.
    pub fn event_at(&self) -> Option<Instant> {
        self.event_at.map(Deadline::end)
    }
}
