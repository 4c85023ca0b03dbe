//! The line of the log that says which settings the board starts with.

use canopen_node::{
    BitRateSetting, NodeId, Settings,
    settings::{Error, Found},
};

/// Logs what the start has found in the flash, and the settings in use.
pub fn found(found: Found, settings: &Settings) {
    match found {
        Found::Complete => {}
        Found::Interrupted => {
            defmt::warn!(
                "a store was interrupted or its record is unknown; using the settings before it"
            )
        }
        Found::Blank => defmt::info!("no settings stored yet; using the defaults"),
        Found::OtherData => {
            defmt::info!("other data found, erased; using the defaults")
        }
        Found::Damaged => {
            defmt::error!("the settings in the flash are damaged; using the defaults")
        }
        Found::OtherLayout => {
            defmt::error!("{}", Error::OtherLayout);
        }
        Found::ParametersDamaged => {
            defmt::error!("the parameters in flash are damaged; using their defaults");
        }
        Found::MediumFailed(error) => {
            defmt::error!("the flash failed, a store may fail too: {}", error);
        }
    }
    let node_id = NodeId::to_lss(settings.node_id);
    match settings.bit_rate {
        BitRateSetting::Fixed(rate) => {
            let kbit_per_s = rate.kbit_per_s();
            defmt::info!("node-ID {=u8} (255: none), {=u16} kbit/s", node_id, kbit_per_s);
        }
        BitRateSetting::Automatic => {
            defmt::info!(
                "node-ID {=u8} (255: none), listening until the bit rate is found",
                node_id
            );
        }
    }
}
