//! The example application `io` in a storm: its objects by every SDO service, its PDOs, its stored parameters and the
//! heartbeat that it watches.

use canopen_node::Application as _;
use emulator::{
    Time,
    can::{Frame, Id},
};
use example_io::application::{Application, test_content};

use super::{
    NMT, Stormed, commissioning, download_by_any_service, save_or_load, server, to_server,
};
use crate::{
    random::Random,
    sdo_messages::{Address, block_upload, initiate, upload},
};

const SYNC: Id = Id::Standard(0x080);
/// The node whose heartbeat is watched, and the longest time that the node waits for it.
const PRODUCER: u8 = 0x0A;
const LONGEST_WAIT_MS: u16 = u16::MAX;
/// Objects that a client can read.
const READABLE: [Address; 12] = [
    (0x1000, 0),
    (0x1005, 0),
    (0x1008, 0),
    (0x1010, 1),
    (0x1016, 1),
    (0x1018, 4),
    (0x1400, 1),
    (0x1A00, 1),
    (0x2101, 2),
    (0x2101, 3),
    (0x6200, 1),
    (0x6401, 1),
];
const TRANSFER_TEST: Address = (0x2102, 0);
/// Values that can be mapped into TPDOs and RPDOs, as mapping entries; the last of each is wrong there.
const TRANSMITTED: [u32; 4] = [0x6000_0108, 0x2103_0208, 0x6401_0110, 0x0007_0020];
const RECEIVED: [u32; 5] = [0x6200_0108, 0x2103_0108, 0x0005_0008, 0x0007_0020, 0x6000_0108];

impl Stormed for Application {
    const FIRST_SAMPLE: Time = Time::from_ms(12);

    fn script(random: &mut Random, node_id: u8) -> Vec<Frame> {
        if node_id == 0 {
            return commissioning();
        }
        let messages = match random.within(0..16) {
            0..7 => {
                let start = Frame::data(NMT, &[0x01, node_id]);
                let count = random.within(1..12);
                let rest = (0..count).map(|_| process_data(random, node_id));
                return [start].into_iter().chain(rest).collect();
            }
            7..9 => download_a_value(random),
            9..11 => upload_a_value(random),
            11..13 => configure_pdo(random, node_id),
            13 => configure_communication(random),
            _ => save_or_load(random),
        };
        messages.iter().map(|message| to_server(node_id, message)).collect()
    }

    fn end_times(node_id: u8) -> Vec<Frame> {
        // TPDO 2 has an inhibit time and an event timer by default.
        let cob_id = 0x4000_0280 + u32::from(node_id);
        let messages = [
            initiate(0x23, (0x1801, 1), cob_id | 0x8000_0000),
            initiate(0x2B, (0x1801, 3), 0),
            initiate(0x2B, (0x1801, 5), 0),
            initiate(0x23, (0x1801, 1), cob_id),
        ];
        messages.iter().map(|message| to_server(node_id, message)).collect()
    }

    fn without_time(random: &mut Random, frame: Frame, node_id: u8) -> Frame {
        let is_request = frame.id == server(node_id) && !frame.remote && frame.dlc == 8;
        let [command, i0, i1, sub_index, ..] = frame.data;
        let index = u16::from_le_bytes([i0, i1]);
        let is_download = matches!(command >> 5, 1 | 6);
        let read = initiate(0x40, (index, sub_index), 0);
        let message = match (index, sub_index) {
            _ if !is_request => return frame,
            // The controller's observations, whose answers are left out by their index, which a block does not have.
            (0x1001 | 0x1003 | 0x2000, _) => read,
            _ if !is_download => return frame,
            // A heartbeat that is missed, and the times of PDOs.
            (0x1016, 1) => consumer_heartbeat_time(random),
            (0x1800..=0x1803, 3 | 5) | (0x1400..=0x1403, 5) | (0x1007, 0) => read,
            // Emergency messages, which another time or another frame's COB-ID would change.
            (0x1014 | 0x1015, 0) => read,
            // What the next sample of the temperature changes.
            (0x2101 | 0x6426, 1) => read,
            // A TPDO has no COB-ID of another frame of the storm: both would be destroyed on the bus.
            (0x1800..=0x1803, 1) => tpdo_cob_id(random, node_id, index),
            _ => return frame,
        };
        to_server(node_id, &message)
    }
}

/// A SYNC, an RPDO or a heartbeat.
fn process_data(random: &mut Random, node_id: u8) -> Frame {
    match random.within(0..8) {
        0..3 => Frame::data(SYNC, &[]),
        3 => Frame::data(SYNC, &[random.pick(&[1, 2, 3, 240])]),
        4 => Frame::data(Id::Standard(0x700 + u16::from(PRODUCER)), &[random.pick(&[0, 5, 127])]),
        _ => {
            let pdo = random.within(0..Application::RPDOS.len() as u64) as u16;
            let cob_id = random.pick(&cob_ids(0x200, pdo, node_id));
            let data = [random.byte() & 7, random.byte(), 0, 0, 0, random.byte(), 0, 0];
            let len = random.pick(&[0, 1, 1, 2, 5, 6, 8]);
            Frame::data(Id::Standard(cob_id), &data[..len])
        }
    }
}

/// The COB-IDs of a PDO: that of the predefined connection set, and one that no other frame of the storm has.
fn cob_ids(base: u16, pdo: u16, node_id: u8) -> [u16; 2] {
    [base + 0x100 * pdo + u16::from(node_id), base + 0x100 * pdo + 0x70]
}

/// A download by one of the three services.
fn download_a_value(random: &mut Random) -> Vec<[u8; 8]> {
    let (address, data) = match random.within(0..6) {
        0 => ((0x2100, 0), vec![random.byte() % 10]),
        1 => ((0x2101, 2), random.bytes::<8>().to_vec()),
        2 => ((0x2101, 3), (0..random.within(1..18)).map(|_| random.byte() % 128).collect()),
        3 => (TRANSFER_TEST, test_content(0).take(random.within(1..200) as usize).collect()),
        4 => ((0x2103, 1), vec![random.byte()]),
        _ => ((0x6200, 1), vec![random.byte() % 5]),
    };
    download_by_any_service(random, address, &data)
}

/// An upload by one of the services.
fn upload_a_value(random: &mut Random) -> Vec<[u8; 8]> {
    let address = random.pick(&READABLE);
    match random.within(0..6) {
        0 => vec![initiate(0x40, address, 0)],
        1 => upload(address, random.within(1..4) as u8),
        2 => upload(TRANSFER_TEST, random.within(1..20) as u8),
        3 => block_upload(address, random.pick(&[1, 2, 127]), 1, random.within(1..4) as u8),
        _ => {
            let block_size = random.within(1..40) as u8;
            let in_last_block = random.within(0..u64::from(block_size) + 2) as u8;
            block_upload(TRANSFER_TEST, block_size, random.within(1..4) as u8, in_last_block)
        }
    }
}

/// The requests that change a PDO: it is made invalid first and valid last.
fn configure_pdo(random: &mut Random, node_id: u8) -> Vec<[u8; 8]> {
    const NOT_VALID: u32 = 0x8000_0000;
    let is_tpdo = random.one_in(2);
    let (parameters, base, number, values) = if is_tpdo {
        (0x1800, 0x180, Application::TPDOS.len(), &TRANSMITTED[..])
    } else {
        (0x1400, 0x200, Application::RPDOS.len(), &RECEIVED[..])
    };
    let pdo = random.within(0..number as u64) as u16;
    let (parameter, mapping) = (parameters + pdo, parameters + pdo + 0x200);
    let cob_id = u32::from(random.pick(&cob_ids(base, pdo, node_id)));
    let transmission_type = random.pick(&[0, 1, 2, 240, 241, 254, 255, 255]);
    let entries = random.within(0..5) as u32;
    let mut messages = vec![
        initiate(0x23, (parameter, 1), cob_id | NOT_VALID),
        initiate(0x2F, (parameter, 2), transmission_type),
        initiate(0x2F, (parameter, 6), random.pick(&[0, 0, 2])),
        initiate(0x2F, (mapping, 0), 0),
    ];
    for entry in 1..=entries {
        messages.push(initiate(0x23, (mapping, entry as u8), random.pick(values)));
    }
    messages.push(initiate(0x2F, (mapping, 0), entries));
    messages.push(initiate(0x23, (parameter, 1), cob_id));
    messages
}

fn tpdo_cob_id(random: &mut Random, node_id: u8, parameter: u16) -> [u8; 8] {
    let cob_id = u32::from(random.pick(&cob_ids(0x180, parameter - 0x1800, node_id)));
    initiate(0x23, (parameter, 1), cob_id | random.pick(&[0, 0x4000_0000, 0x8000_0000]))
}

/// A change of SYNC, heartbeats or the behaviour after errors.
fn configure_communication(random: &mut Random) -> Vec<[u8; 8]> {
    let message = match random.within(0..5) {
        0 => initiate(0x23, (0x1005, 0), random.pick(&[0x80, 0x80, 0x90, 0x8000_0080])),
        1 => initiate(0x2F, (0x1019, 0), random.pick(&[0, 0, 1, 4, 240])),
        2 => initiate(0x2F, (0x1029, 1), random.pick(&[0, 1, 2, 3])),
        3 => initiate(0x2B, (0x1017, 0), random.pick(&[0, 100, 1000])),
        _ => consumer_heartbeat_time(random),
    };
    vec![message]
}

fn consumer_heartbeat_time(random: &mut Random) -> [u8; 8] {
    let time_ms = random.pick(&[0, LONGEST_WAIT_MS]);
    initiate(0x23, (0x1016, 1), u32::from(PRODUCER) << 16 | u32::from(time_ms))
}
