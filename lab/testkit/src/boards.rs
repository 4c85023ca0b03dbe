//! The emulated boards of the commands: chip, identity and settings.

use std::ops::Range;

use canopen_node::{BitRate, Settings, lss::Address, settings::Log};
use emulator::{
    Time,
    board::{self, Board},
    chip::{ChipVariant, Part, Thresholds, Timing},
    image::Image,
};

use crate::{
    flash::BoardFlash,
    image_rig::{SETTINGS_LENGTH, SETTINGS_OFFSET, flash_with},
    settings::Stored,
};

/// The duration of the first start, which formats the settings' flash: an erase of 16 KB takes at most 0.8 s.
pub const FIRST_START: Time = Time::from_s(1);
/// The place of the settings log in the flash.
const SETTINGS: Range<usize> = SETTINGS_OFFSET as usize..SETTINGS_OFFSET as usize + SETTINGS_LENGTH;

/// The board with this number, with erased settings, switched on at time zero. Each number gives a different unique id.
pub fn board(part: Part, image: &Image, number: usize) -> Board {
    let settings = board::Settings { unique_id: unique_id(number), ..Default::default() };
    Board::new(part, image, settings)
}

/// The unique id of the board's chip: coordinates on a wafer, wafer number and lot, as in RM0090 39.1.
pub fn unique_id(number: usize) -> [u8; 12] {
    let [x, y, ..] = number.to_le_bytes();
    let mut id = [x, 0, y, 0, 7, 0, 0, 0, 0, 0, 0, 0];
    id[5..].copy_from_slice(b"EMULATE");
    id
}

/// The LSS serial number that the firmware derives from the board's unique id.
pub fn serial_number(number: usize) -> u32 {
    Address::serial_number_of(&unique_id(number))
}

/// The settings stored in a board's flash; `None` for a new board.
pub fn stored_settings(flash: &[u8]) -> Option<Settings> {
    log(flash).settings()
}

/// Stores settings in a board's flash, as the firmware would.
pub fn store_settings(flash: &mut [u8], stored: Stored) {
    let mut log = log(flash);
    stored.store(&mut log);
    flash[SETTINGS].copy_from_slice(&log.close().content());
}

fn log(flash: &[u8]) -> Log<BoardFlash, 8> {
    Log::open_with_parameters(BoardFlash::with_content(flash[SETTINGS].to_vec(), 0)).0
}

/// What surrounds a chip at its nastiest, as far as the sessions can pass: crystal, supply, transceiver, memory and lines.
pub fn nastiest() -> board::Settings {
    let chip_variant = ChipVariant {
        external_clock: true,
        hsi_ppm: -80_000,
        ram_remembers: true,
        late_lines: 400,
        flash_waits: true,
        cut_words_flip: true,
        thresholds: Thresholds::Highest,
        flash_timing: Timing::Worst,
        ..ChipVariant::default()
    };
    board::Settings {
        supply_mv: 2_400,
        dominant_time_out: Some(Time::from_us(300)),
        chip_variant,
        ..board::Settings::default()
    }
}

/// A board to be emulated: its chip and crystal, and the variant of its behaviour.
#[derive(Clone, Copy)]
pub struct Variant<'a> {
    pub image: &'a Image,
    pub part: Part,
    pub settings: board::Settings,
}

impl Variant<'_> {
    /// Whether 11 bits of this rate are within the dominant time-out of the transceiver.
    pub fn carries(&self, rate: BitRate) -> bool {
        let bits = Time::from_us(11_000 / u64::from(rate.kbit_per_s()));
        self.settings.dominant_time_out.is_none_or(|time_out| bits <= time_out)
    }

    /// The board with this number, with the given settings stored or none.
    pub fn board(&self, number: usize, stored: Option<Stored>) -> Board {
        let settings = board::Settings { unique_id: unique_id(number), ..self.settings };
        let mut board = Board::new(self.part, self.image, settings);
        if let Some(stored) = stored {
            board.set_flash(SETTINGS_OFFSET, &flash_with(&[stored]));
        }
        board
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn boards_differ_in_their_serial_numbers() {
        let mut serial_numbers: Vec<u32> = (0..1000).map(super::serial_number).collect();
        serial_numbers.sort();
        serial_numbers.dedup();
        assert_eq!(serial_numbers.len(), 1000);
    }
}
