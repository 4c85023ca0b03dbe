//! The description of a device: identity, names, defaults and options.

use lss_slave::Slave;

use crate::{BitRateSetting, BitRates, Settings, lss};

/// The fixed properties of a device, as opposed to its [`Settings`].
///
/// ```
/// use canopen_node::{BitRate, BitRates, Device, Settings, lss::Address};
///
/// let address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
/// let device = Device::new(address, BitRates::possible(40_000_000))
///     .with_defaults(Settings::new(BitRate::Kbit250.into()))
///     .with_heartbeat_ms(1000)
///     .with_name("Valve")
///     .with_rescue(true);
/// # let _ = device;
/// ```
#[derive(Clone, Copy, Debug)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct Device {
    /// The LSS address, which is also the identity object 1018h.
    pub address: lss::Address,
    /// The bit rates that the CAN controller can produce.
    pub bit_rates: BitRates,
    /// The settings of a device that has stored none.
    pub defaults: Settings,
    /// The producer heartbeat time 1017h of a device that has stored none, in milliseconds; 0 disables the heartbeat.
    pub heartbeat_ms: u16,
    /// Manufacturer device name 1008h.
    pub name: &'static str,
    /// Manufacturer hardware version 1009h.
    pub hardware_version: &'static str,
    /// Manufacturer software version 100Ah.
    pub software_version: &'static str,
    /// Bit-rate supervision: after lasting errors without a valid frame, the node searches for the rate of the other
    /// nodes (see `docs/reference.md`). The feature `rescue`, on by default, has its code.
    pub rescue: bool,
    /// LSS lock: the LSS state stays waiting while the node is NMT operational, so that nobody configures a running
    /// machine.
    pub lss_lock: bool,
}

impl Device {
    /// A device without names and options, which runs at the fastest of `bit_rates` until it has stored settings.
    pub const fn new(address: lss::Address, bit_rates: BitRates) -> Self {
        Self {
            address,
            bit_rates,
            defaults: Settings::new(BitRateSetting::Fixed(bit_rates.fastest())),
            heartbeat_ms: 0,
            name: "",
            hardware_version: "",
            software_version: "",
            rescue: false,
            lss_lock: false,
        }
    }

    /// Replaces the serial number of the [`address`](Self::address).
    #[must_use]
    pub const fn with_serial_number(self, serial_number: u32) -> Self {
        Self { address: lss::Address { serial_number, ..self.address }, ..self }
    }

    /// Replaces the [`defaults`](Self::defaults).
    #[must_use]
    pub const fn with_defaults(self, defaults: Settings) -> Self {
        Self { defaults, ..self }
    }

    /// Replaces the [`heartbeat_ms`](Self::heartbeat_ms).
    #[must_use]
    pub const fn with_heartbeat_ms(self, heartbeat_ms: u16) -> Self {
        Self { heartbeat_ms, ..self }
    }

    /// Replaces the [`bit_rates`](Self::bit_rates).
    #[must_use]
    pub const fn with_bit_rates(self, bit_rates: BitRates) -> Self {
        Self { bit_rates, ..self }
    }

    /// Replaces the [`name`](Self::name).
    #[must_use]
    pub const fn with_name(self, name: &'static str) -> Self {
        Self { name, ..self }
    }

    /// Replaces the [`hardware_version`](Self::hardware_version) and the [`software_version`](Self::software_version).
    #[must_use]
    pub const fn with_versions(self, hardware: &'static str, software: &'static str) -> Self {
        Self { hardware_version: hardware, software_version: software, ..self }
    }

    /// Sets [`rescue`](Self::rescue), which stays false without the feature `rescue`.
    #[must_use]
    pub const fn with_rescue(self, rescue: bool) -> Self {
        Self { rescue: rescue && cfg!(feature = "rescue"), ..self }
    }

    /// The LSS slave with these settings in force.
    pub(crate) const fn slave(&self, settings: Settings) -> Slave {
        let slave = Slave::new(self.address, self.bit_rates, settings);
        #[cfg(feature = "rescue")]
        if self.rescue {
            return slave.with_rescue();
        }
        slave
    }

    /// Sets [`lss_lock`](Self::lss_lock).
    #[must_use]
    pub const fn with_lss_lock(self, lss_lock: bool) -> Self {
        Self { lss_lock, ..self }
    }
}
