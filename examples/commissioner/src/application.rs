//! The objects of the commissioner: the table of its network, its state, and what it hears on the bus.

use core::{array, iter};

use canopen_node::{
    BitRate, Frame, Instant, NodeId,
    application::{Event, OctetString},
    lss::{self, Address},
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

objects! {
    /// The objects of the commissioner, with their values.
    pub struct Application, values Value;

    /// The answer to an LSS request that the master has not taken, and when it came.
    private answer: Option<(Frame, Instant)> = None;
    /// The nodes that were heard since the last call of [`listen`](Application::listen), a bit for each.
    private heard: u128 = 0;
    /// Whether another LSS master was heard since then.
    private has_rival: bool = false;
    /// The outcome of the last store.
    private is_stored: Option<bool> = None;

    0x2100 "Network" {
        1 "State" state: u8 = State::Asking as u8, ro;
        2 "Boards that are there, bit 0 for node-ID 1" present: u32 = 0, ro;
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
    /// All boards of the table are there, and no other without a node-ID.
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
        match frame.cob_id() {
            lss::RESPONSE_COB_ID => self.answer = Some((*frame, now)),
            lss::REQUEST_COB_ID => self.has_rival = true,
            // Emergency, TPDO 1, SDO answer, heartbeat or boot-up.
            cob_id @ (0x081..=0x0FF | 0x181..=0x1FF | 0x581..=0x5FF | 0x701..=0x77F) => {
                self.heard |= 1 << (cob_id & 0x7F);
            }
            _ => {}
        }
    }

    fn accept(&mut self, value: &Value) -> Result<(), Abort> {
        let is_legal = match value {
            Value::BitRate(rate) => *rate == 0 || bit_rate(*rate).is_some(),
            Value::Table(table) => table.as_bytes().len().is_multiple_of(ROW),
            _ => true,
        };
        if is_legal { Ok(()) } else { Err(Abort::InvalidValue) }
    }

    fn handle(&mut self, event: Event) {
        if let Event::Stored(outcome) = event {
            self.is_stored = Some(outcome.is_ok());
        }
    }
}

/// The LSS address in a row, if there is one.
fn address(row: &[u8; ROW]) -> Option<Address> {
    let (parts, _) = row.as_chunks();
    (*row != [0; ROW]).then(|| array::from_fn(|part| u32::from_le_bytes(parts[part])).into())
}

/// The bit rate of so many kbit/s.
fn bit_rate(kbit_per_s: u16) -> Option<BitRate> {
    BitRate::ALL.into_iter().find(|rate| rate.kbit_per_s() == kbit_per_s)
}

impl Application {
    /// Whether an answer to an LSS request waits.
    pub const fn has_answer(&self) -> bool {
        self.answer.is_some()
    }

    /// The answer to an LSS request, and when it came.
    pub const fn take_answer(&mut self) -> Option<(Frame, Instant)> {
        self.answer.take()
    }

    /// Forgets what was heard.
    pub const fn listen(&mut self) {
        (self.heard, self.has_rival) = (0, false);
    }

    /// Whether this node was heard.
    pub const fn has_heard(&self, node: NodeId) -> bool {
        self.heard >> node.get() & 1 == 1
    }

    /// Whether another LSS master was heard.
    pub const fn has_rival(&self) -> bool {
        self.has_rival
    }

    /// The outcome of the last store, once.
    pub const fn take_stored(&mut self) -> Option<bool> {
        self.is_stored.take()
    }

    /// The bit rate that a client has asked for.
    pub fn asked_rate(&self) -> Option<BitRate> {
        bit_rate(self.bit_rate)
    }

    /// The rows of the table: each node-ID with the LSS address of its board.
    pub fn rows(&self) -> impl Iterator<Item = (NodeId, Option<Address>)> {
        let (rows, _) = self.table.as_bytes().as_chunks();
        let rows = rows.iter().map(address).chain(iter::repeat(None));
        (1..=BOARDS as u8).filter_map(NodeId::new).zip(rows)
    }

    /// The boards of the table, each with its node-ID.
    pub fn boards(&self) -> impl Iterator<Item = (NodeId, Address)> {
        self.rows().filter_map(|(node, row)| Some((node, row?)))
    }

    /// Writes the row of this node-ID.
    pub fn set_row(&mut self, node: NodeId, address: Address) {
        let mut bytes = [0; ROW * BOARDS];
        let before = self.table.as_bytes();
        bytes[..before.len()].copy_from_slice(before);
        let end = ROW * usize::from(node.get());
        let (parts, _) = bytes[end - ROW..end].as_chunks_mut();
        parts.copy_from_slice(&<[u32; 4]>::from(address).map(u32::to_le_bytes));
        let table = OctetString::from_bytes(&bytes[..end.max(before.len())]);
        self.table = table.unwrap_or(self.table);
    }
}
