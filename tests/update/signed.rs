//! A loader that takes only signed programs.

use std::sync::LazyLock;

use canopen_node::Frame;
use emulator::{
    Time,
    board::{self, Board},
    image::Image,
};
use program_update::header::Field;
use testkit::{
    boards,
    image_rig::{ImageRig, SETTINGS_OFFSET},
    product,
    update::{self, SigningKey},
};

use super::rig::{NODE, PART, RATE, Rig, device, stored, with_version};

fn key() -> SigningKey {
    SigningKey::from_bytes(&[9; 32])
}

static IMAGES: LazyLock<[Image; 2]> = LazyLock::new(|| {
    let public = key().verifying_key().to_bytes();
    product::build_signed("signed-lamp", PART, 1, &public).unwrap_or_else(|error| panic!("{error}"))
});

/// The update file of the program with this version, signed with this key.
fn file(version: &'static str, key: &SigningKey) -> Vec<u8> {
    let program = with_version(&IMAGES[1], version);
    update::signed_file(&program, &device(version), PART, 1, key).expect("it fits")
}

/// A board with the version 0.1.0 in its loader, which has cleared RUN.
fn cleared() -> Rig {
    let image = update::factory(&IMAGES[0], &file("0.1.0", &key()));
    let settings = board::Settings { unique_id: boards::unique_id(0), ..Default::default() };
    let mut board = Board::new(PART, &image, settings);
    board.set_flash(SETTINGS_OFFSET, &stored());
    let mut rig = Rig(ImageRig::new(RATE, [board]), Time::from_ms(500));
    rig.0.network.permit_misuse();
    assert_eq!(rig.version(), "0.1.0");
    rig.stop_and_clear();
    rig
}

#[test]
#[ignore = "builds a loader with signatures: `.ci/run chips`"]
fn a_signed_program_is_installed_while_the_loader_answers_lss_in_10_us() {
    let mut rig = cleared();
    rig.0.transmit_request("04 01");
    let [by, _] = rig.0.add_others(RATE);
    let from = rig.0.network.now();
    super::busy::flood(&mut rig, by, 3_000);
    let stalls = rig.0.network.board(0).flash_stalls();
    let file = file("0.2.0", &key());
    let downloads = rig.0.network.now();
    assert!(rig.try_download(&file).unwrap(), "status {:X}", rig.number(0x1F57, 1));
    println!("{} bytes in {} ms", file.len(), (rig.0.network.now() - downloads).as_ms());
    rig.0.network.adapter_mut(by).close();
    rig.0.network.run_for(Time::from_ms(5));
    let (slowest, _) = super::busy::slowest_answer(&rig, from);
    println!("LSS answers within {} ns", slowest.as_ps() / 1000);
    assert!(slowest < Time::from_us(10), "{} ns", slowest.as_ps() / 1000);
    assert!(rig.0.network.board(0).flash_stalls() == stalls, "it has waited for the flash");
    rig.0.transmit_request("04 00");
    rig.start();
    assert_eq!((rig.version().as_str(), rig.number(0x2001, 1)), ("0.2.0", 2));
    assert_eq!(rig.control(0x80), Ok(()));
    rig.0.power_cycle(0);
    rig.0.expect(&format!("7{NODE:02X}: 00"), Time::from_ms(100));
    assert_eq!(rig.version(), "0.2.0");
    rig.check_settings();
}

#[test]
#[ignore = "builds a loader with signatures: `.ci/run chips`"]
fn a_program_with_another_signature_or_none_is_refused_before_a_word_is_written() {
    const REFUSED: u32 = (Field::Signature as u32) << 16 | 2 << 1;
    const NOT_STORED: [u8; 4] = 0x0800_0020_u32.to_le_bytes();
    let other_key = SigningKey::from_bytes(&[10; 32]);
    let mut unsigned = file("0.2.0", &key());
    unsigned[Field::Signature as usize..Field::Rest as usize].fill(0xFF);
    let mut rig = cleared();
    let operations = rig.operations();
    for file in [file("0.2.0", &other_key), unsigned] {
        let from = rig.0.network.now();
        assert!(!rig.try_download(&file).unwrap());
        rig.0.network.run_for(Time::from_ms(1));
        let abort = [&[0x80, 0x50, 0x1F, 1][..], &NOT_STORED].concat();
        let abort = Frame::new(0x580 + u16::from(NODE), &abort).expect("eight bytes");
        let aborts =
            rig.0.sent(from).filter(|sent| sent.frame == testkit::wire::on_the_wire(&abort));
        let ends: Vec<Time> = aborts.map(|sent| sent.end).collect();
        let [end] = ends[..] else { panic!("{} aborts", ends.len()) };
        println!("refused after {} ms", (end - from).as_ms());
        assert_eq!(rig.number(0x1F57, 1), REFUSED);
        assert_eq!(rig.operations(), operations, "something was written");
    }
    rig.0.transmit_command("81 05");
    rig.0.network.run_for(Time::from_ms(20));
    rig.revive();
    assert_eq!(rig.version(), "0.1.0");
    rig.check_settings();
}
