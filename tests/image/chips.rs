//! The chips: the firmware's table against the emulated boards and `Cargo.toml`, and the image of a chip with two banks.
//! `cargo xtask chips` runs those of all chips.

use canopen_stm32f4::chip::{self, CHIPS};
use emulator::{
    Time,
    board::{self, Board},
    chip::Part,
};
use lss_slave::BitRate;
use testkit::{image, image_rig::ImageRig};

const MHZ: u32 = 1_000_000;

#[test]
fn the_firmware_relies_on_no_more_than_the_emulated_chips_have() {
    assert_eq!(CHIPS.map(|chip| chip.feature), Part::ALL.map(Part::name));
    for (chip, part) in CHIPS.into_iter().zip(Part::ALL) {
        assert_eq!(chip.manual, part.manual(), "{part:?}");
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
#[ignore = "builds the image of another chip: `.ci/run chips`"]
fn the_image_of_an_stm32f427_is_commissioned_and_power_cycled() {
    let image = image::build(Part::Stm32f427).unwrap_or_else(|error| panic!("{error}"));
    let board = Board::new(Part::Stm32f427, &image, board::Settings::default());
    let mut rig = ImageRig::new(BitRate::Kbit125, [board]);
    assert_eq!(rig.lss("4C"), ["50"]);
    rig.lss("04 01");
    rig.lss("11 04");
    rig.lss("13 00 00");
    assert_eq!(rig.lss("17"), ["17 00"]);
    rig.transmit_request("15 32 00");
    rig.network.run_for(Time::from_ms(60));
    rig.set_master_bit_rate(BitRate::Kbit1000);
    rig.network.run_for(Time::from_ms(60));
    assert_eq!(rig.lss("04 00"), ["704: 00"]);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["704: 00"]);
}
