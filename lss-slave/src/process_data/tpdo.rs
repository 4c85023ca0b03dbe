//! A TPDO: its parameters (CiA 301, 7.5.2.37) and the times at which it is sent.

use core::mem;

use super::{Direction, Mapping, PdoCobId, Tpdo};
use crate::{Application, Frame, Instant, NodeId, object_dictionary::Entry, sdo::Abort};

/// The parameters that are stored before the mapping.
pub(super) const TRANSMIT_PARAMETERS: usize = 5;

/// A TPDO.
#[derive(Clone, Copy, Debug)]
pub(super) struct TransmitPdo {
    pub cob_id: PdoCobId,
    pub mapping: Mapping,
    transmission_type: u8,
    /// In multiples of 100 us.
    inhibit_time: u16,
    event_timer_ms: u16,
    sync_start_value: u8,
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

/// Whether CiA 301 defines a transmission type that does not depend on remote frames.
pub(super) const fn is_transmission_type(transmission_type: u8) -> bool {
    matches!(transmission_type, 0..=240 | 254 | 255)
}

/// A stored transmission type, if it is legal.
pub(super) fn stored_transmission_type(stored: u32) -> Option<u8> {
    let transmission_type = stored.try_into().ok()?;
    is_transmission_type(transmission_type).then_some(transmission_type)
}

impl TransmitPdo {
    pub const UNUSED: Self = Self {
        cob_id: PdoCobId::new(false),
        mapping: Mapping::EMPTY,
        transmission_type: 255,
        inhibit_time: 0,
        event_timer_ms: 0,
        sync_start_value: 0,
        sent: [0; 8],
        is_due: true,
        is_asked_for: false,
        syncs: None,
        inhibited_until: None,
        event_at: None,
    };

    /// The TPDO of a declaration; panics, at compile time, with what is wrong.
    pub const fn declared(declaration: &Tpdo, objects: &[Entry]) -> Self {
        let Tpdo { mapping, is_valid, .. } = *declaration;
        assert!(
            is_transmission_type(declaration.transmission_type),
            "the transmission type of a PDO must be 0 to 240, 254 or 255"
        );
        assert!(declaration.sync_start_value <= 240, "a SYNC start value must be 0 to 240");
        Self {
            cob_id: PdoCobId::new(is_valid),
            mapping: Mapping::declared(objects, Direction::Transmit, mapping),
            transmission_type: declaration.transmission_type,
            inhibit_time: declaration.inhibit_time,
            event_timer_ms: declaration.event_timer_ms,
            sync_start_value: declaration.sync_start_value,
            ..Self::UNUSED
        }
    }

    /// Makes it due, as in a node that enters NMT operational.
    pub const fn restart(&mut self) {
        self.is_due = true;
        self.is_asked_for = false;
        self.syncs = None;
        self.inhibited_until = None;
        self.event_at = None;
    }

    const fn is_event_driven(&self) -> bool {
        self.transmission_type >= 254
    }

    /// Counts a SYNC with this counter, if it has one.
    pub fn handle_sync(&mut self, counter: Option<u8>) {
        // The SYNC with the start value is regarded as the first (CiA 301, 7.5.2.37).
        let is_awaited = self.syncs.is_none() && self.sync_start_value != 0;
        if is_awaited && counter.is_some_and(|counter| counter != self.sync_start_value) {
            return;
        }
        let syncs = self.syncs.unwrap_or(0).saturating_add(1);
        self.is_asked_for |= syncs >= self.transmission_type;
        self.syncs = Some(if syncs >= self.transmission_type { 0 } else { syncs });
    }

    /// The frame to send at `now`, if there is one.
    pub fn poll<A: Application>(
        &mut self,
        cob_id: u16,
        application: &A,
        now: Instant,
    ) -> Option<Frame> {
        if self.mapping.is_empty() {
            return None;
        }
        let _ = self.inhibited_until.take_if(|until| until.has_come(now));
        self.is_due |= self.event_at.take_if(|at| at.has_come(now)).is_some();
        let is_asked_for = mem::take(&mut self.is_asked_for);
        let data = self.mapping.read(application);
        let has_news = self.is_due || data != self.sent;
        let is_sent = match self.transmission_type {
            0 => is_asked_for && has_news,
            1..=240 => is_asked_for,
            _ => has_news && self.inhibited_until.is_none(),
        };
        if !is_sent {
            return None;
        }
        self.sent = data;
        self.is_due = false;
        if self.is_event_driven() {
            let inhibit_micros = u32::from(self.inhibit_time) * 100;
            let event_micros = u32::from(self.event_timer_ms) * 1000;
            self.inhibited_until = (inhibit_micros > 0).then(|| now.plus_micros(inhibit_micros));
            self.event_at = (event_micros > 0).then(|| now.plus_micros(event_micros));
        }
        Frame::from_padded(cob_id, self.mapping.len(), data)
    }

    /// The time at which [`poll`](Self::poll) has something to do, if nothing else happens before.
    pub fn poll_at(&self) -> Option<Instant> {
        let at = Instant::earliest(self.inhibited_until, self.event_at);
        at.filter(|_| self.cob_id.is_valid && !self.mapping.is_empty())
    }

    /// The parameters as they are stored.
    pub fn stored(&self) -> impl Iterator<Item = u32> + Clone {
        let parameters = [
            self.cob_id.stored(),
            self.transmission_type.into(),
            self.inhibit_time.into(),
            self.event_timer_ms.into(),
            self.sync_start_value.into(),
        ];
        parameters.into_iter().chain(self.mapping.stored())
    }

    /// The TPDO with these stored parameters, if they are legal and all its values exist.
    pub fn from_stored(stored: &[[u8; 4]], objects: &[Entry]) -> Option<Self> {
        let (parameters, mapping) = stored.split_first_chunk::<TRANSMIT_PARAMETERS>()?;
        let [cob_id, transmission_type, inhibit_time, event_timer_ms, sync_start_value] =
            parameters.map(u32::from_le_bytes);
        Some(Self {
            cob_id: PdoCobId::from_stored(cob_id)?,
            mapping: Mapping::from_stored(mapping, Direction::Transmit, objects)?,
            transmission_type: stored_transmission_type(transmission_type)?,
            inhibit_time: inhibit_time.try_into().ok()?,
            event_timer_ms: event_timer_ms.try_into().ok()?,
            sync_start_value: sync_start_value.try_into().ok().filter(|value| *value <= 240)?,
            ..Self::UNUSED
        })
    }

    /// The value of a sub-index of the communication parameter.
    pub fn parameter(&self, sub_index: u8, base: u16, node: Option<NodeId>) -> u32 {
        match sub_index {
            1 => self.cob_id.transmit_value(base, node),
            2 => self.transmission_type.into(),
            3 => self.inhibit_time.into(),
            5 => self.event_timer_ms.into(),
            _ => self.sync_start_value.into(),
        }
    }

    /// Sets a sub-index of the communication parameter. The PDO is due then, and its times begin again.
    ///
    /// # Errors
    /// [`Abort::InvalidValue`], or [`Abort::DeviceState`] for what a valid PDO does not allow.
    pub fn set_parameter(
        &mut self,
        sub_index: u8,
        value: u32,
        base: u16,
        node: Option<NodeId>,
    ) -> Result<(), Abort> {
        match sub_index {
            1 => self.cob_id.set(value, base, node)?,
            2 if !is_transmission_type(value as u8) => return Err(Abort::InvalidValue),
            2 => self.transmission_type = value as u8,
            5 => self.event_timer_ms = value as u16,
            _ if self.cob_id.is_valid => return Err(Abort::DeviceState),
            3 => self.inhibit_time = value as u16,
            _ if value > 240 => return Err(Abort::InvalidValue),
            _ => self.sync_start_value = value as u8,
        }
        self.restart();
        Ok(())
    }
}
