//! Boards with the image under test, which the root of the tests names, and the names that all tests use.

pub use canopen_node::{BitRate, BitRateSetting};
pub use emulator::{
    Time,
    board::{self, Board},
    can::{Adapter, Frame, Id},
    chip::{ChipVariant, Pin, ResetCause, Timing},
    network::{AdapterId, Event, Recording, Short, Source, What},
};
use emulator::{chip::FLASH_BASE, image::Image};
use testkit::image_rig;
pub use testkit::{
    frames::{self, Frames, SILENCE},
    image::PART,
    image_rig::*,
    log,
    random::{Random, every},
    sdo::{self, Client},
    settings::Stored,
    wire::*,
};

use crate::FIRMWARE;

/// The image under test.
pub fn image() -> &'static Image {
    FIRMWARE.image()
}

/// A board with a blank settings flash.
pub fn blank_board(number: u8) -> Board {
    image_rig::blank_board(FIRMWARE, number)
}

/// A board with stored `settings`.
pub fn board_with(number: u8, settings: Stored) -> Board {
    image_rig::board_with(FIRMWARE, number, settings)
}

/// A board with this content of its settings' flash.
pub fn board_with_flash(content: &[u8]) -> Board {
    let mut board = blank_board(0);
    board.set_flash(SETTINGS_OFFSET, content);
    board
}

/// A board of a variant with stored `settings`.
pub fn board_of(variant: board::Settings, settings: Stored) -> Board {
    let mut board = Board::new(PART, image(), variant);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings]));
    board
}

/// The variant of a board whose chip has these properties.
pub fn chip(chip_variant: ChipVariant) -> board::Settings {
    board::Settings { chip_variant, ..Default::default() }
}

/// A single unconfigured board.
pub fn blank_rig() -> ImageRig {
    ImageRig::new(DEFAULT_BIT_RATE, [blank_board(0)])
}

/// A single board with these settings, and the master at its bit rate.
pub fn rig_with(settings: Stored) -> ImageRig {
    rig_of(board::Settings::default(), settings)
}

/// The same on a board of a variant.
pub fn rig_of(variant: board::Settings, settings: Stored) -> ImageRig {
    let BitRateSetting::Fixed(bit_rate) = settings.bit_rate else {
        panic!("the master needs a bit rate");
    };
    ImageRig::new(bit_rate, [board_of(variant, settings)])
}

/// Node 40 at 1 Mbit/s with a heartbeat or, if the time is 0, without one, after its boot-up.
pub fn node_40(heartbeat_ms: u16) -> ImageRig {
    let mut rig = rig_with(settings(0x40, BitRate::Kbit1000).with_heartbeat_ms(heartbeat_ms));
    assert_eq!(rig.collect(Time::from_ms(20)).texts()[0], "740: 00");
    rig
}

/// Node 40 at 1 Mbit/s without a heartbeat on a chip with these properties, after its boot-up.
pub fn node_40_on(chip_variant: ChipVariant) -> ImageRig {
    let mut rig = rig_of(chip(chip_variant), settings(0x40, BitRate::Kbit1000));
    assert_eq!(rig.collect(Time::from_ms(100)), ["740: 00"]);
    rig
}

/// The same with a core that is `slowdown` times slower.
pub fn slow_node_40(slowdown: u8) -> ImageRig {
    node_40_on(ChipVariant { slowdown, ..ChipVariant::default() })
}

/// Whether node 40 answers the master, once it is in configuration state.
pub fn answers(rig: &mut ImageRig) -> bool {
    rig.lss("04 01");
    let answers = rig.lss("5E");
    answers.0.iter().any(|frame| frames::text(frame).starts_with("7E4: 5E 40"))
}

/// Gives the only board node-ID 4, and checks that it is there after a power cycle.
pub fn assert_stores(rig: &mut ImageRig) {
    rig.ask("04 01, 11 04, 17", "11 00, 17 00");
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["704: 00"]);
}

/// Offset in the flash of the code at a symbol.
pub fn code(symbol: &str) -> u32 {
    let address = image().symbol(symbol).unwrap_or_else(|| panic!("no {symbol} in the image"));
    (address & !1) - FLASH_BASE
}

/// Replaces code of the only board until it is reset for `cause`, and lets it boot; returns the time to the reset.
pub fn replace_until_reset(
    rig: &mut ImageRig,
    offset: u32,
    instructions: &[u8],
    cause: ResetCause,
) -> Time {
    let from = rig.network.now();
    let reset_at = reset_by(rig, offset, instructions, cause);
    rig.boot(0, reset_at);
    reset_at - from
}

/// Replaces code of the only board until it is reset for `cause`; returns the time of the reset.
pub fn reset_by(rig: &mut ImageRig, offset: u32, instructions: &[u8], cause: ResetCause) -> Time {
    let from = rig.network.now();
    let before = rig.network.board(0).flash()[offset as usize..][..instructions.len()].to_vec();
    let resets = rig.network.board(0).resets().len();
    rig.network.allow_reset(0, cause);
    rig.network.board_mut(0).set_flash(offset, instructions);
    while rig.network.board(0).resets().len() == resets {
        assert!(rig.network.now() < from + Time::from_s(5), "no reset");
        rig.network.run_for(Time::from_us(20));
    }
    rig.network.board_mut(0).set_flash(offset, &before);
    rig.network.board(0).resets()[resets].0
}
