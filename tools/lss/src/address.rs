//! LSS addresses and numbers as a person writes them, and as texts name them.

use std::{fmt::Display, ops::RangeInclusive};

pub use can_bus::address::{node_id, number};
use canopen_node::{
    NodeId,
    lss::{Address, AddressPart, Request},
};

/// Things in a sentence, with commas between them.
pub fn list<T: Display>(things: impl IntoIterator<Item = T>) -> String {
    things.into_iter().map(|thing| thing.to_string()).collect::<Vec<_>>().join(", ")
}

/// The parts of an LSS address that may not be known.
pub fn kind_text(parts: &[Option<u32>]) -> String {
    let part = |part: &Option<u32>| part.map_or("any".into(), |part| format!("{part:08X}"));
    parts.iter().map(part).collect::<Vec<_>>().join(":")
}

/// Whether an address has these parts, as far as they are known.
pub fn is_of(address: &Address, kind: [Option<u32>; 4]) -> bool {
    let parts: [u32; 4] = (*address).into();
    kind.iter().zip(parts).all(|(known, part)| known.is_none_or(|known| known == part))
}

/// Parts of LSS addresses in hexadecimal, with commas between them.
pub fn parts(numbers: &[u32]) -> String {
    list(numbers.iter().map(|number| format!("{number:08X}")))
}

/// The requests that bring the slave with this LSS address to LSS configuration state; it answers the last one.
pub fn selection(address: Address) -> [Request; 4] {
    use AddressPart::{ProductCode, RevisionNumber, SerialNumber, VendorId};
    let parts = [VendorId, ProductCode, RevisionNumber, SerialNumber];
    let numbers: [u32; 4] = address.into();
    parts.map(|part| Request::Select(part, numbers[part as usize]))
}

/// A node-ID in words.
pub fn id_text(id: Option<NodeId>) -> String {
    id.map_or("none".into(), |id| id.to_string())
}

/// `1 board`, `2 boards`.
pub fn counted(count: usize, what: &str) -> String {
    let plural = if count == 1 { "" } else { "s" };
    format!("{count} {what}{plural}")
}

/// An LSS address, as its [`Display`] writes it.
pub fn address(text: &str) -> Result<Address, String> {
    let part = |part: &str| u32::from_str_radix(part.trim_start_matches("0x"), 16).ok();
    let parts: Option<Vec<u32>> = text.split(':').map(part).collect();
    let parts = parts.and_then(|parts| <[u32; 4]>::try_from(parts).ok());
    parts
        .map(Address::from)
        .ok_or_else(|| "vendor-ID:product code:revision:serial number, in hexadecimal".into())
}

/// `FIRST..LAST`, or a single number.
pub fn range(text: &str) -> Result<RangeInclusive<u32>, String> {
    let (first, last) = text.split_once("..").unwrap_or((text, text));
    let range = number(first)?..=number(last)?;
    match range.is_empty() {
        true => Err("the first number is greater than the last".into()),
        false => Ok(range),
    }
}

/// A byte in hexadecimal.
pub fn byte(text: &str) -> Result<u8, String> {
    u8::from_str_radix(text, 16).map_err(|_| "a byte in hexadecimal, such as 5E".into())
}

/// A board that is named by its node-ID or by its LSS address.
#[derive(Clone, Copy, Debug)]
pub enum Which {
    Node(NodeId),
    Address(Address),
}

/// A node-ID, or an LSS address.
pub fn which(text: &str) -> Result<Which, String> {
    match text.contains(':') {
        true => address(text).map(Which::Address),
        false => node_id(text).map(Which::Node),
    }
}

/// The node-ID that a board is to have, or none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Assigned(pub Option<NodeId>);

/// A node-ID, or `none`.
pub fn assigned(text: &str) -> Result<Assigned, String> {
    match text {
        "none" => Ok(Assigned(None)),
        _ => match node_id(text) {
            Ok(id) => Ok(Assigned(Some(id))),
            Err(words) => Err(format!("{words}, or none")),
        },
    }
}
