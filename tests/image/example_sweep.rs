//! The example `io` and the node in the process, asked the same: every object with every kind of value, by right and
//! wrong transfers.

use canopen_node::Frame;
use example_io::application as io;
use testkit::{
    flash::BoardFlash,
    image::example,
    node_rig::{self, NodeRig},
    sdo_messages::{block_download, block_upload, download, initiate, upload},
};

use crate::rig::*;

const NODE_ID: u8 = 0x40;
const ANSWER: u16 = 0x580 + NODE_ID as u16;

/// A board with the example and a core that is `slowdown` times slower.
fn board(slowdown: u8) -> ImageRig {
    let variant = chip(ChipVariant { slowdown, ..ChipVariant::default() });
    let mut board = Board::new(PART, example(), variant);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]));
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    rig.collect(Time::from_ms(50));
    rig
}

/// A board and its model.
struct Pair {
    rig: ImageRig,
    model: NodeRig<io::Application>,
}

impl Pair {
    fn new() -> Self {
        let device = node_rig::device(node_rig::ADDRESS)
            .with_name("LSS slave")
            .with_versions("1.0", "0.1.0")
            .with_defaults(*settings(0xFF, BitRate::Kbit1000))
            .with_heartbeat_ms(1000);
        let content = flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]);
        let flash = BoardFlash::with_content(content, 0);
        let mut model = NodeRig::with_application(device, flash, 0, io::Application::new());
        model.take_actions();
        Self { rig: board(1), model }
    }

    /// Sends a request to both, and compares what their SDO servers answer.
    fn ask(&mut self, request: [u8; 8]) {
        let frame = Frame::new(0x600 + u16::from(NODE_ID), &request).expect("a frame");
        let is_answer = |answer: &&Frame| answer.cob_id() == ANSWER;
        let expected: Vec<Frame> =
            self.model.receive(&frame).0.iter().filter(is_answer).copied().collect();
        self.rig.queue(&frame);
        let span = Time::from_us(600) + Time::from_us(150) * expected.len() as u64;
        let mut sent: Vec<Frame> =
            self.rig.collect(span).0.iter().filter(is_answer).copied().collect();
        while sent.len() < expected.len() {
            let (_, more) = self.rig.next_frame();
            assert!(!more.0.is_empty(), "{frame:?}: {sent:?}, not {expected:?}");
            sent.extend(more.0.iter().filter(is_answer));
        }
        assert_eq!(sent, expected, "{frame:?}");
    }
}

/// The objects, but those that a store or a chip decides: 1010h, 1011h, 1018h, 6401h. The last one does not exist.
fn indices() -> impl Iterator<Item = u16> {
    let single = [0x1000, 0x1001, 0x1003, 0x1008, 0x1014, 0x1015, 0x1016, 0x1017, 0x1020, 0x1029];
    let pdos = [0x1400, 0x1600, 0x1800, 0x1A00].into_iter().flat_map(|first| first..=first + 4);
    let of_application = [0x2100, 0x2101, 0x2101, 0x2102, 0x2103, 0x6000, 0x6200, 0x6426, 0xFFFF];
    (0x1005..=0x1007).chain(single).chain(pdos).chain(of_application)
}

/// Numbers that are a limit of some object.
const LIMITS: [u32; 18] =
    [0, 1, 2, 3, 9, 64, 65, 240, 241, 253, 254, 255, 0x80, 0x181, 0x580, 0x701, 0x7FF, 0x800];
/// COB-IDs with other bits, and entries of mappings, legal ones and others.
const COB_IDS: [u32; 4] = [0x4000_0081, 0x8000_0181, 0xA000_0000, u32::MAX];
const ENTRIES: [u32; 10] = [
    0x6000_0108,
    0x6200_0108,
    0x6401_0110,
    0x6200_0110,
    0x2100_0008,
    0x2103_0108,
    0x2103_0208,
    0x0005_0008,
    0x0007_0020,
    0x1F00_0108,
];
/// Commands of every service, some of them in no place of any transfer.
const COMMANDS: [u8; 26] = [
    0x00, 0x01, 0x0F, 0x11, 0x20, 0x21, 0x22, 0x40, 0x60, 0x70, 0x80, 0x81, 0xA0, 0xA1, 0xA2, 0xA3,
    0xA4, 0xC0, 0xC1, 0xC2, 0xC4, 0xC6, 0xD0, 0xD1, 0xE0, 0xFF,
];

/// A transfer by one of the services to or from an object.
fn transfer(random: &mut Random, indices: &[u16]) -> Vec<[u8; 8]> {
    let address = (random.pick(indices), random.pick(&[0, 1, 1, 2, 3, 3, 4, 5, 6, 8, 9]));
    let value = match random.within(0..30) {
        0..18 => random.pick(&LIMITS),
        18..22 => random.pick(&COB_IDS),
        _ => random.pick(&ENTRIES),
    };
    let data: Vec<u8> = match random.within(0..3) {
        0 => value.to_le_bytes()[..random.pick(&[1, 2, 4])].to_vec(),
        1 => random.bytes::<8>().to_vec(),
        _ => vec![0x41; random.within(1..19) as usize],
    };
    let (blocks, segments) = (random.pick(&[1, 1, 2]), random.within(0..4) as u8);
    match random.within(0..9) {
        // One, two and four bytes; the size that fits is one of them.
        0..4 => [0x2F, 0x2B, 0x23, 0x40].map(|command| initiate(command, address, value)).to_vec(),
        4 => download(address, &data),
        5 => block_download(address, &data),
        6 => upload(address, segments),
        7 => block_upload(address, random.pick(&[0, 1, 2, 127, 128]), blocks, segments),
        _ => configure_pdo(random),
    }
}

/// The requests that change the mapping of a PDO, and read it.
fn configure_pdo(random: &mut Random) -> Vec<[u8; 8]> {
    let pdo = random.pick(&[0x1400, 0x1800]) + random.within(0..5) as u16;
    let entries: Vec<u32> = ENTRIES.into_iter().chain([0x1001_0008, 0, u32::MAX]).collect();
    let same = random.pick(&entries);
    let is_uniform = random.one_in(3);
    let mapping: Vec<u32> = (0..random.within(0..10))
        .map(|_| if is_uniform { same } else { random.pick(&entries) })
        .collect();
    let mapped = |sub_index| (pdo + 0x200, sub_index);
    let mut requests = vec![initiate(0x23, (pdo, 1), 0x8000_0123), initiate(0x2F, mapped(0), 0)];
    requests.extend((1..).zip(&mapping).map(|(at, entry)| initiate(0x23, mapped(at), *entry)));
    let number = if random.one_in(4) { random.within(0..11) } else { mapping.len() as u64 };
    requests.push(initiate(0x2F, mapped(0), number as u32));
    requests.extend([0x123, 0x124, 0x4000_0123].map(|id| initiate(0x23, (pdo, 1), id)));
    requests.extend((0..10).map(|sub_index| initiate(0x40, mapped(sub_index), 0)));
    requests
}

/// Half of the transfers have a fault: a message is lost, doubled, changed, or another request comes in between.
fn with_fault(random: &mut Random, mut transfer: Vec<[u8; 8]>) -> Vec<[u8; 8]> {
    let at = random.within(0..transfer.len() as u64) as usize;
    match random.within(0..10) {
        0 => _ = transfer.remove(at),
        1 => transfer.insert(at, transfer[at]),
        2 => transfer[at][0] = random.pick(&COMMANDS),
        // Not in the index: the identity of the board is not that of the model.
        3 => transfer[at][random.pick(&[0, 3, 4, 5, 7])] ^= 1 << random.within(0..8),
        4 => transfer.insert(at, initiate(0x40, (0x1017, 0), 0)),
        _ => {}
    }
    transfer
}

#[test]
fn random_transfers_right_and_wrong_are_answered_as_by_the_node_in_the_process() {
    let mut random = Random::from_environment();
    let indices: Vec<u16> = indices().collect();
    let mut pair = Pair::new();
    for _ in 0..6_000 / every(4) {
        let transfer = transfer(&mut random, &indices);
        for request in with_fault(&mut random, transfer) {
            pair.ask(request);
        }
        pair.ask([0x80, 0, 0, 0, 0, 0, 0, 0]);
    }
}

#[test]
fn a_client_may_confirm_a_block_while_it_is_sent() {
    // The slow core leaves the bus to the client after two segments.
    let mut rig = board(10);
    rig.transmit(on_the_wire(&sdo::request(NODE_ID, "A4 02 21 00 7F 00")));
    rig.collect(Time::from_ms(2));
    rig.transmit(on_the_wire(&sdo::request(NODE_ID, "A3")));
    let (_, first) = rig.next_frame();
    rig.queue(&sdo::request(NODE_ID, "A2 02 7F"));
    let (_, second) = rig.next_frame();
    let (_, third) = rig.next_frame();
    let number = |frames: &Frames| frames.0[0].data()[0];
    assert_eq!((number(&first), number(&second), number(&third)), (1, 2, 1), "it goes on behind");
    assert_ne!(first.0[0].data()[1..], third.0[0].data()[1..]);
    rig.transmit(on_the_wire(&sdo::request(NODE_ID, "80 02 21 00")));
    rig.collect(Time::from_ms(5));
}
