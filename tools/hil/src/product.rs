//! The product whose boards are tested: this firmware, or another one by its data sheet or its identity.

use std::{fmt, path::Path};

use ::conformance::{eds::Eds, lss::Feature};
use anyhow::{Context, ensure};
use canopen_node::{BitRate, BitRateSetting};
use firmware::device::DEVICE;
use lss_master::Identify;

use crate::conformance::Identity;

/// What is known of the boards before the first request.
pub struct Product {
    /// Who says so, for people.
    pub source: String,
    pub vendor_id: u32,
    pub product_code: u32,
    pub revision_number: Option<u32>,
    /// Object 1000h.
    pub device_type: Option<u32>,
    /// Objects 1008h, 1009h and 100Ah.
    pub texts: [Option<String>; 3],
    /// The bit rates that LSS may select.
    pub rates: Option<Vec<BitRate>>,
    /// The bit rate at which a new board is looked for first.
    pub first_rate: BitRate,
    /// What the product lacks.
    without: Vec<Feature>,
    /// Whether its boards run this firmware, which has all objects that a session looks at.
    pub is_ours: bool,
}

impl Product {
    /// The product of a command line: that of a data sheet, or with an identity, or this firmware.
    ///
    /// # Errors
    /// The data sheet cannot be read or has no identity, or half of an identity is missing.
    pub fn new(eds: Option<&Path>, identity: &Identity) -> anyhow::Result<Self> {
        let without = identity.without.clone();
        match (eds, identity.vendor_id, identity.product_code) {
            (Some(path), ..) => Self::of_data_sheet(path, without),
            (None, Some(vendor_id), Some(product_code)) => {
                let source = "the command line".to_owned();
                Ok(Self { without, ..Self::unknown(source, vendor_id, product_code) })
            }
            (None, vendor_id, product_code) => {
                ensure!(
                    vendor_id.is_none() && product_code.is_none(),
                    "--vendor-id and --product-code belong together"
                );
                Ok(Self::ours(without))
            }
        }
    }

    fn unknown(source: String, vendor_id: u32, product_code: u32) -> Self {
        Self {
            source,
            vendor_id,
            product_code,
            revision_number: None,
            device_type: None,
            texts: [None, None, None],
            rates: None,
            first_rate: BitRate::Kbit125,
            without: Vec::new(),
            is_ours: false,
        }
    }

    fn ours(mut without: Vec<Feature>) -> Self {
        without.extend((!DEVICE.rescue).then_some(Feature::Rescue));
        let address = DEVICE.address;
        let texts = [DEVICE.name, DEVICE.hardware_version, DEVICE.software_version];
        let first_rate = match DEVICE.defaults.bit_rate {
            BitRateSetting::Fixed(rate) => rate,
            BitRateSetting::Automatic => BitRate::Kbit125,
        };
        let offered = |rate: &BitRate| DEVICE.bit_rates.offers((*rate).into());
        Self {
            revision_number: Some(address.revision_number),
            device_type: Some(0),
            texts: texts.map(|text| Some(text.to_owned())),
            rates: Some(BitRate::ALL.into_iter().filter(offered).collect()),
            first_rate,
            without,
            is_ours: true,
            ..Self::unknown(
                "this firmware (src/device.rs)".to_owned(),
                address.vendor_id,
                address.product_code,
            )
        }
    }

    fn of_data_sheet(path: &Path, without: Vec<Feature>) -> anyhow::Result<Self> {
        let name = path.display();
        let eds = Eds::read(path).map_err(anyhow::Error::msg)?;
        let [vendor_id, product_code, revision_number] = eds.identity();
        let number = |key: &str| eds.number("DeviceInfo", key).and_then(|n| u32::try_from(n).ok());
        let missing = |key: &str| format!("{name}: no {key}, neither in [DeviceInfo] nor in 1018h");
        let text = |index| {
            let bytes = eds.get((index, 0))?.default(0)?;
            Some(String::from_utf8_lossy(&bytes).into_owned())
        };
        let offered =
            |rate: &BitRate| number(&format!("BaudRate_{}", rate.kbit_per_s())) == Some(1);
        let device_type = eds.get((0x1000, 0)).and_then(|entry| entry.number_default(0));
        Ok(Self {
            revision_number,
            device_type: device_type.and_then(|number| u32::try_from(number).ok()),
            texts: [0x1008, 0x1009, 0x100A].map(text),
            rates: Some(BitRate::ALL.into_iter().filter(offered).collect()),
            without,
            ..Self::unknown(
                name.to_string(),
                vendor_id.with_context(|| missing("VendorNumber"))?,
                product_code.with_context(|| missing("ProductNumber"))?,
            )
        })
    }

    /// All boards of this product.
    pub fn all(&self) -> Identify {
        Identify::product(self.vendor_id, self.product_code)
    }

    pub fn lacks(&self, feature: Feature) -> bool {
        self.without.contains(&feature)
    }
}

impl fmt::Display for Product {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { source, vendor_id, product_code, .. } = self;
        write!(f, "vendor-ID {vendor_id:08X}, product code {product_code:08X}, by {source}")
    }
}

#[cfg(test)]
mod tests {
    use testkit::cargo::workspace;

    use super::*;

    #[test]
    fn a_mark_before_the_first_section_of_a_data_sheet_hides_nothing() {
        let path = workspace().join("tools/lss/tests/tool/sheets/bom_before_deviceinfo.eds");
        let product = Product::of_data_sheet(&path, Vec::new()).expect("a data sheet");
        assert_eq!((product.vendor_id, product.product_code), (1, 2));
    }
}
