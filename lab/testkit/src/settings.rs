//! Settings to store, and handmade records and flashes of the log.

use std::ops::Deref;

use canopen_node::{
    BitRate, NodeId, Settings,
    settings::{
        Found, Log,
        parameters::{Packer, Parameter},
    },
};

use super::flash::{BoardFlash, Flash};

/// What a board has stored: its settings and its heartbeat time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stored {
    pub settings: Settings,
    /// The producer heartbeat time 1017h; 0: no heartbeat.
    pub heartbeat_ms: u16,
}

impl Stored {
    #[must_use]
    pub fn with_heartbeat_ms(self, heartbeat_ms: u16) -> Self {
        Self { heartbeat_ms, ..self }
    }

    /// Stores it, beside no other parameters.
    pub fn store<const P: usize>(self, log: &mut Log<BoardFlash, P>) {
        let mut parameters = [0; 8];
        Packer::new(&mut parameters).put(&Parameter {
            index: 0x1017,
            sub_index: 0,
            data_type: 0x06,
            value: &self.heartbeat_ms.to_le_bytes(),
        });
        log.store_with_parameters(self.settings, &parameters)
            .expect("the flash in memory works, and has room");
    }
}

/// Without a heartbeat.
impl From<Settings> for Stored {
    fn from(settings: Settings) -> Self {
        Self { settings, heartbeat_ms: 0 }
    }
}

impl Deref for Stored {
    type Target = Settings;

    fn deref(&self) -> &Settings {
        &self.settings
    }
}

/// Settings for number `n`, which differ in more than one field from those for `n` + 1.
pub fn settings(n: u16) -> Settings {
    Settings::new(BitRate::ALL[usize::from(n % 8)].into())
        .with_node_id(NodeId::new((n % 127) as u8))
}

/// The settings that a power-on finds.
pub fn open<const W: usize, const E: usize>(flash: &Flash<W, E>) -> (Option<Settings>, Found) {
    let (log, found) = Log::open(flash.clone());
    (log.settings(), found)
}

/// The record format of the documentation: sequence, kind, node-ID, bit rate index, CRC, commit word.
pub fn record(sequence: u32, kind: u8, node_id: u8, index: u8) -> [u8; 32] {
    let mut bytes = [0xFF; 32];
    bytes[..4].copy_from_slice(&sequence.to_le_bytes());
    bytes[4..7].copy_from_slice(&[kind, node_id, index]);
    sealed(bytes)
}

/// A record with this content, its CRC and the commit word.
pub fn sealed(mut bytes: [u8; 32]) -> [u8; 32] {
    let mut crc = u32::MAX;
    for byte in &bytes[..24] {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = crc >> 1 ^ if crc & 1 == 1 { 0xEDB8_8320 } else { 0 };
        }
    }
    bytes[24..28].copy_from_slice(&(!crc).to_le_bytes());
    bytes[28..].copy_from_slice(b"LSS1");
    bytes
}

/// The place of a record in flash with program units of `W` bytes: it is begun and certain.
pub fn place<const W: usize>(record: &[u8; 32]) -> Vec<u8> {
    let unit = W.max(4);
    let mut certain = record[24..].to_vec();
    certain.resize(unit, 0xFF);
    [&vec![0; unit], &record[..], &certain].concat()
}

/// A flash with these records, each at a bank and a number in the bank.
pub fn flash_with<const W: usize, const E: usize>(
    records: &[(usize, usize, [u8; 32])],
) -> Flash<W, E> {
    let mut content = vec![0xFF; 2 * E];
    for (bank, number, record) in records {
        let place = place::<W>(record);
        let at = bank * E + number * place.len();
        content[at..at + place.len()].copy_from_slice(&place);
    }
    Flash::with_content(content, 0)
}

/// The settings and the packed parameters that a log holds.
pub type Content = (Option<Settings>, Vec<u8>);

/// Packed parameters for number `n`: one value of `len` bytes, which begins with `n`; none for a `len` of 0.
pub fn parameters(n: u16, len: usize) -> Vec<u8> {
    let mut value = vec![n as u8 ^ 0x5A; len];
    value.iter_mut().zip(n.to_le_bytes()).for_each(|(to, from)| *to = from);
    let mut packed = vec![0; 6 + len];
    let mut packer = Packer::new(&mut packed);
    if len > 0 {
        packer.put(&Parameter { index: 0x2100, sub_index: 1, data_type: 0x0A, value: &value });
    }
    let len = packer.len();
    packed.truncate(len);
    packed
}

/// A log with parameters after a power-on, whose node takes them all; its content; the result of opening it.
pub fn open_with_parameters<const P: usize, const W: usize, const E: usize>(
    flash: &Flash<W, E>,
) -> (Log<Flash<W, E>, P>, Content, Found) {
    let (mut log, mut found) = Log::open_with_parameters(flash.clone());
    if let Err(error) = log.restore(|_| true) {
        found = Found::MediumFailed(error);
    }
    let content = (log.settings(), log.parameters().to_vec());
    (log, content, found)
}
