//! The boards of `cargo flash --board`: each starts at once with its clock, and its LED is the indicator RUN.

use anyhow::ensure;
use canopen_node::BitRate;
use emulator::{
    Time, board,
    can::Clock,
    chip::{ChipVariant, Part, Pin},
};
use testkit::{boards::Variant, image, image_rig::ImageRig};

use crate::board::Board;

/// Builds their images, and runs them on boards with that clock.
pub fn check() -> anyhow::Result<()> {
    for (board, part, external_clock, led) in [
        (Board::Stm32f407gDisc1, Part::Stm32f407, false, Pin('D', 12)),
        (Board::NucleoF446re, Part::Stm32f446, true, Pin('A', 5)),
        (Board::Stm32H405, Part::Stm32f405, false, Pin('C', 12)),
    ] {
        let image = image::build_board(board.features(), part)?;
        let chip_variant = ChipVariant { external_clock, ..ChipVariant::default() };
        let crystal = Clock { hz: 8_000_000, ppm: 0 };
        let settings = board::Settings { chip_variant, crystal, ..Default::default() };
        let variant = Variant { image: &image, part, settings };
        let stored = Some(super::stored(BitRate::Kbit125));
        let mut rig = ImageRig::new(BitRate::Kbit125, [variant.board(0, stored)]);
        rig.expect("705: 00", super::AWAY);
        let name = board.features();
        let is_wrong = rig.has_logged("CRYSTAL_IS_EXTERNAL_CLOCK");
        ensure!(!is_wrong, "{name}: the clock is in the other mode");
        let mut level = || {
            rig.network.run_for(Time::from_ms(10));
            rig.network.board(0).chip().gpio().output(led).level
        };
        let levels: Vec<_> = (0..200).map(|_| level()).collect();
        let changes = levels.windows(2).filter(|pair| pair[0] != pair[1]).count();
        // RUN blinks at 2.5 Hz in NMT pre-operational (CiA 303-3).
        ensure!((9..=11).contains(&changes), "{name}: the LED changes {changes} times in 2 s");
    }
    Ok(())
}
