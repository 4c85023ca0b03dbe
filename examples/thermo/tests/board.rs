//! Sessions with the release image of the thermometer on an emulated board.

use std::sync::LazyLock;

use canopen_node::BitRate;
use emulator::{
    Time,
    board::{Board, Settings},
    can::Clock,
    chip::{ChipVariant, Pin},
    image::Image,
};
use example_thermo::device;
use testkit::{
    image::{self, PART},
    image_rig::{ImageRig, SETTINGS_OFFSET, flash_with, settings},
    sdo::Client,
};

static IMAGE: LazyLock<Image> = LazyLock::new(|| {
    image::build_example("thermo", PART).unwrap_or_else(|error| panic!("{error}"))
});

const SWITCHES: [u8; 7] = [4, 5, 6, 7, 8, 9, 10];

/// A board with these switches closed, bit 0 first, and sensors at 20 degrees.
fn board_with_switches(closed: u8) -> Board {
    let settings = Settings {
        crystal: Clock { hz: device::CRYSTAL_HZ, ppm: 0 },
        chip_variant: ChipVariant {
            external_clock: device::CRYSTAL_IS_EXTERNAL_CLOCK,
            ..ChipVariant::default()
        },
        controller: 2,
        ..Settings::default()
    };
    let board = Board::new(PART, &IMAGE, settings);
    set_switches(&board, closed);
    set_sensors(&board, [700; 4]);
    board
}

fn set_switches(board: &Board, closed: u8) {
    let mut chip = board.chip();
    for (bit, number) in SWITCHES.into_iter().enumerate() {
        let is_closed = closed >> bit & 1 == 1;
        chip.gpio_mut().set_input(Pin('C', number), is_closed.then_some(false));
    }
}

fn set_sensors(board: &Board, millivolts: [u32; 4]) {
    board.chip().adc_mut().analogue.channels_mv[..4].copy_from_slice(&millivolts);
}

/// Node 5 in NMT operational, after its first temperatures.
fn operational() -> ImageRig {
    let mut board = board_with_switches(0);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(5, BitRate::Kbit125)]));
    let mut rig = ImageRig::new(BitRate::Kbit125, [board]);
    assert_eq!(rig.collect(Time::from_ms(20)), ["705: 00"]);
    rig.nmt("01 05");
    rig.collect(Time::from_ms(1_000));
    rig
}

#[test]
fn temperatures_follow_their_sensors() {
    let mut rig = operational();
    set_sensors(rig.network.board(0), [500, 750, 1_000, 300]);
    let sent = rig.collect(Time::from_ms(300));
    // 0, 25, 50 and -20 degrees; the converter resolves 0.8 mV.
    let [frame] = &sent.0[..] else { panic!("{sent:?}") };
    let expected = [0, 250, 500, -200];
    for (bytes, expected) in frame.data().chunks(2).zip(expected) {
        let temperature = i16::from_le_bytes([bytes[0], bytes[1]]);
        assert!((temperature - expected).abs() <= 3, "{temperature} instead of {expected}");
    }
}

#[test]
fn relays_follow_the_rpdo() {
    let mut rig = operational();
    let relays = |rig: &ImageRig| [0, 1].map(|n| rig.network.board(0).output(Pin('B', n)).level);
    assert_eq!(relays(&rig), [Some(false); 2]);
    rig.queue(&testkit::frames::of_master("205: 02"));
    rig.collect(Time::from_ms(200));
    assert_eq!(relays(&rig), [Some(false), Some(true)]);
}

#[test]
fn a_faulty_sensor_is_an_emergency_of_its_own_until_it_is_mended() {
    let mut rig = operational();
    set_sensors(rig.network.board(0), [700, 700, 0, 700]);
    assert_eq!(rig.collect(Time::from_ms(300)), ["085: 33 50 21 00 00 00 00 00"]);
    assert_eq!(rig.sdo_client(5).upload(0x2101, 0), Ok(vec![0b100]));
    assert_eq!(rig.sdo_client(5).upload(0x1001, 0), Ok(vec![0x21]));
    set_sensors(rig.network.board(0), [700; 4]);
    assert_eq!(rig.collect(Time::from_ms(300)), ["085: 00 00 00 00 00 00 00 00"]);
}

#[test]
fn a_gain_is_kept_through_a_power_cycle() {
    let mut rig = operational();
    let mut master = rig.sdo_client(5);
    assert_eq!(master.download(0x2100, 2, &1.1_f32.to_le_bytes()), Ok(()));
    assert_eq!(master.download(0x2100, 2, &2.5_f32.to_le_bytes()), Err(0x0609_0031));
    assert_eq!(master.download(0x1010, 1, b"save"), Ok(()));
    rig.power_cycle(0);
    rig.collect(Time::from_ms(200));
    assert_eq!(rig.sdo_client(5).upload(0x2100, 2), Ok(1.1_f32.to_le_bytes().to_vec()));
    let temperature = rig.sdo_client(5).upload(0x7130, 2).expect("a temperature");
    let temperature = i16::from_le_bytes(temperature.try_into().expect("two bytes"));
    assert!((217..=223).contains(&temperature), "{temperature}");
}

#[test]
fn switches_give_the_node_id_until_one_is_stored() {
    for (closed, boot_up) in [(0x05, "705: 00"), (0x7F, "77F: 00"), (0x40, "740: 00")] {
        let mut rig = ImageRig::new(BitRate::Kbit125, [board_with_switches(closed)]);
        assert_eq!(rig.collect(Time::from_ms(20)), [boot_up]);
    }
    let mut rig = ImageRig::new(BitRate::Kbit125, [board_with_switches(0x05)]);
    assert_eq!(rig.collect(Time::from_ms(20)), ["705: 00"]);
    set_switches(rig.network.board(0), 0x06);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["706: 00"], "nothing is stored yet");
    rig.lss("04 01");
    assert_eq!(rig.lss("5E"), ["5E 06"]);
    assert_eq!(rig.lss("11 22"), ["11 00"]);
    assert_eq!(rig.lss("17"), ["17 00"]);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["722: 00"], "the stored one wins");
}

#[test]
fn a_stored_lack_of_a_node_id_wins_over_the_switches() {
    let mut rig = ImageRig::new(BitRate::Kbit125, [board_with_switches(0x05)]);
    rig.collect(Time::from_ms(20));
    rig.lss("04 01");
    assert_eq!(rig.lss("11 FF"), ["11 00"]);
    assert_eq!(rig.lss("17"), ["17 00"]);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), [""; 0]);
    assert_eq!(rig.lss("4C"), ["50"]);
}

#[test]
fn open_switches_leave_a_new_device_without_a_node_id() {
    let mut rig = ImageRig::new(BitRate::Kbit125, [board_with_switches(0)]);
    assert_eq!(rig.collect(Time::from_ms(20)), [""; 0]);
    assert_eq!(rig.lss("4C"), ["50"]);
}

#[test]
fn an_led_to_the_supply_is_lit_while_its_pin_is_low() {
    let mut rig = operational();
    rig.network.run_for(Time::from_ms(100));
    let run = |rig: &ImageRig| rig.network.board(0).output(Pin('D', 12)).level;
    assert_eq!(run(&rig), Some(false), "RUN is lit in operational");
    rig.nmt("02 05");
    let mut high = 0;
    for _ in 0..24 {
        rig.network.run_for(Time::from_ms(50));
        high += u32::from(run(&rig) == Some(true));
    }
    assert_eq!(high, 20, "RUN flashes once, for 200 of 1200 ms, in stopped");
}
