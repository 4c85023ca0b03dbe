//! SDO block transfer with the release image of the example `io`: its share of the bus.
//!
//! `cargo test --test image block_transfer:: -- --nocapture` prints the shares.

use example_io::application as io;
use testkit::image::example;

use crate::rig::*;

/// The transfer test of the example, a domain of 100,000 bytes.
const TRANSFER_TEST: u16 = 0x2102;
const NODE_ID: u8 = 1;
const INVALID_VALUE: u32 = 0x0609_0030;
const TOO_LONG: u32 = 0x0607_0012;
const TOO_SHORT: u32 = 0x0607_0013;

fn board() -> ImageRig {
    let settings = settings(NODE_ID, BitRate::Kbit1000);
    let mut rig = ImageRig::new(BitRate::Kbit1000, [example_board(settings)]);
    rig.collect(Time::from_ms(20));
    rig
}

fn content() -> Vec<u8> {
    io::test_content(0).collect()
}

/// Prints the speed of a transfer of the whole domain; returns the share of the bus in percent.
fn share<T>(
    name: &str,
    rig: &mut ImageRig,
    transfer: impl FnOnce(&mut SdoClient<'_>) -> T,
) -> (T, u64) {
    let from = rig.network.now();
    let result = transfer(&mut rig.sdo_client(NODE_ID));
    let until = rig.network.now();
    let share = rig.bus_load(from..until);
    let kbytes_per_s = content().len() as u64 * 1_000 / (until - from).as_us();
    println!("block {name}: {share} % of the bus, {kbytes_per_s} KB/s");
    (result, share)
}

#[test]
fn a_domain_of_100_kb_fills_the_bus_both_ways() {
    let mut rig = board();
    assert_eq!(content().len(), 100_000);
    let (uploaded, upload) =
        share("upload", &mut rig, |client| client.block_upload(TRANSFER_TEST, 0, 127));
    assert!(uploaded == Ok(content()));
    let (downloaded, download) =
        share("download", &mut rig, |client| client.block_download(TRANSFER_TEST, 0, &content()));
    assert_eq!(downloaded, Ok(()));
    assert!(upload >= 95 && download >= 97, "{upload} %, {download} %");
}

#[test]
fn a_domain_with_a_wrong_byte_or_length_is_refused() {
    let mut rig = board();
    let mut wrong = content();
    wrong[500] ^= 1;
    let long = [content(), vec![0]].concat();
    for (data, code) in
        [(&content()[..1_000], TOO_SHORT), (&wrong, INVALID_VALUE), (&long, TOO_LONG)]
    {
        let mut client = rig.sdo_client(NODE_ID);
        assert_eq!(client.block_download(TRANSFER_TEST, 0, data), Err(code));
        // The rest of the block follows the abort, and is refused.
        rig.collect(Time::from_ms(50));
    }
}

#[test]
fn a_client_may_confirm_a_block_while_it_is_sent() {
    // The slow core leaves the bus to the client after two segments.
    let variant = chip(ChipVariant { slowdown: 10, ..ChipVariant::default() });
    let mut board = Board::new(PART, example(), variant);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]));
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    rig.collect(Time::from_ms(50));
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
}
