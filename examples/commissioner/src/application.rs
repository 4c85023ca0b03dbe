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
pub const BOARDS: u8 = 32;
/// The bytes of a row of the table: vendor-ID, product code, revision number and serial number, each from its lowest
/// byte on.
const ROW: usize = 16;

objects! {
    /// The objects of the commissioner, with their values.
    pub struct Application, values Value;

    /// The answers to LSS requests that the master has not taken, and when they came.
    private answers: [Option<(Frame, Instant)>; 8] = [None; 8];
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
    /// The flash of the commissioner or of a board could not store, or a board has gone meanwhile.
    NotStored,
    /// Another LSS master is at work: the commissioner waits until it is silent.
    Rival,
    /// A board is missing at the new bit rate or before, so all have the old one.
    TakenBack,
}

impl State {
    /// The pattern of the LED, a bit for each of 16 steps of 50 ms.
    pub const fn pattern(state: u8) -> u16 {
        match state {
            0 => 0xFFFF,     // on
            1 => 0x3333,     // flickers
            2 => 0x0001,     // one flash
            3 => 0x00FF,     // blinks
            4..=5 => 0x0005, // two flashes
            _ => 0x0015,     // three flashes
        }
    }
}

impl canopen_node::Application for Application {
    const IS_MASTER: bool = true;

    fn hear(&mut self, frame: &Frame, now: Instant) {
        match frame.cob_id() {
            lss::RESPONSE_COB_ID => {
                if let Some(place) = self.answers.iter_mut().find(|place| place.is_none()) {
                    *place = Some((*frame, now));
                }
            }
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
fn address(row: &[u8]) -> Option<Address> {
    let mut parts = row.chunks_exact(4).map(|part| part.try_into().map_or(0, u32::from_le_bytes));
    let parts = array::from_fn(|_| parts.next().unwrap_or(0));
    (parts != [0; 4]).then(|| parts.into())
}

/// The bit rate of so many kbit/s.
fn bit_rate(kbit_per_s: u16) -> Option<BitRate> {
    BitRate::ALL.into_iter().find(|rate| rate.kbit_per_s() == kbit_per_s)
}

impl Application {
    /// Whether an answer to an LSS request waits.
    pub fn has_answer(&self) -> bool {
        self.answers.iter().any(Option::is_some)
    }

    /// The next answer to an LSS request, and when it came.
    pub fn take_answer(&mut self) -> Option<(Frame, Instant)> {
        self.answers.rotate_left(1);
        let [.., first] = &mut self.answers;
        first.take()
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
        let rows = self.table.as_bytes().chunks_exact(ROW).map(address).chain(iter::repeat(None));
        (1..=BOARDS).filter_map(NodeId::new).zip(rows)
    }

    /// The boards of the table, each with its node-ID.
    pub fn boards(&self) -> impl Iterator<Item = (NodeId, Address)> {
        self.rows().filter_map(|(node, row)| Some((node, row?)))
    }

    /// Writes the row of this node-ID.
    pub fn set_row(&mut self, node: NodeId, address: Address) {
        let mut bytes = [0; ROW * BOARDS as usize];
        let before = self.table.as_bytes();
        bytes[..before.len()].copy_from_slice(before);
        let end = ROW * usize::from(node.get());
        for (place, part) in
            bytes[end - ROW..end].chunks_exact_mut(4).zip(<[u32; 4]>::from(address))
        {
            place.copy_from_slice(&part.to_le_bytes());
        }
        let table = OctetString::from_bytes(&bytes[..end.max(before.len())]);
        self.table = table.unwrap_or(self.table);
    }
}
