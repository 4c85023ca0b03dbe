//! The objects of the commissioner: the table of its network, its state, and what it hears on the bus.

use core::iter;

use canopen_node::{
    BitRate, Frame, Instant, NodeId,
    application::{Event, OctetString},
    lss::Address,
    master::{Inbox, Master},
    objects,
    sdo::Abort,
};

/// The node with the application.
pub type Node = canopen_node::Node<Application>;

/// The boards of the table: those with the node-IDs 1 to 32.
pub const BOARDS: usize = 32;
/// The bytes of a row of the table: vendor-ID, product code, revision number and serial number, each from its lowest
/// byte on.
const ROW: usize = 16;

/// Boards are bits of a number, that with the node-ID 1 first: here all.
pub const ALL: u32 = u32::MAX;

/// The bit of a board.
pub const fn bit(node: NodeId) -> u32 {
    1 << (node.get() as u32 - 1)
}

objects! {
    /// The objects of the commissioner, with their values.
    pub struct Application, values Value;

    /// What has come for the master.
    private inbox: Inbox = Inbox::EMPTY;

    0x2100 "Network" {
        1 "State" state: u8 = State::Asking as u8, ro;
        2 "Boards that answer, bit 0 for node-ID 1" present: u32 = 0, ro;
    }
    0x2101 {
        0 "Bit rate to switch to in kbit/s, 0 if none" bit_rate: u16 = 0, rw, stored;
    }
    0x2200 {
        0 "LSS addresses of the boards from node-ID 1 on" table: OctetString<512> = OctetString::EMPTY, rw, stored;
    }
}

/// What the commissioner is doing, or has found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum State {
    /// All boards of the table answer, and no other without a node-ID.
    Complete,
    /// It asks, scans or switches.
    Asking,
    /// A board of the table is missing.
    Missing,
    /// A board without a node-ID is not in the table: the button takes it.
    New,
    /// A board cannot have its node-ID: another node has it, it could replace several boards, or the table is full.
    Conflict,
    /// The commissioner could not store its table, or a board could not store the bit rate.
    NotStored,
    /// Another LSS master is at work: the commissioner waits until it is silent.
    Rival,
    /// A board has not come to the new bit rate, or the commissioner could not store it: all have the old one.
    TakenBack,
}

/// The pattern of the LED in each state, a bit for each of 16 steps of 50 ms: on, flickering, one flash, blinking, and two
/// or three flashes.
pub const PATTERNS: [u16; 8] = [0xFFFF, 0x3333, 0x0001, 0x00FF, 0x0005, 0x0005, 0x0015, 0x0015];

impl canopen_node::Application for Application {
    const IS_MASTER: bool = true;

    fn hear(&mut self, frame: &Frame, now: Instant) {
        self.inbox.hear(frame, now);
    }

    fn handle(&mut self, event: Event) {
        self.inbox.handle(event);
    }

    fn accept(&mut self, value: &Value) -> Result<(), Abort> {
        let is_legal = match value {
            Value::BitRate(rate) => *rate == 0 || BitRate::from_kbit_per_s(*rate).is_some(),
            Value::Table(table) => table.as_bytes().len().is_multiple_of(ROW),
            _ => true,
        };
        if is_legal { Ok(()) } else { Err(Abort::InvalidValue) }
    }
}

impl Master for Application {
    fn inbox(&mut self) -> &mut Inbox {
        &mut self.inbox
    }
}

impl Application {
    /// The bit rate that a client has asked for.
    pub fn asked_rate(&self) -> Option<BitRate> {
        BitRate::from_kbit_per_s(self.bit_rate)
    }

    /// The rows of the table: each node-ID with the LSS address of its board.
    pub fn rows(&self) -> impl Iterator<Item = (NodeId, Option<Address>)> {
        let (rows, _) = self.table.as_bytes().as_chunks();
        let address = |row: &[u8; ROW]| (*row != [0; ROW]).then(|| Address::from_le_bytes(*row));
        let rows = rows.iter().map(address).chain(iter::repeat(None));
        (1..=BOARDS as u8).filter_map(NodeId::new).zip(rows)
    }

    /// Those of these boards that are in the table, each with its node-ID.
    pub fn boards(&self, boards: u32) -> impl Iterator<Item = (NodeId, Address)> {
        let chosen = self.rows().filter(move |(node, _)| boards & bit(*node) != 0);
        chosen.filter_map(|(node, row)| Some((node, row?)))
    }

    /// Writes the row of this node-ID.
    pub fn set_row(&mut self, node: NodeId, address: Address) {
        let mut bytes = [0; ROW * BOARDS];
        let before = self.table.as_bytes();
        bytes[..before.len()].copy_from_slice(before);
        let end = ROW * usize::from(node.get());
        bytes[end - ROW..end].copy_from_slice(&address.to_le_bytes());
        let table = OctetString::from_bytes(&bytes[..end.max(before.len())]);
        self.table = table.unwrap_or(self.table);
    }
}
