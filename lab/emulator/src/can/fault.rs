//! Fault confinement (ISO 11898-1): the two error counters and the resulting states of a controller.

/// The value of a receive error counter above 127 after a good reception.
const RECEIVE_AFTER_PASSIVE: u16 = 120;
/// The limit of the receive error counter, which keeps it to eight bits.
const RECEIVE_LIMIT: u16 = 255;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ErrorCounters {
    /// Transmit error counter; above 255 means bus-off.
    pub transmit: u16,
    /// Receive error counter, at most 255.
    pub receive: u16,
}

impl ErrorCounters {
    pub const fn warning(self) -> bool {
        self.transmit >= 96 || self.receive >= 96
    }

    /// Whether a counter is above 127: error flags are then recessive.
    pub const fn passive(self) -> bool {
        self.transmit > 127 || self.receive > 127
    }

    /// Whether the transmit error counter is above 255: the controller takes no part in communication.
    pub const fn bus_off(self) -> bool {
        self.transmit > 255
    }

    pub(super) fn raise(&mut self, transmitter: bool, by: u16) {
        if transmitter {
            self.transmit += by;
        } else {
            self.receive = (self.receive + by).min(RECEIVE_LIMIT);
        }
    }

    pub(super) fn transmitted(&mut self) {
        self.transmit = self.transmit.saturating_sub(1);
    }

    pub(super) fn received(&mut self) {
        self.receive = match self.receive {
            0 => 0,
            1..=127 => self.receive - 1,
            _ => RECEIVE_AFTER_PASSIVE,
        };
    }
}
