//! The node with an application, process data and stored parameters, with frames, time, transfers, stores and resets in
//! any order: its actions come to an end, and what is stored is found again.

#![no_main]

use libfuzzer_sys::fuzz_target;
use canopen_node::{
    Application, Frame, NodeId, Service,
    application::{Domain, Text},
    lss::StoreError,
    nmt::State,
    objects,
    pdo::{Rpdo, Tpdo},
    sdo::Abort,
};
use testkit::{
    flash::BoardFlash,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo_messages::{block_download, block_upload, download, upload},
};

type Board = NodeRig<Machine>;

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
    const TPDOS: &'static [Tpdo] =
        &[Tpdo::new(&[(0x6000, 1), (0x6200, 2)]), Tpdo::UNUSED];
    const RPDOS: &'static [Rpdo] =
        &[Rpdo::new(&[(0x6200, 1), (0x6200, 2)]), Rpdo::UNUSED];
    const PRODUCERS: usize = 2;

    fn domain_len(&mut self, _: u16, _: u8) -> Result<u32, Abort> {
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

fn new_board() -> Board {
    let device = device(ADDRESS).with_defaults(defaults(5)).with_rescue(true);
    let clock = u32::MAX - 1_000_000;
    let mut board = Board::with_application(device, BoardFlash::blank(0), clock, Machine::new());
    board.let_stores_take_time();
    // From the boot-up on nothing is acknowledged unless the input says so.
    board.is_acknowledged = false;
    board.power_cycle();
    board.take_actions();
    board
}

fn receive(board: &mut Board, cob_id: u16, data: &[u8]) {
    Frame::new(cob_id, data).iter().for_each(|frame| _ = board.receive(frame));
}

/// A transfer of a long value by a client that does not wait for the answers and stops after some messages.
fn transfer(board: &mut Board, server: u16, data: [u8; 8]) {
    let [kind, len, messages, byte, block_size, ..] = data;
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
        receive(board, server, message);
    }
}

/// Any data of a frame that the node receives, an SDO request that can be meaningful, or an event.
fn step(board: &mut Board, [kind, ms, data @ ..]: [u8; 10]) {
    board.be_late_ms(ms.into());
    let len = usize::from(kind >> 4).min(8);
    let cob_ids: Vec<_> = board.node.receives().iter().collect();
    let server = 0x600 + u16::from(board.node.node_id().map_or(5, NodeId::get));
    match kind & 0xF {
        0..=3 => receive(board, cob_ids[usize::from(data[7]) % cob_ids.len()], &data[..len]),
        4 => transfer(board, server, data),
        5 => receive(board, server, &data),
        6..=9 => {
            let [index, sub_index, number @ .., size, _, _] = data;
            let parameters = [0x10, 0x14, 0x16, 0x18, 0x1A, 0x60, 0x62, 0x21];
            let sizes = [0x23, 0x2B, 0x2F, 0x23];
            let high = parameters[usize::from(index >> 5)];
            let command = sizes[usize::from(size & 3)];
            let [n0, n1, n2] = number;
            let value = [n0, n1, size >> 2, n2];
            let address = [index & 0x1F, high, sub_index & 0xF];
            receive(board, server, &[&[command], &address[..], &value].concat());
        }
        10 => receive(board, server, &[0x23, 0x10, 0x10, data[0] % 4, b's', b'a', b'v', b'e']),
        11 if data[0] & 3 == 0 => {
            receive(board, server, &[0x23, 0x11, 0x10, data[1] % 4, b'l', b'o', b'a', b'd']);
        }
        11 => board.node.application_mut().position ^= i32::from(data[1]),
        12 if !board.is_storing() => {}
        12 if data[0] == 0 => _ = board.end_store(Err(StoreError::MediumAccess)),
        12 => _ = board.finish_store(),
        13 => _ = board.acknowledge(if data[0] & 1 == 0 { Service::BootUp } else { Service::Emergency }),
        14 => _ = board.node.report(u16::from(data[0]), data[1], [0; 5]),
        _ => _ = board.be_late_ms(u64::from(data[0]) * 250),
    }
    board.pass_us(0);
}

/// A reset of communication leads to the COB-IDs of a power cycle, which takes all that is stored.
fn check(board: &mut Board) {
    board.nmt("82 00");
    let is_undisturbed = !board.is_quiet && board.node.nmt_state() == State::PreOperational;
    let (node_id, receives) = (board.node.node_id(), board.node.receives());
    let parameters = board.stored_parameters().to_vec();
    board.restart();
    assert_eq!(board.stored_parameters(), parameters, "they were stored");
    if is_undisturbed && board.node.node_id() == node_id {
        assert!(receives.iter().eq(board.node.receives().iter()), "{receives:?}");
    }
}

fuzz_target!(|steps: Vec<[u8; 10]>| {
    let mut board = new_board();
    steps.into_iter().for_each(|data| step(&mut board, data));
    check(&mut board);
});
