//! A node on CAN2, while the bus of another controller carries frames of others.

use std::sync::LazyLock;

use emulator::{chip::Part, image::Image};
use testkit::product;

use crate::rig::*;

/// The first filter registers (RM0090, 32.9.4).
const FM1R: u32 = 0x204;
const FA1R: u32 = 0x21C;

fn image_on_can2() -> &'static Image {
    static IMAGE: LazyLock<Image> = LazyLock::new(|| build(PART, 2));
    &IMAGE
}

/// The image of a new product.
fn build(part: Part, controller: u8) -> Image {
    product::build(part, controller).unwrap_or_else(|error| panic!("{error}"))
}

fn board_on(part: Part, image: &Image, controller: usize) -> Board {
    Board::new(part, image, board::Settings { controller, ..Default::default() })
}

/// Two adapters on a second bus, which acknowledge each other, and CAN1 of the board with the pins that it has.
fn add_busy_bus(rig: &mut ImageRig) -> [AdapterId; 2] {
    let bus = rig.network.add_bus();
    rig.network.connect(0, 1, bus);
    [(); 2].map(|()| rig.network.add_adapter_to(bus, Adapter::new(125_000)))
}

fn is_commissioned(part: Part, controller: usize, image: &Image) {
    let name = part.name();
    let mut rig = ImageRig::new(BitRate::Kbit125, [board_on(part, image, controller)]);
    let [sender, other] = add_busy_bus(&mut rig);
    // Another master there configures in vain.
    for request in ["04 01", "11 07", "5E"] {
        rig.network.send(sender, on_the_wire(&frames::request(request)));
    }
    assert_eq!(rig.lss("5E"), [""; 0], "{name}: the board waits");
    assert_eq!(rig.network.adapter_mut(sender).unsent(), 0);
    let heard = std::iter::from_fn(|| rig.network.receive(other)).count();
    assert_eq!(heard, 3);

    let answers = rig.lss("4C, 04 01, 11 04, 13 00 00, 17");
    assert_eq!(answers, ["50", "11 00", "13 00", "17 00"], "{name}");
    rig.activate(50);
    rig.network.run_for(Time::from_ms(60));
    rig.set_master_bit_rate(BitRate::Kbit1000);
    rig.network.run_for(Time::from_ms(60));
    assert_eq!(rig.lss("04 00"), ["704: 00"], "{name}");
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["704: 00"], "{name}");

    assert_eq!(rig.network.receive(sender), None, "{name} sends on the bus of CAN1");
    assert_eq!(rig.network.receive(other), None, "{name} sends on the bus of CAN1");
    // Nobody but the other adapter acknowledges there.
    rig.network.adapter_mut(other).close();
    rig.network.send(sender, on_the_wire(&frames::request("5E")));
    rig.network.run_for(Time::from_ms(20));
    assert_eq!(rig.network.adapter_mut(sender).unsent(), 1, "{name}");

    // Without a frame for the board, the watchdog is fed by the roll call alone.
    let resets = rig.network.board(0).resets().len();
    rig.network.run_for(Time::from_s(5));
    assert_eq!(rig.network.board(0).resets().len(), resets, "{name}");
}

#[test]
fn an_image_on_can2_is_commissioned_beside_a_busy_bus_at_can1() {
    is_commissioned(PART, 2, image_on_can2());
}

#[test]
#[ignore = "builds the image of another chip: `.ci/run chips`"]
fn an_image_on_can3_is_commissioned_beside_a_busy_bus_at_can1() {
    let image = build(Part::Stm32f413, 3);
    is_commissioned(Part::Stm32f413, 3, &image);
    uses_banks_from(0, Part::Stm32f413, 3, 3, &image);
}

/// The banks in use, and those of them that are lists, in the filter registers of a controller.
fn banks(rig: &ImageRig, controller: usize) -> [u32; 2] {
    let board = rig.network.board(0);
    let (chip, now) = (board.chip(), board.now());
    [FA1R, FM1R].map(|offset| chip.can(controller).read(offset, now).expect("a register"))
}

/// Checks the banks of a controller, whose filters are those of controller `filters`.
fn uses_banks_from(first: u32, part: Part, controller: usize, filters: usize, image: &Image) {
    let mut board = board_on(part, image, controller);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(4, BitRate::Kbit500)]));
    let mut rig = ImageRig::new(BitRate::Kbit500, [board]);
    rig.collect(Time::from_ms(20));
    assert_eq!(banks(&rig, filters), [1 << first, 1 << first], "CAN{controller}");
}

#[test]
fn can1_uses_banks_from_0_on_and_can2_those_from_14_on() {
    uses_banks_from(0, PART, 1, 1, image());
    uses_banks_from(14, PART, 2, 1, image_on_can2());
}
