//! The description of a device: identity, names, and what it offers.

use crate::{BitRates, lss};

/// What the device is, as opposed to how it is set.
#[derive(Clone, Copy, Debug)]
pub struct Device {
    /// The LSS address, which is the identity object 1018h.
    pub address: lss::Address,
    /// The bit rates that the CAN controller can produce.
    pub bit_rates: BitRates,
    /// The producer heartbeat time 1017h, in milliseconds, that 1011h restores.
    pub heartbeat_ms: u16,
    /// Manufacturer device name 1008h.
    pub name: &'static str,
    /// Manufacturer hardware version 1009h.
    pub hardware_version: &'static str,
    /// Manufacturer software version 100Ah.
    pub software_version: &'static str,
    /// Whether the bit rate is supervised: lasting errors without a valid frame make the node look for the rate of the others
    /// (see `docs/bit-rates.md`).
    pub rescue: bool,
    /// Whether the LSS state stays waiting while the node is NMT operational, so that nobody configures a running machine.
    pub lss_lock: bool,
}
