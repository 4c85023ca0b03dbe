//! Storms: random frames of every kind, from valid requests to noise, and their permitted effects.

mod example;
pub mod image;

use std::collections::VecDeque;

use canopen_node::{Application, BitRate, application::NoApplication, lss};
use emulator::{
    Time,
    can::{Frame, Id},
};

use super::{
    random::Random,
    sdo_messages::{Address, block_download, download, expedited, initiate},
};

const LSS: Id = Id::Standard(lss::REQUEST_COB_ID);
const NMT: Id = Id::Standard(0x000);
const SDO_COB_ID: u16 = 0x600;
/// The node-ID that a script gives to a node without one.
const NODE_ID: u8 = 0x40;

/// Command specifiers of requests; those with large effects are rarer.
const COMMANDS: [u8; 36] = [
    0x04, 0x04, 0x04, 0x04, 0x04, 0x04, 0x11, 0x11, 0x13, 0x13, 0x15, 0x17, 0x40, 0x41, 0x42, 0x43,
    0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B, 0x4C, 0x4C, 0x51, 0x51, 0x51, 0x51, 0x5A, 0x5B, 0x5C, 0x5D,
    0x5E, 0x5E, 0x44, 0x50,
];
const NMT_COMMANDS: [u8; 5] = [0x01, 0x02, 0x80, 0x82, 0x81];
const SDO_COMMANDS: [u8; 12] =
    [0x40, 0x40, 0x40, 0x60, 0x70, 0x23, 0x2B, 0x2F, 0x21, 0x00, 0x01, 0x80];
const OBJECTS: [u16; 11] =
    [0x1000, 0x1001, 0x1003, 0x1008, 0x100A, 0x1010, 0x1011, 0x1017, 0x1018, 0x1029, 0x2000];

/// The node in the storm, as described to the generator of meaningful frames.
struct Target {
    /// Vendor-ID, product code, revision number, serial number.
    address: [u32; 4],
    /// The active node-ID; 0: none.
    node_id: u8,
}

/// An application in a storm.
pub trait Stormed: Application + Clone {
    /// The longest time from the start of a board to the first sample of its inputs.
    const FIRST_SAMPLE: Time = Time::ZERO;

    /// Frames for the objects and the process data of the application on this node, in this order; node-ID 0: none.
    fn script(_: &mut Random, _node_id: u8) -> Vec<Frame> {
        Vec::new()
    }

    /// Requests that end the effects of time on the process data of a node after its boot-up.
    fn end_times(_node_id: u8) -> Vec<Frame> {
        Vec::new()
    }

    /// The same frame, or another in place of one whose effects would depend on time or on the board.
    fn without_time(_: &mut Random, frame: Frame, _node_id: u8) -> Frame {
        frame
    }
}

/// The plain firmware has only what every node has: the random frames are enough.
impl Stormed for NoApplication {}

/// The next frame: of the script under way, or a random one.
fn next<A: Stormed>(random: &mut Random, script: &mut VecDeque<Frame>, target: &Target) -> Frame {
    if script.is_empty() && random.one_in(4) {
        script.extend(A::script(random, target.node_id));
    }
    if script.is_empty() || random.one_in(16) {
        return frame(random, target);
    }
    script.pop_front().expect("it is not empty")
}

/// The LSS requests that give a node its node-ID.
fn commissioning() -> Vec<Frame> {
    let requests = [[0x04, 0x01], [0x11, NODE_ID], [0x04, 0x00]];
    requests
        .iter()
        .map(|[command, value]| Frame::data(LSS, &[*command, *value, 0, 0, 0, 0, 0, 0]))
        .collect()
}

fn download_by_any_service(random: &mut Random, address: Address, data: &[u8]) -> Vec<[u8; 8]> {
    match random.within(0..3) {
        0 if data.len() <= 4 => vec![expedited(address, data)],
        1 => block_download(address, data),
        _ => download(address, data),
    }
}

/// A store of the parameters, or their defaults.
fn save_or_load(random: &mut Random) -> Vec<[u8; 8]> {
    let sub_index = random.pick(&[1, 2, 3]);
    let (index, signature) = random.pick(&[(0x1010, *b"save"), (0x1011, *b"load")]);
    vec![initiate(0x23, (index, sub_index), u32::from_le_bytes(signature))]
}

fn server(node_id: u8) -> Id {
    Id::Standard(SDO_COB_ID + u16::from(node_id))
}

fn to_server(node_id: u8, message: &[u8; 8]) -> Frame {
    Frame::data(server(node_id), message)
}

/// A random frame: a valid or nearly valid request of LSS, NMT or SDO, or noise.
fn frame(random: &mut Random, target: &Target) -> Frame {
    match random.within(0..20) {
        0..9 => lss_request(random, target),
        9..11 => nmt_command(random, target),
        11..14 => sdo_request(random, target),
        14..17 => nearly(random, target),
        _ => anything(random),
    }
}

fn lss_request(random: &mut Random, target: &Target) -> Frame {
    let mut data = random.bytes::<8>();
    data[0] = random.pick(&COMMANDS);
    if random.one_in(20) {
        return Frame::data(LSS, &data);
    }
    let number = match data[0] {
        0x40..=0x51 => address_number(random, &mut data, target.address),
        0x04 => random.within(0..2) as u32,
        0x11 => random.pick(&[0x01, 0x04, 0x40, 0x7F, 0xFF, 0xFF, 0xFF, 0x00, 0x80]),
        0x13 => u32::from(random.within(0..11) as u8) << 8 | u32::from(random.one_in(8)),
        0x15 => random.pick(&[0, 0, 1, 2, 3]),
        _ => random.u32(),
    };
    data[1..5].copy_from_slice(&number.to_le_bytes());
    Frame::data(LSS, &data)
}

/// The correct number for a request that compares it with the LSS address `address`, and the comparison for Fastscan.
fn address_number(random: &mut Random, data: &mut [u8; 8], address: [u32; 4]) -> u32 {
    let [vendor, product, revision, serial] = address;
    match data[0] {
        0x40 | 0x46 => vendor,
        0x41 | 0x47 => product,
        0x42 | 0x48 | 0x49 => revision,
        0x43 | 0x4A | 0x4B => serial,
        0x51 => {
            data[5] = random.pick(&[0x80, 0, 0, 31, 16]);
            data[6] = random.within(0..4) as u8;
            data[7] = random.within(0..4) as u8;
            address[usize::from(data[6])]
        }
        _ => random.u32(),
    }
}

fn nmt_command(random: &mut Random, target: &Target) -> Frame {
    // A reset of the node takes longer than a hundred frames.
    let commands = if random.one_in(12) { &NMT_COMMANDS[..] } else { &NMT_COMMANDS[..4] };
    let other = random.byte();
    let node_id = random.pick(&[0, target.node_id, other]);
    Frame::data(NMT, &[random.pick(commands), node_id])
}

fn sdo_request(random: &mut Random, target: &Target) -> Frame {
    let mut data = random.bytes::<8>();
    data[0] = random.pick(&SDO_COMMANDS);
    data[1..3].copy_from_slice(&random.pick(&OBJECTS).to_le_bytes());
    data[3] = random.within(0..5) as u8;
    if random.one_in(2) {
        data[4..].copy_from_slice(random.pick(&[b"save", b"load", b"\x64\0\0\0", b"\0\0\0\0"]));
    }
    to_server(target.node_id, &data)
}

/// A meaningful frame with one thing changed.
fn nearly(random: &mut Random, target: &Target) -> Frame {
    let mut frame = match random.within(0..3) {
        0 => lss_request(random, target),
        1 => nmt_command(random, target),
        _ => sdo_request(random, target),
    };
    let Id::Standard(id) = frame.id else { return frame };
    match random.within(0..6) {
        0 => frame = frame.with_dlc(random.within(0..16) as u8),
        1 => frame.id = Id::Extended(id.into()),
        2 => frame.id = Id::Extended(u32::from(id) << 18),
        3 => frame.id = Id::Standard(id ^ 1 << random.within(0..11)),
        4 => return Frame::remote(frame.id, frame.dlc),
        _ => {
            let byte = random.within(0..u64::from(frame.dlc)) as usize;
            frame.data[byte] ^= 1 << random.within(0..8);
        }
    }
    clean(frame)
}

fn anything(random: &mut Random) -> Frame {
    let id = match random.within(0..4) {
        0 => Id::Extended(random.u32() >> 3),
        1 => LSS,
        _ => Id::Standard(random.within(0..0x800) as u16),
    };
    let dlc = random.within(0..16) as u8;
    if random.one_in(8) {
        return Frame::remote(id, dlc);
    }
    clean(Frame::data(id, &random.bytes::<8>()).with_dlc(dlc))
}

/// Bytes that are not sent are 0.
fn clean(mut frame: Frame) -> Frame {
    (usize::from(frame.dlc.min(8))..8).for_each(|unused| frame.data[unused] = 0);
    frame
}

/// The LSS request in `frame`, if there is one: command specifier and parameters.
fn lss_data(frame: &Frame) -> Option<[u8; 8]> {
    (frame.id == LSS && !frame.remote && frame.dlc == 8).then_some(frame.data)
}

/// Whether only PDOs may have the COB-ID of `frame` (CiA 301, 7.3.5).
fn is_pdo(frame: &canopen_node::Frame) -> bool {
    matches!(frame.cob_id(), 0x180..=0x57F | 0x680..=0x6DF)
}

/// The bit rate of the storm.
const RATE: BitRate = BitRate::Kbit1000;
