//! The transmission of a TPDO: the times at which it is sent (CiA 301, 7.5.2.37).

use core::mem;

use super::Pdo;
use crate::{Application, Frame, Instant};

/// The state of a TPDO.
#[derive(Clone, Copy, Debug)]
pub(super) struct Transmission {
    /// The data last sent.
    sent: [u8; 8],
    /// It is sent at the next opportunity even if the data has not changed.
    is_due: bool,
    /// A SYNC asks for it.
    is_asked_for: bool,
    /// The number of SYNCs since it was last sent; `None` before the SYNC with the start value.
    syncs: Option<u8>,
    /// The end of the inhibit time.
    inhibited_until: Option<Instant>,
    /// The end of the event timer.
    event_at: Option<Instant>,
}

impl Transmission {
    /// A TPDO that is due, as in a node that enters NMT operational.
    pub const NEW: Self = Self {
        sent: [0; 8],
        is_due: true,
        is_asked_for: false,
        syncs: None,
        inhibited_until: None,
        event_at: None,
    };

    /// Counts a SYNC with this counter, if it has one.
    pub fn handle_sync(&mut self, pdo: &Pdo, counter: Option<u8>) {
        // The SYNC with the start value is regarded as the first (CiA 301, 7.5.2.37).
        let is_awaited = self.syncs.is_none() && pdo.sync_start_value != 0;
        if is_awaited && counter.is_some_and(|counter| counter != pdo.sync_start_value) {
            return;
        }
        let syncs = self.syncs.unwrap_or(0).saturating_add(1);
        self.is_asked_for |= syncs >= pdo.transmission_type;
        self.syncs = Some(if syncs >= pdo.transmission_type { 0 } else { syncs });
    }

    /// The frame to send at `now`, if there is one.
    pub fn poll<A: Application>(
        &mut self,
        pdo: &Pdo,
        cob_id: u16,
        application: &A,
        now: Instant,
    ) -> Option<Frame> {
        if pdo.mapping.is_empty() {
            return None;
        }
        let _ = self.inhibited_until.take_if(|until| until.has_come(now));
        self.is_due |= self.event_at.take_if(|at| at.has_come(now)).is_some();
        let is_asked_for = mem::take(&mut self.is_asked_for);
        let data = pdo.mapping.read(application);
        let has_news = self.is_due || data != self.sent;
        let is_sent = match pdo.transmission_type {
            0 => is_asked_for && has_news,
            1..=240 => is_asked_for,
            _ => has_news && self.inhibited_until.is_none(),
        };
        if !is_sent {
            return None;
        }
        self.sent = data;
        self.is_due = false;
        if pdo.transmission_type > 240 {
            let after = |micros: u32| (micros > 0).then(|| now.plus_micros(micros));
            self.inhibited_until = after(u32::from(pdo.inhibit_time) * 100);
            self.event_at = after(u32::from(pdo.event_timer_ms) * 1000);
        }
        Frame::from_padded(cob_id, pdo.mapping.len(), data)
    }

    /// The time at which [`poll`](Self::poll) has something to do, if nothing else happens before.
    pub fn poll_at(&self, pdo: &Pdo) -> Option<Instant> {
        let at = Instant::earliest(self.inhibited_until, self.event_at);
        at.filter(|_| pdo.cob_id.is_valid && !pdo.mapping.is_empty())
    }
}
