//! The device: what a product edits.

use canopen_node::{BitRate, BitRateSetting, BitRates, Device, Settings, lss::Address};

use crate::chip::CAN_HZ;

/// The device, but for its serial number.
pub const DEVICE: Device = Device::new(
    Address {
        vendor_id: 0x0000_0000,
        product_code: 0x4C53_5334,
        revision_number: 0x0001_0000,
        serial_number: 0,
    },
    BitRates::possible(CAN_HZ).with_automatic(),
)
.with_defaults(DEFAULTS)
.with_heartbeat_ms(1000)
.with_name("LSS slave")
.with_versions("1.0", env!("CARGO_PKG_VERSION"))
.with_rescue(true);

/// The settings of a new device, which has no node-ID.
pub const DEFAULTS: Settings = Settings::new(BitRateSetting::Fixed(BitRate::Kbit125));
