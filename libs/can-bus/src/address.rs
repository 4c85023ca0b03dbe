//! Numbers and node-IDs as a person writes them.

use canopen_node::NodeId;

/// A number in decimal, or in hexadecimal after `0x`.
///
/// # Errors
/// It is none of 32 bits, in words.
pub fn number(text: &str) -> Result<u32, String> {
    let parsed = match text.strip_prefix("0x").or(text.strip_prefix("0X")) {
        Some(digits) => u32::from_str_radix(digits, 16),
        None => text.parse(),
    };
    parsed.map_err(|_| "a number of 32 bits, such as 1276 or 0x4FC".into())
}

/// A node-ID.
///
/// # Errors
/// It is none of 1 to 127, in words.
pub fn node_id(text: &str) -> Result<NodeId, String> {
    let id = number(text).ok().and_then(|id| id.try_into().ok());
    id.and_then(NodeId::new).ok_or_else(|| "1 to 127".into())
}
