//! Sessions with the release image of the product on an emulated board.

use std::{env, sync::LazyLock};

use @crate@::device::{self, DEVICE};
use emulator::{
    Time,
    board::{Board, Settings},
    can::Clock,
    chip::ChipVariant,
};
use canopen_node::BitRateSetting;
use testkit::{
    boards,
    frames::{SILENCE, number},
    image::Product,
    image_rig::ImageRig,
    sdo::Client,
};

/// The release image, with the chip of Cargo.toml and the controller of src/pins.rs.
static PRODUCT: LazyLock<Product> = LazyLock::new(|| {
    let directory = env::var("CARGO_MANIFEST_DIR").expect("cargo runs this");
    Product::build(&directory, env!("CARGO_PKG_NAME")).unwrap_or_else(|error| panic!("{error}"))
});

/// A new board, which has stored nothing.
fn new_board() -> ImageRig {
    let BitRateSetting::Fixed(bit_rate) = DEVICE.defaults.bit_rate else {
        panic!("the master needs a bit rate");
    };
    let settings = Settings {
        crystal: Clock { hz: device::CRYSTAL_HZ, ppm: 0 },
        chip_variant: ChipVariant {
            external_clock: device::CRYSTAL_IS_EXTERNAL_CLOCK,
            ..ChipVariant::default()
        },
        unique_id: boards::unique_id(0),
        controller: PRODUCT.controller.into(),
        // A peripheral that the emulator does not model is a line of the report, and no failure.
        tolerates_unmodelled: true,
        ..Settings::default()
    };
    ImageRig::new(bit_rate, [Board::new(PRODUCT.part, &PRODUCT.image, settings)])
}

/// Gives the board the node-ID 5 over LSS, and lets it store that.
fn commission(rig: &mut ImageRig) {
    assert_eq!(rig.lss("04 01"), SILENCE);
    assert_eq!(rig.lss("11 05"), ["11 00"]);
    assert_eq!(rig.lss("17"), ["17 00"]);
    assert_eq!(rig.lss("04 00"), ["705: 00"]);
}

#[test]
fn a_master_finds_the_product_by_its_lss_address() {
    let mut rig = new_board();
    let address = DEVICE.with_serial_number(boards::serial_number(0)).address;
    let [vendor, product, revision, serial] = [
        address.vendor_id,
        address.product_code,
        address.revision_number,
        address.serial_number,
    ]
    .map(number);
    assert_eq!(rig.lss(&format!("40 {vendor}")), SILENCE);
    assert_eq!(rig.lss(&format!("41 {product}")), SILENCE);
    assert_eq!(rig.lss(&format!("42 {revision}")), SILENCE);
    assert_eq!(rig.lss(&format!("43 {serial}")), ["44"]);
}

#[test]
fn the_node_id_survives_a_power_cycle() {
    let mut rig = new_board();
    commission(&mut rig);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(5)), ["705: 00"]);
}

#[test]
fn the_product_has_its_name() {
    let mut rig = new_board();
    commission(&mut rig);
    let name = rig.sdo_client(5).upload(0x1008, 0);
    assert_eq!(name.as_deref(), Ok(DEVICE.name.as_bytes()));
}

#[test]
fn the_brightness_keeps_its_limits_and_survives_a_power_cycle() {
    let mut rig = new_board();
    commission(&mut rig);
    let mut master = rig.sdo_client(5);
    assert_eq!(master.upload(0x2100, 0), Ok(vec![50]));
    assert_eq!(master.download(0x2100, 0, &[101]), Err(0x0609_0031));
    assert_eq!(master.download(0x2100, 0, &[80]), Ok(()));
    assert_eq!(master.download(0x1010, 1, b"save"), Ok(()));
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(5)), ["705: 00"]);
    assert_eq!(rig.sdo_client(5).upload(0x2100, 0), Ok(vec![80]));
}
