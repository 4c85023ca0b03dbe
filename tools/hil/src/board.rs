//! The boards on the bus: how they are found without a change to any, addressed, and left as they were.

use std::fmt;

use canopen_node::{
    BitRate, BitRateSetting, NodeId,
    lss::{Address, IdentifyKey, Request},
};
use lss_master::{Assign, Configure, Find, Identify, InquireNodeId, Select};

use crate::{bus::Bus, product::Product, stop::Stop};

/// The result of a transfer or of a procedure; an error says in words why it failed.
pub type Outcome<T> = Result<Result<T, String>, Stop>;

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

/// Asks once whether any board is within these ranges. A board that looks for the bit rate needs one question soon after
/// the other, so this does not wait as long as the LSS master that does not know the boards yet.
pub fn is_anyone(bus: &mut Bus, within: Identify) -> Result<bool, Stop> {
    use IdentifyKey as Key;
    bus.request(Request::Identify(Key::VendorId, within.vendor_id))?;
    bus.request(Request::Identify(Key::ProductCode, within.product_code))?;
    bus.request(Request::Identify(Key::RevisionNumberLow, *within.revision_numbers.start()))?;
    bus.request(Request::Identify(Key::RevisionNumberHigh, *within.revision_numbers.end()))?;
    bus.request(Request::Identify(Key::SerialNumberLow, *within.serial_numbers.start()))?;
    let last = Request::Identify(Key::SerialNumberHigh, *within.serial_numbers.end());
    Ok(bus.probe(last)?.is_some_and(|answer| answer[0] == 0x4F))
}

/// The addresses of all boards of this product. The revision that is expected comes first, since a single revision takes
/// half of the time.
pub fn find_all(bus: &mut Bus, product: &Product) -> Result<Vec<Address>, Stop> {
    let mut found = Vec::new();
    let own = product.revision_number.unwrap_or(0x0001_0000);
    let below = own.checked_sub(1).map(|last| 0..=last);
    let above = own.checked_add(1).map(|first| first..=u32::MAX);
    for revision_numbers in [Some(own..=own), below, above].into_iter().flatten() {
        let mut rest = Identify { revision_numbers, ..product.all() };
        while let Ok(Some(address)) = bus.carry_out(Find::new(rest.clone()))? {
            found.push(address);
            let Some(next) = address.serial_number.checked_add(1) else { break };
            rest.serial_numbers = next..=u32::MAX;
        }
    }
    Ok(found)
}

/// Brings one board to LSS configuration state, and all others to LSS waiting state. Returns whether it answered.
pub fn select(bus: &mut Bus, address: Address) -> Result<bool, Stop> {
    Ok(bus.carry_out(Select(address))?.is_ok())
}

/// Selects a board; returns its active node-ID as in the frame, or `None` without an answer.
pub fn node_id(bus: &mut Bus, address: Address) -> Result<Option<u8>, Stop> {
    match select(bus, address)? {
        true => Ok(bus.carry_out(InquireNodeId)?.ok().map(NodeId::to_lss)),
        false => Ok(None),
    }
}

/// Lets a board store this configuration, and brings it back to LSS waiting state.
pub fn store(bus: &mut Bus, address: Address, configure: Configure) -> Outcome<()> {
    Ok(bus.carry_out(Assign::address(address, configure))?.map(drop).map_err(|why| why.to_string()))
}

/// The bytes of a frame, without the zeros at its end.
pub fn text(bytes: &[u8]) -> String {
    let len = bytes.iter().rposition(|byte| *byte != 0).map_or(1, |last| last + 1).max(2);
    bytes.iter().take(len).map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}

/// An answer, if there is one.
pub fn answer_text(answer: Option<[u8; 8]>) -> String {
    answer.map_or("no answer".to_owned(), |answer| text(&answer))
}

/// The bit rates, this one first.
pub fn rates_from(first: BitRate) -> impl Iterator<Item = BitRate> {
    [first].into_iter().chain(BitRate::ALL.into_iter().filter(move |rate| *rate != first))
}
