//! The LSS address: the four numbers of the identity object 1018h that identify a slave.

use core::fmt;

/// A slave's LSS address, which is its identity object 1018h (CiA 301).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Address {
    /// The vendor-ID, assigned by CiA.
    pub vendor_id: u32,
    /// The vendor's number for the product.
    pub product_code: u32,
    /// The major revision in the upper and the minor revision in the lower 16 bits.
    pub revision_number: u32,
    /// A number that differs between devices with equal other parts.
    pub serial_number: u32,
}

/// One of the four numbers of an [`Address`], in the order of LSS.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
#[expect(missing_docs, reason = "the names say it")]
pub enum AddressPart {
    VendorId = 0,
    ProductCode = 1,
    RevisionNumber = 2,
    SerialNumber = 3,
}

/// The name: `vendor-ID`.
impl fmt::Display for AddressPart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::VendorId => "vendor-ID",
            Self::ProductCode => "product code",
            Self::RevisionNumber => "revision number",
            Self::SerialNumber => "serial number",
        })
    }
}

impl AddressPart {
    /// The part with the number 0..=3, as Fastscan's LSSSub selects it.
    pub const fn new(number: u8) -> Option<Self> {
        match number {
            0 => Some(Self::VendorId),
            1 => Some(Self::ProductCode),
            2 => Some(Self::RevisionNumber),
            3 => Some(Self::SerialNumber),
            _ => None,
        }
    }

    /// The part after this one; the vendor-ID after the last.
    pub(super) fn next(self) -> Self {
        Self::new(self as u8 + 1).unwrap_or(Self::VendorId)
    }
}

/// The four numbers in hexadecimal: `00000000:4C535334:00010000:515884C7`.
impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [vendor_id, product_code, revision_number, serial_number] = (*self).into();
        write!(f, "{vendor_id:08X}:{product_code:08X}:{revision_number:08X}:{serial_number:08X}")
    }
}

/// Vendor-ID, product code, revision number and serial number.
impl From<[u32; 4]> for Address {
    fn from([vendor_id, product_code, revision_number, serial_number]: [u32; 4]) -> Self {
        Self { vendor_id, product_code, revision_number, serial_number }
    }
}

/// Vendor-ID, product code, revision number and serial number.
impl From<Address> for [u32; 4] {
    fn from(address: Address) -> Self {
        let Address { vendor_id, product_code, revision_number, serial_number } = address;
        [vendor_id, product_code, revision_number, serial_number]
    }
}

impl Address {
    /// The four numbers in their order, each from its lowest byte on.
    pub const fn to_le_bytes(self) -> [u8; 16] {
        let Self { vendor_id, product_code, revision_number, serial_number } = self;
        let all = vendor_id as u128
            | (product_code as u128) << 32
            | (revision_number as u128) << 64
            | (serial_number as u128) << 96;
        all.to_le_bytes()
    }

    /// The LSS address in bytes as [`to_le_bytes`](Self::to_le_bytes) makes them.
    pub const fn from_le_bytes(bytes: [u8; 16]) -> Self {
        let all = u128::from_le_bytes(bytes);
        Self {
            vendor_id: all as u32,
            product_code: (all >> 32) as u32,
            revision_number: (all >> 64) as u32,
            serial_number: (all >> 96) as u32,
        }
    }

    /// Derives a serial number from the chip's unique id, for a device without one of its own. FNV-1a spreads ids that
    /// differ in a few bits over all 32-bit numbers. Two of 1000 devices have equal numbers with a probability of 1 in
    /// 8600.
    pub const fn serial_number_of(unique_id: &[u8]) -> u32 {
        let mut hash = 0x811C_9DC5_u32;
        let mut rest = unique_id;
        while let [byte, tail @ ..] = rest {
            hash = (hash ^ *byte as u32).wrapping_mul(0x0100_0193);
            rest = tail;
        }
        hash
    }
}
