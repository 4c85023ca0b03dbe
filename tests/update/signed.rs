//! A loader that takes only signed programs.

use std::{
    env, fs,
    process::{self, Command},
    sync::LazyLock,
};

use canopen_node::Frame;
use emulator::{
    Time,
    board::{self, Board},
    chip::ResetCause,
    image::Image,
};
use program_update::header::{Field, HEADER_LEN};
use testkit::{
    boards,
    cargo::{TARGET, workspace},
    image_rig::{ImageRig, SETTINGS_OFFSET},
    product, release,
    sdo::Client,
    update::{self, SigningKey},
};

use super::rig::{NODE, PART, RATE, Rig, device, stored, with_version};

const NOT_STORED: u32 = 0x0800_0020;
const DEVICE_STATE: u32 = 0x0800_0022;

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

/// A board with the version 0.1.0 in its loader.
fn stopped() -> Rig {
    of_image(&update::factory(&IMAGES[0], &file("0.1.0", &key())))
}

/// A board with this image in its loader.
fn of_image(image: &Image) -> Rig {
    let settings = board::Settings { unique_id: boards::unique_id(0), ..Default::default() };
    let mut board = Board::new(PART, image, settings);
    board.set_flash(SETTINGS_OFFSET, &stored());
    let mut rig = Rig(ImageRig::new(RATE, [board]), Time::from_ms(500));
    rig.0.network.permit_misuse();
    assert_eq!(rig.version(), "0.1.0");
    rig.0.network.allow_reset(0, ResetCause::Software);
    assert_eq!(rig.control(0), Ok(()));
    rig
}

/// The same, which has cleared RUN.
fn cleared() -> Rig {
    let mut rig = stopped();
    assert_eq!(rig.send_header(&file("0.2.0", &key())), Err(DEVICE_STATE));
    rig.clear();
    rig
}

impl Rig {
    /// Downloads the header of a file alone.
    fn send_header(&mut self, file: &[u8]) -> Result<(), u32> {
        self.client().block_download(0x1F50, 1, &file[..HEADER_LEN])
    }
}

#[test]
fn a_signed_loader_erases_nothing_before_it_has_a_header_that_is_signed_and_no_step_back() {
    let mut rig = stopped();
    let operations = rig.operations();
    let other_key = SigningKey::from_bytes(&[10; 32]);
    assert_eq!(rig.control(3), Err(DEVICE_STATE));
    for file in [file("0.2.0", &other_key), file("0.0.9", &key())] {
        assert_eq!(rig.send_header(&file), Err(NOT_STORED));
        assert_eq!(rig.control(3), Err(DEVICE_STATE));
    }
    assert_eq!(rig.operations(), operations, "something was erased");
    assert_eq!(rig.send_header(&file("0.1.0", &key())), Err(DEVICE_STATE));
    rig.clear();
}

#[test]
fn a_signed_program_is_installed_while_the_loader_answers_lss_in_15_us() {
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
    // Of which 11.3 us are one acknowledge of a block that was held back.
    assert!(slowest < Time::from_us(15), "{} ns", slowest.as_ps() / 1000);
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
fn a_program_with_another_signature_or_none_is_refused_before_a_word_is_written() {
    const REFUSED: u32 = (Field::Signature as u32) << 16 | 2 << 1;
    let other_key = SigningKey::from_bytes(&[10; 32]);
    let mut unsigned = file("0.2.0", &key());
    unsigned[Field::Signature as usize..Field::Rest as usize].fill(0xFF);
    let mut rig = cleared();
    let operations = rig.operations();
    for file in [file("0.2.0", &other_key), unsigned] {
        let from = rig.0.network.now();
        assert!(!rig.try_download(&file).unwrap());
        rig.0.network.run_for(Time::from_ms(1));
        let abort = [&[0x80, 0x50, 0x1F, 1][..], &NOT_STORED.to_le_bytes()].concat();
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

#[test]
#[ignore = "builds a product as the page says: `.ci/run chips`"]
fn the_commands_of_the_page_make_a_signed_product_which_is_not_built_without_a_key() {
    let page = fs::read_to_string(workspace().join("docs/update.md")).expect("the page");
    let printed = |begin: &str| {
        let mut lines = page.lines().filter_map(|line| line.strip_prefix("    "));
        lines.find(|line| line.starts_with(begin)).expect("the page has it").to_owned()
    };
    // One target directory has no two products of one name.
    let folder = env::temp_dir().join(format!("signed-pump-{}", process::id()));
    let make = printed("cargo xtask new-product")
        .replace("../pump", &folder.display().to_string())
        .replace("product pump", "product signed-pump")
        .replace("--update", "--signed");
    let run = |command: &str, is_in_product: bool| {
        let place = if is_in_product { &folder } else { workspace() };
        let mut shell = Command::new("sh");
        shell.args(["-c", command]).current_dir(place);
        let output = shell.env("CARGO_TARGET_DIR", workspace().join("target")).output();
        let output = output.expect("a shell");
        (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let succeeds = |(succeeds, errors): (bool, String)| assert!(succeeds, "{errors}");
    succeeds(run(&make, false));
    let build =
        format!("cargo build --release --target {TARGET} --features chip --bin signed-pump-loader");
    let (is_built, errors) = run(&build, true);
    assert!(!is_built && errors.contains("src/key.rs has no key"), "{errors}");
    succeeds(run(&printed("openssl"), true));
    succeeds(run(&printed("cargo update-file --key"), true));
    succeeds(run("cargo fmt --check", true));

    let hex = fs::read_to_string(folder.join("target/update/factory.hex")).expect("a file");
    let bytes = release::read_hex(&hex).expect("a HEX file").into_iter();
    let image = Image::from_segments(bytes.map(|(at, byte)| (at, vec![byte])).collect());
    let file = fs::read(folder.join("target/update/signed-pump.update.bin")).expect("a file");
    let mut rig = of_image(&image);
    assert_eq!(rig.send_header(&file), Err(DEVICE_STATE), "it is signed with the loader's key");
    rig.clear();
    assert!(rig.try_download(&file).unwrap());
    rig.start();
    assert_eq!(rig.control(0x80), Ok(()));
    assert_eq!(rig.number(0x2001, 1), 3);
    fs::remove_dir_all(&folder).expect("it was made");
}
