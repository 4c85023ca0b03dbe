//! Boards with the image under test, which the root of the tests names.

use canopen_node::{BitRateSetting, Settings};
use emulator::{board::Board, chip::Part, image::Image};
use testkit::image_rig;
pub use testkit::image_rig::*;

use crate::FIRMWARE;

/// The image under test.
pub fn image() -> &'static Image {
    FIRMWARE.image()
}

/// The chip that it is for.
pub fn part() -> Part {
    FIRMWARE.part()
}

/// A board with a blank settings flash.
pub fn blank_board(number: u8) -> Board {
    image_rig::blank_board(FIRMWARE, number)
}

/// A board with stored `settings`.
pub fn board_with(number: u8, settings: Settings) -> Board {
    image_rig::board_with(FIRMWARE, number, settings)
}

/// A single unconfigured board.
pub fn blank_rig() -> ImageRig {
    ImageRig::new(DEFAULT_BIT_RATE, [blank_board(0)])
}

/// A single board with these settings, and the master at its bit rate.
pub fn rig_with(settings: Settings) -> ImageRig {
    let BitRateSetting::Fixed(bit_rate) = settings.bit_rate else {
        panic!("the master needs a bit rate");
    };
    ImageRig::new(bit_rate, [board_with(0, settings)])
}
