//! The chips: the firmware's table against the emulated boards, and the sessions that `cargo xtask chips` runs on all
//! of them, with the image of the example.

use canopen_stm32f4::chip::{self, CHIPS};
use emulator::chip::Part;
use testkit::{
    boards::{Variant, nastiest},
    image::example,
    sessions,
};

use crate::rig::*;

const MHZ: u32 = 1_000_000;

#[test]
fn the_firmware_relies_on_no_more_than_the_emulated_chips_have() {
    assert_eq!(CHIPS.map(|chip| chip.feature), Part::F4.map(Part::name));
    for (chip, part) in CHIPS.into_iter().zip(Part::F4) {
        assert_eq!(chip.manual, part.manual(), "{part:?}");
        assert_eq!(chip.device_id, part.id_code() & 0xFFF, "{part:?}");
        assert_eq!(chip.ram_kb * 1024, part.ram_size(), "{part:?}");
        assert!(chip.flash_kb * 1024 <= part.flash_size(), "{part:?}");
        let (sysclk, apb1, _) = part.clock_limits();
        assert!(chip.max_sysclk_mhz * MHZ <= sysclk, "{part:?}");
        assert!(chip.max_apb1_mhz * MHZ <= apb1, "{part:?}");
        assert!(chip::sysclk_hz(&chip) <= chip.max_sysclk_mhz * MHZ, "{part:?}");
        assert_eq!(chip.controllers as usize, part.cans(), "{part:?}");
        assert!(chip::APB1_HZ <= chip.max_apb1_mhz * MHZ, "{part:?}");
    }
}

#[test]
fn the_example_passes_the_sessions_that_every_chip_must_pass() {
    let settings = board::Settings::default();
    let variant = Variant { image: example(), part: PART, settings };
    for (name, session) in sessions::all(false) {
        println!("{name}");
        session(&variant);
    }
}

/// `cargo verify chip-variants` has each of them alone, and the long sessions.
#[test]
fn the_image_passes_its_sessions_with_the_surroundings_at_their_nastiest() {
    let variant = Variant { image: image(), part: PART, settings: nastiest() };
    for (name, session) in sessions::all(true) {
        println!("{name}");
        session(&variant);
    }
}
