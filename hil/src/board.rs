//! The boards on the bus: how they are found without a change to any, addressed, and left as they were.

use std::{fmt, ops::RangeInclusive};

use firmware::device;
use lss_slave::{
    BitRate, BitRateSetting, NodeId,
    lss::{Address, AddressPart, IdentifyKey, Request},
};

use crate::{bus::Bus, stop::Stop};

/// A board, and what it had stored before the sessions.
#[derive(Clone, Copy, Debug)]
pub struct Board {
    pub address: Address,
    /// Its node-ID during the sessions.
    pub id: NodeId,
    pub original: Original,
}

/// The stored settings of a board before the sessions, and its NMT state.
#[derive(Clone, Copy, Debug)]
pub struct Original {
    pub node_id: Option<NodeId>,
    pub bit_rate: BitRateSetting,
    pub heartbeat_ms: u16,
    pub was_operational: bool,
}

impl fmt::Display for Original {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.node_id {
            None => write!(f, "no node-ID, {}", self.bit_rate),
            Some(id) => write!(f, "node-ID {}, {}", id.get(), self.bit_rate),
        }
    }
}

impl fmt::Display for Board {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "board {:08X}", self.address.serial_number)
    }
}

const ALL: RangeInclusive<u32> = 0..=u32::MAX;

/// Asks whether there is a board of this product in the given ranges (CiA 305, identify remote slave). Boards that
/// answer together send equal frames; none changes its state.
fn is_anyone(
    bus: &mut Bus,
    revision: &RangeInclusive<u32>,
    serial: &RangeInclusive<u32>,
) -> Result<bool, Stop> {
    use IdentifyKey as Key;
    bus.request(Request::Identify(Key::VendorId, device::VENDOR_ID))?;
    bus.request(Request::Identify(Key::ProductCode, device::PRODUCT_CODE))?;
    bus.request(Request::Identify(Key::RevisionNumberLow, *revision.start()))?;
    bus.request(Request::Identify(Key::RevisionNumberHigh, *revision.end()))?;
    bus.request(Request::Identify(Key::SerialNumberLow, *serial.start()))?;
    let answer = bus.probe(Request::Identify(Key::SerialNumberHigh, *serial.end()))?;
    Ok(answer.is_some_and(|answer| answer[0] == 0x4F))
}

/// Whether any board of this product is on the bus.
pub fn is_any_there(bus: &mut Bus) -> Result<bool, Stop> {
    is_anyone(bus, &ALL, &ALL)
}

/// Whether the board with this address is on the bus.
pub fn is_there(bus: &mut Bus, address: Address) -> Result<bool, Stop> {
    let exact = |number| number..=number;
    is_anyone(bus, &exact(address.revision_number), &exact(address.serial_number))
}

/// The addresses of all boards of this product, by halving the ranges of their numbers.
pub fn find_all(bus: &mut Bus) -> Result<Vec<Address>, Stop> {
    let mut found = Vec::new();
    for revision in
        halve(bus, ALL, Some(device::REVISION_NUMBER), |bus, range| is_anyone(bus, range, &ALL))?
    {
        let range = revision..=revision;
        for serial_number in halve(bus, ALL, None, |bus, serial| is_anyone(bus, &range, serial))? {
            found.push(Address {
                vendor_id: device::VENDOR_ID,
                product_code: device::PRODUCT_CODE,
                revision_number: revision,
                serial_number,
            });
        }
    }
    Ok(found)
}

/// The number of times that a question is asked whose answer must be yes.
const ATTEMPTS: usize = 3;

/// The numbers in `range` for which `is_anyone` is true. The likely one is tried first.
fn halve(
    bus: &mut Bus,
    range: RangeInclusive<u32>,
    likely: Option<u32>,
    is_anyone: impl Fn(&mut Bus, &RangeInclusive<u32>) -> Result<bool, Stop>,
) -> Result<Vec<u32>, Stop> {
    if let Some(likely) = likely
        && is_anyone(bus, &(likely..=likely))?
    {
        return Ok(vec![likely]);
    }
    let mut found = Vec::new();
    // Ranges in which somebody is.
    let mut rest = vec![range];
    while let Some(range) = rest.pop() {
        let (low, high) = range.into_inner();
        if low == high {
            found.push(low);
            continue;
        }
        let middle = low + (high - low) / 2;
        for _ in 0..ATTEMPTS {
            let mut halves = Vec::new();
            for half in [middle + 1..=high, low..=middle] {
                if is_anyone(bus, &half)? {
                    halves.push(half);
                }
            }
            if !halves.is_empty() {
                rest.extend(halves);
                break;
            }
        }
    }
    Ok(found)
}

/// Brings one board to LSS configuration state, and all others to LSS waiting state. Returns whether it answered.
pub fn select(bus: &mut Bus, address: Address) -> Result<bool, Stop> {
    bus.request(Request::SwitchToWaiting)?;
    bus.request(Request::Select(AddressPart::VendorId, address.vendor_id))?;
    bus.request(Request::Select(AddressPart::ProductCode, address.product_code))?;
    bus.request(Request::Select(AddressPart::RevisionNumber, address.revision_number))?;
    let answer = bus.ask(Request::Select(AddressPart::SerialNumber, address.serial_number))?;
    Ok(answer.is_some_and(|answer| answer[0] == 0x44))
}

/// The active node-ID of the board in LSS configuration state, as in the frame; `None` without an answer.
pub fn inquire_node_id(bus: &mut Bus) -> Result<Option<u8>, Stop> {
    let answer = bus.ask(Request::InquireNodeId)?;
    Ok(answer.filter(|answer| answer[0] == 0x5E).map(|answer| answer[1]))
}

/// Makes a node-ID and a bit rate pending and stores them, on the board in LSS configuration state. Returns the first
/// answer that is no success, in words.
pub fn store(
    bus: &mut Bus,
    node_id: Option<NodeId>,
    bit_rate: Option<BitRateSetting>,
) -> Result<Result<(), String>, Stop> {
    let mut requests = vec![Request::ConfigureNodeId(NodeId::to_lss(node_id))];
    requests
        .extend(bit_rate.map(|rate| Request::ConfigureBitTiming { table: 0, index: rate.index() }));
    requests.push(Request::StoreConfiguration);
    for request in requests {
        let command = request.to_bytes()[0];
        match bus.ask(request)? {
            Some([echo, 0, ..]) if echo == command => {}
            Some(answer) => return Ok(Err(format!("{command:02X} is answered {}", text(&answer)))),
            None => return Ok(Err(format!("{command:02X} is not answered"))),
        }
    }
    Ok(Ok(()))
}

/// The bytes of a frame, without the zeros at its end.
pub fn text(bytes: &[u8]) -> String {
    let len = bytes.iter().rposition(|byte| *byte != 0).map_or(1, |last| last + 1).max(2);
    bytes.iter().take(len).map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}

/// The bit rates, this one first.
pub fn rates_from(first: BitRate) -> impl Iterator<Item = BitRate> {
    [first].into_iter().chain(BitRate::ALL.into_iter().filter(move |rate| *rate != first))
}
