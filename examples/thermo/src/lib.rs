//! The part of the product that also runs on a computer: its identity, its defaults and its application. The tests take
//! them from here.

#![cfg_attr(not(test), no_std)]

pub mod application;
pub mod device;

use lss_slave::{Device, lss::Address};

/// The description of the device with this serial number, for the node.
pub const fn describe(serial_number: u32) -> Device {
    let address = Address {
        vendor_id: device::VENDOR_ID,
        product_code: device::PRODUCT_CODE,
        revision_number: device::REVISION_NUMBER,
        serial_number,
    };
    Device::new(address, device::BIT_RATES)
        .with_defaults(device::DEFAULTS)
        .with_name(device::NAME)
        .with_versions(device::HARDWARE_VERSION, device::SOFTWARE_VERSION)
        .with_rescue(device::RESCUE)
        .with_lss_lock(device::LSS_LOCK)
}
