//! The identity, the defaults and the crystal of the thermometer.

use canopen_stm32f4::chip::APB1_HZ;
use lss_slave::{BitRate, BitRateSetting, BitRates, Settings};

/// Your company's name. Only the EDS contains it.
pub const VENDOR_NAME: &str = "Not registered";
/// The product in one line. Only the EDS contains it.
pub const DESCRIPTION: &str = "Four temperatures and two relays on an STM32F446";
/// Your company's vendor-ID, from CiA.
pub const VENDOR_ID: u32 = 0x0000_0000;
/// Your number for this product.
pub const PRODUCT_CODE: u32 = 0x5448_3446;
/// Major revision (changes in the behaviour on the bus) in the upper 16 bits, minor in the lower.
pub const REVISION_NUMBER: u32 = 0x0001_0000;
/// Manufacturer device name, object 1008h.
pub const NAME: &str = "Thermometer";
/// Manufacturer hardware version, object 1009h.
pub const HARDWARE_VERSION: &str = "1.0";
/// Manufacturer software version, object 100Ah.
pub const SOFTWARE_VERSION: &str = env!("CARGO_PKG_VERSION");
// The serial number comes from the chip's unique id, see `board::serial_number`.

/// The settings of a new device, until an LSS master stores others.
pub const DEFAULTS: Settings = Settings::new(BitRateSetting::Fixed(BitRate::Kbit125))
    // That of the switches, if one is closed.
    .with_node_id(None)
    // Milliseconds between heartbeats; 0 disables the heartbeat.
    .with_heartbeat_ms(1000);

/// The crystal (HSE) in Hz: a whole number of MHz from 4 to 26. There is no operation without one
/// (docs/bit-rates.md).
pub const CRYSTAL_HZ: u32 = 12_000_000;
/// Whether the clock is external (a Nucleo's ST-LINK, an oscillator) instead of a crystal.
pub const CRYSTAL_IS_EXTERNAL_CLOCK: bool = false;

/// The bit rates that LSS may select. Without `with_automatic()`, index 9 (automatic detection) is rejected.
pub const BIT_RATES: BitRates = BitRates::possible(APB1_HZ).with_automatic();

/// Bit-rate supervision: a device whose rate no frame has proven since power-on searches for the rate of the others
/// after an error. A proven rate is never left: docs/bit-rates.md.
pub const RESCUE: bool = true;

/// LSS lock, which refuses LSS configuration while the node is NMT operational: docs/threat-model.md.
pub const LSS_LOCK: bool = false;

const _: () =
    assert!(BIT_RATES.offers(DEFAULTS.bit_rate), "BIT_RATES does not offer DEFAULTS.bit_rate");
