//! An update on other chips: with another crystal, another controller, and another size of the flash.

use emulator::{
    Time,
    board::{self, Board},
    can::Clock,
    chip::Part,
};
use testkit::{
    boards,
    image_rig::{SETTINGS_OFFSET, flash_with, settings},
    product, update,
};

use super::{
    bad_programs::{UNDEFINED, with_first_instruction},
    rig::{NODE, RATE, Rig, device, with_version},
};

/// Installs a program, is rolled back from one that fails, and loses the power in a download.
fn updates(part: Part, controller: u8, crystal_mhz: u32) {
    let name = format!("lamp-{}-can{controller}", part.name());
    let hz = crystal_mhz * 1_000_000;
    let change = |path: &str, content: String| match path {
        "src/device.rs" => content.replace("HZ: u32 = 8_000_000", &format!("HZ: u32 = {hz}")),
        _ => content,
    };
    let images = product::build_with_update(&name, part, controller, change);
    let [loader, program] = images.unwrap_or_else(|error| panic!("{error}"));
    let file = |program, version| update::file(program, &device(version), part, controller);
    let old = file(&program, "0.1.0").unwrap();
    let new = with_version(&program, "0.2.0");
    let settings_of_board = board::Settings {
        crystal: Clock { hz, ppm: 0 },
        controller: controller.into(),
        unique_id: boards::unique_id(0),
        ..Default::default()
    };
    let mut board = Board::new(part, &update::factory(&loader, &old), settings_of_board);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(NODE, RATE)]));
    let mut rig = Rig::of(board);
    rig.0.network.permit_misuse();

    rig.load(&file(&new, "0.2.0").unwrap(), &mut Vec::new());
    assert!(rig.try_control(1).unwrap());
    rig.0.expect("705: 00", Time::from_s(1));
    assert!(rig.try_control(0x80).unwrap());
    assert_eq!((&*rig.version(), rig.number(0x2001, 1)), ("0.2.0", 3));

    let failing = with_first_instruction(&with_version(&program, "0.3.0"), UNDEFINED);
    rig.load(&file(&failing, "0.3.0").unwrap(), &mut Vec::new());
    assert!(rig.try_control(1).unwrap());
    rig.0.network.run_for(Time::from_s(6));
    rig.revive();
    assert_eq!((&*rig.version(), rig.number(0x2001, 1)), ("0.2.0", 4));

    rig.begin_download(&file(&with_version(&program, "0.3.0"), "0.3.0").unwrap(), &mut Vec::new());
    rig.0.network.power_off(0);
    rig.0.network.run_for(Time::from_ms(10));
    rig.0.network.power_on(0);
    rig.revive();
    assert_eq!((&*rig.version(), rig.number(0x2001, 1)), ("0.2.0", 4));
    rig.check_settings();
    assert_eq!(rig.0.network.board(0).misuse(), None);
}

#[test]
#[ignore = "builds two images"]
fn an_stm32f446_with_a_crystal_of_12_mhz_is_updated_rolled_back_and_restored() {
    updates(Part::Stm32f446, 1, 12);
}

#[test]
#[ignore = "builds two images"]
fn an_stm32f405_on_can2_is_updated_rolled_back_and_restored() {
    updates(Part::Stm32f405, 2, 8);
}
