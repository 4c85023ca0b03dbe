//! The services of CiA 305 as the master sends them: one request, or several that have one answer together.

use core::ops::RangeInclusive;

use lss_slave::{
    NodeId,
    lss::{Address, AddressPart, IdentifyKey, Request, Response},
};

use crate::Error;

/// One service: the requests, of which the last may have an answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Service {
    /// A single request.
    Request(Request),
    /// 04 00 and 40..43: brings one slave to LSS configuration state, and all others to LSS waiting state.
    Select(Address),
    /// 46..4B: asks for slaves within ranges.
    Identify(Identify),
}

/// The LSS addresses that identify remote slave asks for (46..4B). Slaves answer in both LSS states, with or without a
/// node-ID, and none changes its state.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identify {
    /// The vendor-ID.
    pub vendor_id: u32,
    /// The product code.
    pub product_code: u32,
    /// The first and the last revision number.
    pub revision_numbers: RangeInclusive<u32>,
    /// The first and the last serial number.
    pub serial_numbers: RangeInclusive<u32>,
}

impl Identify {
    /// All revision and serial numbers of a product.
    pub const fn product(vendor_id: u32, product_code: u32) -> Self {
        Self {
            vendor_id,
            product_code,
            revision_numbers: 0..=u32::MAX,
            serial_numbers: 0..=u32::MAX,
        }
    }

    /// Exactly this address.
    pub const fn address(address: Address) -> Self {
        Self {
            vendor_id: address.vendor_id,
            product_code: address.product_code,
            revision_numbers: address.revision_number..=address.revision_number,
            serial_numbers: address.serial_number..=address.serial_number,
        }
    }
}

impl Service {
    /// The number of requests.
    pub(crate) const fn len(&self) -> u8 {
        match self {
            Self::Request(_) => 1,
            Self::Select(_) => 5,
            Self::Identify(_) => 6,
        }
    }

    /// The request with this number; the last one from there on.
    pub(crate) fn request(&self, number: u8) -> Request {
        use AddressPart as Part;
        use IdentifyKey as Key;
        match self {
            Self::Request(request) => *request,
            Self::Select(address) => match number {
                0 => Request::SwitchToWaiting,
                1 => Request::Select(Part::VendorId, address.vendor_id),
                2 => Request::Select(Part::ProductCode, address.product_code),
                3 => Request::Select(Part::RevisionNumber, address.revision_number),
                _ => Request::Select(Part::SerialNumber, address.serial_number),
            },
            Self::Identify(Identify {
                vendor_id,
                product_code,
                revision_numbers,
                serial_numbers,
            }) => {
                let (key, number) = match number {
                    0 => (Key::VendorId, vendor_id),
                    1 => (Key::ProductCode, product_code),
                    2 => (Key::RevisionNumberLow, revision_numbers.start()),
                    3 => (Key::RevisionNumberHigh, revision_numbers.end()),
                    4 => (Key::SerialNumberLow, serial_numbers.start()),
                    _ => (Key::SerialNumberHigh, serial_numbers.end()),
                };
                Request::Identify(key, *number)
            }
        }
    }

    /// The last request, which has the answer.
    pub(crate) fn last(&self) -> Request {
        self.request(u8::MAX)
    }
}

/// The command specifier of the answer; `None` if there is none, or not to this request alone.
pub(crate) fn answer_specifier(request: Request) -> Option<u8> {
    Some(match request {
        Request::Select(AddressPart::SerialNumber, _) => specifier(Response::Selected),
        Request::Identify(IdentifyKey::SerialNumberHigh, _) | Request::Fastscan(_) => {
            specifier(Response::Identified)
        }
        Request::IdentifyNonConfigured => specifier(Response::NonConfigured),
        Request::ConfigureNodeId(_)
        | Request::ConfigureBitTiming { .. }
        | Request::StoreConfiguration
        | Request::Inquire(_)
        | Request::InquireNodeId => request.to_bytes()[0],
        Request::SwitchToWaiting
        | Request::SwitchToConfiguration
        | Request::ActivateBitTiming(_)
        | Request::Select(..)
        | Request::Identify(..) => return None,
    })
}

const fn specifier(response: Response) -> u8 {
    response.to_bytes()[0]
}

/// The number in the answer to `request`, or 0 if it has none.
pub(crate) fn number(request: Request, answer: [u8; 8]) -> Result<u32, Error> {
    /// The error code of which the meaning is the manufacturer's.
    const MANUFACTURER_SPECIFIC: u8 = 0xFF;
    let [_, b1, b2, b3, b4, ..] = answer;
    match request {
        Request::ConfigureNodeId(_)
        | Request::ConfigureBitTiming { .. }
        | Request::StoreConfiguration
            if b1 != 0 =>
        {
            let manufacturer_code = (b1 == MANUFACTURER_SPECIFIC).then_some(b2);
            Err(Error::Refused { request, code: b1, manufacturer_code })
        }
        Request::InquireNodeId if NodeId::from_lss(b1).is_err() => {
            Err(Error::Unexpected { request, answer })
        }
        Request::InquireNodeId => Ok(b1.into()),
        Request::Inquire(_) => Ok(u32::from_le_bytes([b1, b2, b3, b4])),
        _ => Ok(0),
    }
}
