//! The declaration of a product's PDOs: their parameters and their mapping in a new device.

/// A TPDO as a new device has it: the mapped values of the application, and when they are sent.
///
/// ```
/// use canopen_node::pdo::Tpdo;
///
/// const INPUTS: Tpdo = Tpdo::new(&[(0x6000, 1), (0x6000, 2)]).with_inhibit_time(100).with_event_timer(1000);
/// # let _ = INPUTS;
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Tpdo {
    /// The mapped values, by index and sub-index.
    pub mapping: &'static [(u16, u8)],
    /// Whether the PDO exists before a master has set its valid bit.
    pub is_valid: bool,
    /// The transmission type: 0, 1 to 240, 254 or 255.
    pub transmission_type: u8,
    /// The inhibit time in multiples of 100 us.
    pub inhibit_time: u16,
    /// The event timer in milliseconds; 0 disables it.
    pub event_timer_ms: u16,
    /// The SYNC start value; 0 disables it.
    pub sync_start_value: u8,
}

impl Tpdo {
    /// A TPDO that carries nothing before a master maps values and sets its valid bit.
    pub const UNUSED: Self = Self::new(&[]).invalid();

    /// A valid TPDO with these values, which is sent when one of them changes (transmission type 255).
    pub const fn new(mapping: &'static [(u16, u8)]) -> Self {
        Self {
            mapping,
            is_valid: true,
            transmission_type: 255,
            inhibit_time: 0,
            event_timer_ms: 0,
            sync_start_value: 0,
        }
    }

    /// A TPDO that does not exist before a master has set its valid bit. Those from the fifth on must be so: a new device
    /// has no COB-ID for them.
    #[must_use]
    pub const fn invalid(self) -> Self {
        Self { is_valid: false, ..self }
    }

    /// Replaces the [`transmission_type`](Self::transmission_type).
    #[must_use]
    pub const fn with_transmission_type(self, transmission_type: u8) -> Self {
        Self { transmission_type, ..self }
    }

    /// Replaces the [`inhibit_time`](Self::inhibit_time), in multiples of 100 us.
    #[must_use]
    pub const fn with_inhibit_time(self, inhibit_time: u16) -> Self {
        Self { inhibit_time, ..self }
    }

    /// Replaces the event timer, in milliseconds.
    #[must_use]
    pub const fn with_event_timer(self, event_timer_ms: u16) -> Self {
        Self { event_timer_ms, ..self }
    }

    /// Replaces the [`sync_start_value`](Self::sync_start_value).
    #[must_use]
    pub const fn with_sync_start_value(self, sync_start_value: u8) -> Self {
        Self { sync_start_value, ..self }
    }
}

/// An RPDO as a new device has it: the mapped values of the application, and when they take effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Rpdo {
    /// The mapped values, by index and sub-index. Index 1 to 7 with sub-index 0 leaves out the bytes of that data type.
    pub mapping: &'static [(u16, u8)],
    /// Whether the PDO exists before a master has set its valid bit.
    pub is_valid: bool,
    /// The transmission type: 0 to 240, 254 or 255.
    pub transmission_type: u8,
    /// The time in milliseconds within which the next frame must come (deadline monitoring); 0 disables it.
    pub event_timer_ms: u16,
}

impl Rpdo {
    /// An RPDO that carries nothing before a master maps values and sets its valid bit.
    pub const UNUSED: Self = Self::new(&[]).invalid();

    /// A valid RPDO with these values, which take effect at once (transmission type 255).
    pub const fn new(mapping: &'static [(u16, u8)]) -> Self {
        Self { mapping, is_valid: true, transmission_type: 255, event_timer_ms: 0 }
    }

    /// An RPDO that does not exist before a master has set its valid bit. Those from the fifth on must be so: a new device
    /// has no COB-ID for them.
    #[must_use]
    pub const fn invalid(self) -> Self {
        Self { is_valid: false, ..self }
    }

    /// Replaces the [`transmission_type`](Self::transmission_type).
    #[must_use]
    pub const fn with_transmission_type(self, transmission_type: u8) -> Self {
        Self { transmission_type, ..self }
    }

    /// Replaces the event timer, in milliseconds: after a frame the next one must come within this time, or error 8250h is
    /// reported.
    #[must_use]
    pub const fn with_event_timer(self, event_timer_ms: u16) -> Self {
        Self { event_timer_ms, ..self }
    }
}
