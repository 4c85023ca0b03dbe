//! The loader fits its sectors and starts, whatever the name, the chip and the CAN controller of the product.

use emulator::{
    board::{Board, Settings},
    chip::{FLASH_BASE, Part},
    image::Image,
};
use testkit::{
    image_rig::{DEFAULT_BIT_RATE, ImageRig, SETTINGS_LENGTH, SETTINGS_OFFSET},
    product,
};

const SHORT: &str = "t";
const LONG: &str = "a-lamp-with-a-name-that-is-longer-than-that-of-any-other-product";
/// What must be left of the room, so that a change does not find it full.
const RESERVE: u32 = 600;

/// The loader lies around the settings and is no longer than `kb`, with a reserve, and starts.
fn check(loader: &Image, part: Part, controller: usize, kb: u32) {
    let behind = FLASH_BASE + SETTINGS_OFFSET + SETTINGS_LENGTH as u32;
    let segments: Vec<_> = loader.segments().map(|(at, bytes)| (at, bytes.len() as u32)).collect();
    let [(first, in_sector_0), (rest, more)] = segments[..] else { panic!("{segments:X?}") };
    assert_eq!((first, in_sector_0, rest), (FLASH_BASE, SETTINGS_OFFSET, behind));
    println!("{}: {} bytes of {}", part.name(), in_sector_0 + more, kb * 1024);
    assert!(in_sector_0 + more + RESERVE <= kb * 1024, "{}", in_sector_0 + more);
    let settings = Settings { controller, ..Default::default() };
    ImageRig::new(DEFAULT_BIT_RATE, [Board::new(part, loader, settings)]);
}

#[test]
#[ignore = "builds eight images: `.ci/run chips`"]
fn the_loader_fits_and_starts_whatever_name_chip_and_controller() {
    for (name, part, controller) in [
        (SHORT, Part::Stm32f407, 1),
        (LONG, Part::Stm32f407, 1),
        (LONG, Part::Stm32f446, 1),
        (SHORT, Part::Stm32f405, 2),
    ] {
        let loader = product::build_loader(name, part, controller);
        check(
            &loader.unwrap_or_else(|error| panic!("{name}: {error}")),
            part,
            controller.into(),
            32,
        );
    }
}
