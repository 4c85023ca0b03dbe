//! A board with loader and program, and a master that updates it.

use std::sync::LazyLock;

use canopen_node::{BitRate, Device, NodeId};
use emulator::{
    Time,
    board::{self, Board},
    chip::ResetCause,
    image::Image,
};
use firmware::device::DEVICE;
pub use testkit::image::PART;
use testkit::{
    boards,
    image_rig::{ImageRig, SETTINGS_LENGTH, SETTINGS_OFFSET, flash_with, settings},
    product,
    random::Random,
    sdo::Client,
    settings::Stored,
    update,
};

pub const CONTROLLER: u8 = 1;
pub const NODE: u8 = 5;
/// The address of RUN.
pub const RUN: u32 = 0x0801_0000;
pub const RATE: BitRate = BitRate::Kbit1000;

/// The loader and the program.
pub static IMAGES: LazyLock<[Image; 2]> = LazyLock::new(|| {
    // The tutorial has another name for its product: in one target directory cargo takes two of one name for one.
    product::build_with_update("pump", PART, CONTROLLER, |_, content| content)
        .unwrap_or_else(|error| panic!("{error}"))
});

/// The device with this software version.
pub fn device(version: &'static str) -> Device {
    let mut device = DEVICE.with_name("pump").with_versions("1.0", version);
    device.address.product_code = 1;
    device
}

/// The program with this version in place of its own, which is 0.1.0.
pub fn program(version: &str) -> Image {
    with_version(&IMAGES[1], version)
}

/// A program with this version in place of its own, which is 0.1.0.
pub fn with_version(program: &Image, version: &str) -> Image {
    let exchange = |bytes: &[u8]| {
        let mut bytes = bytes.to_vec();
        for at in 0..bytes.len().saturating_sub(4) {
            if bytes[at..].starts_with(b"0.1.0") {
                bytes[at..at + 5].copy_from_slice(version.as_bytes());
            }
        }
        bytes
    };
    Image::from_segments(program.segments().map(|(at, bytes)| (at, exchange(bytes))).collect())
}

/// The update file of the program with this version.
pub fn file(version: &'static str) -> Vec<u8> {
    file_of(&program(version), version)
}

/// The update file of another program.
pub fn file_of(program: &Image, version: &'static str) -> Vec<u8> {
    update::file(program, &device(version), PART, CONTROLLER).expect("it fits")
}

/// A board with the version 0.1.0 and stored settings.
pub fn board() -> Board {
    board_with(&file("0.1.0"))
}

/// A board with the program of an update file and stored settings.
pub fn board_with(file: &[u8]) -> Board {
    board_of(file, settings(NODE, RATE))
}

/// A board with the program of an update file and these settings.
pub fn board_of(file: &[u8], stored: Stored) -> Board {
    let image = update::factory(&IMAGES[0], file);
    let number = stored.node_id.map_or(0, NodeId::get).into();
    let settings = board::Settings { unique_id: boards::unique_id(number), ..Default::default() };
    let mut board = Board::new(PART, &image, settings);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[stored]));
    board
}

pub fn stored() -> Vec<u8> {
    flash_with(&[settings(NODE, RATE)])
}

/// The update file of the product's program with random bytes behind it, up to this number of KB, if it has less.
pub fn padded(version: &'static str, kb: usize) -> Vec<u8> {
    padded_of(&IMAGES[1], version, kb)
}

/// The update file of another program.
pub fn padded_of(program: &Image, version: &'static str, kb: usize) -> Vec<u8> {
    let end = |(at, bytes): (u32, &[u8])| at + bytes.len() as u32;
    let end = program.segments().map(end).max().expect("segments").next_multiple_of(4);
    let mut random = Random::from_seed(end.into());
    let length = (RUN as usize + kb * 1024).saturating_sub(end as usize);
    let bytes = (0..length).map(|_| random.byte()).collect();
    let program = with_version(program, version);
    let segments = program.segments().map(|(at, bytes)| (at, bytes.to_vec()));
    file_of(&Image::from_segments(segments.chain([(end, bytes)]).collect()), version)
}

/// A master and the board, and the time-out of its requests.
pub struct Rig(pub ImageRig, pub Time);

impl Rig {
    /// The board after its start.
    pub fn new() -> Self {
        Self::of(board())
    }

    /// This board after its start.
    pub fn of(board: Board) -> Self {
        let mut rig = Self(ImageRig::new(RATE, [board]), Time::from_ms(500));
        assert_eq!(rig.0.collect(Time::from_ms(10)), ["705: 00"]);
        rig
    }

    pub fn client(&mut self) -> impl Client {
        self.0.sdo_client(NODE)
    }

    pub fn control(&mut self, value: u8) -> Result<(), u32> {
        self.client().download(0x1F51, 1, &[value])
    }

    pub fn number(&mut self, index: u16, sub_index: u8) -> u32 {
        let bytes = self.client().upload(index, sub_index).expect("an object");
        bytes.iter().rev().fold(0, |number, byte| number << 8 | u32::from(*byte))
    }

    pub fn version(&mut self) -> String {
        String::from_utf8(self.client().upload(0x100A, 0).expect("an object")).expect("a text")
    }

    /// Hands over to the loader and has it clear the program.
    pub fn stop_and_clear(&mut self) {
        self.0.network.allow_reset(0, ResetCause::Software);
        assert_eq!(self.control(0), Ok(()));
        assert_eq!(self.number(0x1F51, 1), 0);
        self.clear();
    }

    pub fn clear(&mut self) {
        assert_eq!(self.control(3), Ok(()));
        assert_eq!(self.finish(Time::from_s(10)), 0);
    }

    /// Waits for the end of the work; returns the status.
    pub fn finish(&mut self, limit: Time) -> u32 {
        let until = self.0.network.now() + limit;
        loop {
            let status = self.number(0x1F57, 1);
            if status & 1 == 0 {
                return status;
            }
            assert!(self.0.network.now() < until, "busy for too long");
            self.0.network.run_for(Time::from_ms(50));
        }
    }

    /// Starts the program, and waits for its boot-up.
    pub fn start(&mut self) {
        self.0.network.allow_reset(0, ResetCause::Software);
        assert_eq!(self.control(1), Ok(()));
        self.0.expect("705: 00", Time::from_s(1));
    }

    /// The settings in the flash are those of the beginning.
    pub fn check_settings(&self) {
        let flash = self.0.network.board(0).flash();
        let offset = SETTINGS_OFFSET as usize;
        assert!(flash[offset..offset + SETTINGS_LENGTH] == stored(), "the settings have changed");
    }
}
