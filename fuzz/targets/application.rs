//! The node with an application, process data and stored parameters, with frames, time, transfers, stores and resets in
//! any order: its actions come to an end, and what is stored is found again.

#![no_main]

use libfuzzer_sys::fuzz_target;
use canopen_node::{
    Action, Application, BitRate, BitRates, BusEvent, Device, Frame, Instant, Node, NodeId,
    Settings,
    application::{Domain, Text},
    lss::StoreError,
    nmt::State,
    objects,
    pdo::{Rpdo, Tpdo},
    sdo::Abort,
    settings::parameters::unpack,
};
use canopen_node_fuzz::{ADDRESS, act_until_nothing_is_due};
use testkit::sdo_messages::{block_download, block_upload, download, upload};

const STORED_LEN: usize = MachineNode::STORED_LEN;

type MachineNode = Node<Machine, 2, 2, 2>;

/// The length of the log.
const LOG_LEN: u32 = 200;

objects! {
    /// Inputs and outputs, and values longer than one frame. Some are stored.
    pub struct Machine, values MachineValue;

    0x2100 "Values" {
        1 "Name" name: Text<20> = Text::EMPTY, rw, stored;
        2 "Log" log: Domain = Domain, rw;
        3 "Bytes of the log that a client has written" written: u32 = 0, ro;
    }
    0x6000 "Inputs" {
        1 "Buttons" buttons: u8 = 0, ro, mappable;
        2 "Position" position: i32 = 0, ro, mappable;
    }
    0x6200 "Outputs" {
        1 "Lamps" lamps: u8 = 0, rw, mappable;
        2 "Speed" speed: u16 = 0, rw in 0..=1000, mappable, stored;
    }
}

impl Application for Machine {
    const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 1), (0x6200, 2)])];
    const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x6200, 1), (0x6200, 2)])];

    fn domain_len(&self, _: u16, _: u8) -> Result<u32, Abort> {
        Ok(LOG_LEN)
    }

    fn read_domain(&self, _: u16, _: u8, offset: u32, to: &mut [u8]) -> usize {
        to.iter_mut().zip(offset..LOG_LEN).map(|(to, byte)| *to = byte as u8).count()
    }

    fn write_domain(&mut self, _: u16, _: u8, offset: u32, bytes: &[u8]) -> Result<(), Abort> {
        assert_eq!(offset, self.written, "parts of a domain follow one another");
        self.written += bytes.len() as u32;
        if self.written > LOG_LEN { Err(Abort::TooLong) } else { Ok(()) }
    }

    fn end_domain(&mut self, _: u16, _: u8, len: u32) -> Result<(), Abort> {
        assert_eq!(len, self.written);
        if len.is_multiple_of(2) {
            self.written = 0;
            return Ok(());
        }
        // The node discards what was written.
        Err(Abort::InvalidValue)
    }

    fn abort_domain(&mut self, _: u16, _: u8) {
        self.written = 0;
    }
}

/// A board with the settings and the packed parameters that its flash holds.
struct Board {
    node: MachineNode,
    now: Instant,
    may_transmit: bool,
    settings: Settings,
    parameters: Vec<u8>,
    /// The store in progress.
    store: Option<(Settings, Vec<u8>)>,
}

/// A node after power-on, which takes all that it has stored.
fn start(settings: Settings, parameters: &[u8]) -> MachineNode {
    let device = Device::new(ADDRESS, BitRates::possible(40_000_000)).with_rescue(true);
    let mut node = Node::with_application(device, Some(settings), Machine::new());
    for parameter in unpack(parameters) {
        assert!(node.restore(&parameter), "{parameter:?} was stored");
    }
    node
}

impl Board {
    fn new() -> Self {
        let settings = Settings::new(BitRate::Kbit1000.into()).with_node_id(NodeId::new(5));
        let now = Instant::from_micros(u32::MAX - 1_000_000);
        let node = start(settings, &[]);
        Self { node, now, may_transmit: true, settings, parameters: Vec::new(), store: None }
    }

    fn act(&mut self, action: Action) {
        match action {
            Action::Transmit(frame) => assert!(self.may_transmit, "{frame:?} in a silent period"),
            Action::StopTransmitting | Action::Listen(_) | Action::SetBitRate(_) => {
                self.may_transmit = false;
            }
            Action::ResumeTransmitting => self.may_transmit = true,
            Action::SetReceives | Action::DropPdos => {}
            Action::SetNodeId(id) => assert_eq!(id, self.node.node_id()),
            Action::Store(settings) => {
                assert!(self.store.is_none(), "a store before the previous one has ended");
                let mut parameters = vec![0; STORED_LEN];
                let len = self.node.write_parameters(&self.parameters, &mut parameters);
                parameters.truncate(len);
                self.store = Some((settings, parameters));
            }
            Action::ResetDevice => {
                self.node = start(self.settings, &self.parameters);
                (self.store, self.may_transmit) = (None, true);
            }
        }
    }

    fn act_until_nothing_is_due(&mut self) {
        act_until_nothing_is_due(|| {
            self.node.poll(self.now).map(|action| self.act(action)).is_some()
        });
    }

    fn receive(&mut self, cob_id: u16, data: &[u8]) {
        let action =
            Frame::new(cob_id, data).and_then(|frame| self.node.handle_frame(&frame, self.now));
        action.into_iter().for_each(|action| self.act(action));
        self.act_until_nothing_is_due();
    }

    /// A transfer of a long value by a client that does not wait for the answers and stops after some messages.
    fn transfer(&mut self, server: u16, [kind, len, messages, byte, block_size, ..]: [u8; 8]) {
        let address = (0x2100, 1 + (kind >> 2 & 1));
        let data = vec![byte; usize::from(len).max(1)];
        let segments = len / 7 + 1;
        let transfer = match kind & 3 {
            0 => download(address, &data),
            1 => block_download(address, &data),
            2 => upload(address, segments),
            _ => block_upload(address, block_size, 1 + (kind >> 6), segments),
        };
        for message in transfer.iter().take(messages.into()) {
            self.receive(server, message);
        }
    }

    /// Any data of a frame that the node receives, an SDO request that can be meaningful, or an event.
    fn step(&mut self, [kind, ms, data @ ..]: [u8; 10]) {
        self.now = self.now.plus_micros(u32::from(ms) * 1000);
        self.act_until_nothing_is_due();
        let len = usize::from(kind >> 4).min(8);
        let cob_ids: Vec<_> = self.node.receives().iter().collect();
        let server = 0x600 + u16::from(self.node.node_id().map_or(5, NodeId::get));
        match kind & 0xF {
            0..=3 => self.receive(cob_ids[usize::from(data[7]) % cob_ids.len()], &data[..len]),
            4 => self.transfer(server, data),
            5 => self.receive(server, &data),
            6..=9 => {
                let [index, sub_index, number @ .., size, _, _] = data;
                let parameters = [0x10, 0x14, 0x16, 0x18, 0x1A, 0x60, 0x62, 0x21];
                let sizes = [0x23, 0x2B, 0x2F, 0x23];
                let high = parameters[usize::from(index >> 5)];
                let command = sizes[usize::from(size & 3)];
                let [n0, n1, n2] = number;
                let value = [n0, n1, size >> 2, n2];
                let address = [index & 0x1F, high, sub_index & 0xF];
                self.receive(server, &[&[command], &address[..], &value].concat());
            }
            10 => self.receive(server, &[0x23, 0x10, 0x10, data[0] % 4, b's', b'a', b'v', b'e']),
            11 if data[0] & 3 == 0 => {
                self.receive(server, &[0x23, 0x11, 0x10, data[1] % 4, b'l', b'o', b'a', b'd']);
            }
            11 => self.node.application_mut().position ^= i32::from(data[1]),
            12 => self.end_store(data[0] != 0),
            13 => self.node.handle_bus(BusEvent::Acknowledged, self.now),
            14 => self.node.report(u16::from(data[0]), data[1], [0; 5]),
            _ => self.now = self.now.plus_micros(u32::from(data[0]) * 250_000),
        }
        self.act_until_nothing_is_due();
    }

    fn end_store(&mut self, is_done: bool) {
        let Some((settings, parameters)) = self.store.take() else { return };
        if is_done {
            (self.settings, self.parameters) = (settings, parameters);
        }
        self.node.handle_stored(if is_done { Ok(()) } else { Err(StoreError::MediumAccess) });
    }

    /// A reset of communication leads to the COB-IDs of a power cycle.
    fn check(&mut self) {
        let restarted = start(self.settings, &self.parameters);
        self.receive(0x000, &[0x82, 0]);
        let is_undisturbed = self.may_transmit && self.node.nmt_state() == State::PreOperational;
        if is_undisturbed && self.node.node_id() == restarted.node_id() {
            assert_eq!(self.node.receives(), restarted.receives());
        }
    }
}

fuzz_target!(|steps: Vec<[u8; 10]>| {
    let mut board = Board::new();
    board.act_until_nothing_is_due();
    for step in steps {
        board.step(step);
    }
    board.check();
});
