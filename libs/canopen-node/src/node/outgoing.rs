//! The service that each frame of the node belongs to, from where it is made until it has left.

/// The service that a frame of the node belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8, align(4))] // So that actions are copied by words.
pub enum Service {
    /// An answer of LSS.
    Lss,
    /// The boot-up.
    BootUp,
    /// An emergency message.
    Emergency,
    /// An answer or a segment of SDO.
    Sdo,
    /// A heartbeat.
    Heartbeat,
    /// A TPDO.
    Tpdo,
    /// A frame of the application.
    Application,
}

/// A set of services.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Services(u8);

impl Services {
    /// No service.
    pub const NONE: Self = Self(0);
    /// All services.
    pub const ALL: Self = Self(u8::MAX);
    /// All but LSS.
    pub const BUT_LSS: Self = Self::ALL.without(Self::of(Service::Lss));

    /// The set of this service alone.
    pub const fn of(service: Service) -> Self {
        Self(1_u8.wrapping_shl(service as u32))
    }

    /// The set of these services.
    pub const fn of_all(services: &[Service]) -> Self {
        let (mut set, mut rest) = (Self::NONE, services);
        while let [service, others @ ..] = rest {
            set = set.and(Self::of(*service));
            rest = others;
        }
        set
    }

    /// The services of both sets.
    #[must_use]
    pub const fn and(self, others: Self) -> Self {
        Self(self.0 | others.0)
    }

    /// The services of this set that are not in the other.
    #[must_use]
    pub const fn without(self, others: Self) -> Self {
        Self(self.0 & !others.0)
    }

    /// Whether the set has this service.
    pub const fn has(self, service: Service) -> bool {
        self.has_any(Self::of(service))
    }

    /// Whether the sets have a service in common.
    pub const fn has_any(self, others: Self) -> bool {
        self.0 & others.0 != 0
    }

    /// Whether the set is empty.
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }
}
