//! Settings to store, and handmade records and flashes of the log.

use lss_slave::{
    BitRate, NodeId, Settings,
    settings::{Found, Log},
};

use super::flash::Flash;

/// Settings for number `n`, which differ in more than one field from those for `n` + 1.
pub fn settings(n: u16) -> Settings {
    Settings::new(BitRate::ALL[usize::from(n % 8)].into())
        .with_node_id(NodeId::new((n % 128) as u8))
        .with_heartbeat_ms(n)
}

/// The settings that a power-on finds.
pub fn open<const W: usize, const E: usize>(flash: &Flash<W, E>) -> (Option<Settings>, Found) {
    let (log, found) = Log::open(flash.clone());
    (log.settings(), found)
}

/// The record format of the documentation: sequence, kind, node-ID, bit rate index, heartbeat time, CRC, commit word.
pub fn record(sequence: u32, kind: u8, node_id: u8, index: u8, heartbeat_ms: u16) -> [u8; 32] {
    let mut bytes = [0xFF; 32];
    bytes[..4].copy_from_slice(&sequence.to_le_bytes());
    bytes[4..7].copy_from_slice(&[kind, node_id, index]);
    bytes[8..10].copy_from_slice(&heartbeat_ms.to_le_bytes());
    sealed(bytes)
}

/// A record with this content, its CRC and the commit word.
pub fn sealed(mut bytes: [u8; 32]) -> [u8; 32] {
    let mut crc = u32::MAX;
    for bit in bytes[..24].iter().flat_map(|byte| (0..8).map(move |i| u32::from(byte >> i & 1))) {
        crc = crc >> 1 ^ if (crc ^ bit) & 1 == 1 { 0xEDB8_8320 } else { 0 };
    }
    bytes[24..28].copy_from_slice(&(!crc).to_le_bytes());
    bytes[28..].copy_from_slice(b"LSS1");
    bytes
}

/// A flash with these records, each at a bank and a number in the bank.
pub fn flash_with<const W: usize, const E: usize>(
    records: &[(usize, usize, [u8; 32])],
) -> Flash<W, E> {
    let mut content = vec![0xFF; 2 * E];
    for (bank, number, record) in records {
        let at = bank * E + number * 32;
        content[at..at + 32].copy_from_slice(record);
    }
    Flash::with_content(content, 0)
}
