//! The plain firmware in a storm: its values by every SDO service.

use canopen_node::application::NoApplication;
use emulator::can::Frame;

use super::{Stormed, commissioning, download_by_any_service, save_or_load, to_server};
use crate::{
    random::Random,
    sdo_messages::{Address, block_upload, initiate, upload},
};

/// Values that a client can read: numbers, texts and one that does not exist.
const READABLE: [Address; 10] = [
    (0x1000, 0),
    (0x1008, 0),
    (0x1009, 0),
    (0x100A, 0),
    (0x1010, 1),
    (0x1017, 0),
    (0x1018, 4),
    (0x1029, 1),
    (0x1200, 1),
    (0x1200, 9),
];

impl Stormed for NoApplication {
    fn script(random: &mut Random, node_id: u8) -> Vec<Frame> {
        if node_id == 0 {
            return commissioning();
        }
        let messages = match random.within(0..8) {
            0 => save_or_load(random),
            1..4 => download_a_value(random),
            _ => upload_a_value(random),
        };
        messages.iter().map(|message| to_server(node_id, message)).collect()
    }
}

/// A download by one of the three services, sometimes with a wrong length.
fn download_a_value(random: &mut Random) -> Vec<[u8; 8]> {
    let (address, mut data) = match random.within(0..3) {
        0 => ((0x1017, 0), vec![random.pick(&[0, 100]), 0]),
        1 => ((0x1029, 1), vec![random.within(0..4) as u8]),
        _ => (random.pick(&READABLE), random.bytes::<4>().to_vec()),
    };
    if random.one_in(4) {
        data.resize(random.within(1..20) as usize, 0);
    }
    download_by_any_service(random, address, &data)
}

/// An upload by one of the three services.
fn upload_a_value(random: &mut Random) -> Vec<[u8; 8]> {
    let address = random.pick(&READABLE);
    match random.within(0..3) {
        0 => vec![initiate(0x40, address, 0)],
        1 => upload(address, random.within(1..4) as u8),
        _ => {
            let block_size = random.pick(&[1, 2, 127]);
            block_upload(address, block_size, random.within(1..4) as u8, random.within(1..4) as u8)
        }
    }
}
