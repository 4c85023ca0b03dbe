//! What a product shows of its faults: the log of a panic, a stack overflow and a task that does not answer, and the
//! report on a peripheral that is not modelled.

use std::{fs, sync::LazyLock};

use emulator::{can::Clock, image::Image};
use testkit::{cargo::workspace, product, unmodelled};

use crate::rig::*;

/// The switches for the node-ID at port C, that for bit 0 first.
const SWITCHES: [u8; 7] = [4, 5, 6, 7, 8, 9, 10];

/// A product with a crystal of 12 MHz, switches for the node-ID, and RUN at an LED to the supply. Its `idle` fails as the
/// brightness says.
static FAULTY: LazyLock<Image> = LazyLock::new(|| {
    let changes = [
        (
            "src/main.rs",
            "    #[idle]\n    fn idle(_: idle::Context) -> ! {\n        loop {\n",
            "    #[idle(shared = [runner])]
    fn idle(mut cx: idle::Context) -> ! {
        loop {
            let fault = cx.shared.runner.lock(|runner| runner.application(|a| a.brightness));
            match fault {
                1 => panic!(\"valve {fault} is stuck\"),
                2 => _ = descend(fault.into()),
                3 => {}
                _ => Task::own(2).answer(),
            }
",
        ),
        (
            "src/main.rs",
            "        let device = DEVICE",
            "        board.watchdog.expect(Task::own(2));
        chip.I2C1.oar1().write(|w| w.add().set(0x30));
        assert_eq!(chip.I2C1.oar1().read().add(), 0x30);
        let c = stm32f4xx_hal::gpio::GpioExt::split(chip.GPIOC, &mut board.rcc);
        let switches = [
            c.pc4.into_pull_up_input().erase(),
            c.pc5.into_pull_up_input().erase(),
            c.pc6.into_pull_up_input().erase(),
            c.pc7.into_pull_up_input().erase(),
            c.pc8.into_pull_up_input().erase(),
            c.pc9.into_pull_up_input().erase(),
            c.pc10.into_pull_up_input().erase(),
        ];
        let defaults = device::DEFAULTS.with_node_id(board::node_id(&switches));
        let device = DEVICE.with_defaults(defaults)",
        ),
        ("src/device.rs", "CRYSTAL_HZ: u32 = 8_000_000", "CRYSTAL_HZ: u32 = 12_000_000"),
        ("src/pins.rs", "run: Led::active_high", "run: Led::active_low"),
        (
            "src/main.rs",
            "    #[init]",
            "    #[inline(never)]
    fn descend(depth: u32) -> u32 {
        if depth == u32::MAX {
            return depth;
        }
        let frame = core::hint::black_box([depth; 8]);
        core::hint::black_box(descend(depth + 1) + frame[7])
    }

    #[init]",
        ),
    ];
    let elf = product::build_changed("faulty", PART, 1, &changes);
    Image::from_elf(&elf.unwrap_or_else(|error| panic!("{error}"))).expect("an ELF file")
});

/// A new board of the product with these switches closed.
fn new_board(closed: u8, tolerates_unmodelled: bool) -> Board {
    let crystal = Clock { hz: 12_000_000, ppm: 0 };
    let settings = board::Settings { crystal, tolerates_unmodelled, ..Default::default() };
    let board = Board::new(PART, &FAULTY, settings);
    set_switches(&board, closed);
    board
}

fn set_switches(board: &Board, closed: u8) {
    for (bit, number) in SWITCHES.into_iter().enumerate() {
        let is_closed = closed >> bit & 1 == 1;
        board.chip().gpio_mut().set_input(Pin('C', number), is_closed.then_some(false));
    }
}

/// A new board of the product on a bus, and what it sends after power-on.
fn with_switches(closed: u8) -> (ImageRig, Frames) {
    let mut rig = ImageRig::new(BitRate::Kbit125, [new_board(closed, true)]);
    let sent = rig.collect(Time::from_ms(500));
    (rig, sent)
}

/// The product as node 4.
fn node_4(tolerates_unmodelled: bool) -> ImageRig {
    let mut board = new_board(0, tolerates_unmodelled);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(4, BitRate::Kbit125)]));
    let mut rig = ImageRig::new(BitRate::Kbit125, [board]);
    assert_eq!(rig.collect(Time::from_ms(500)), ["704: 00"]);
    rig
}

/// The product, until it was reset after this brightness; and the cause and the address in its emergency message.
fn failed(brightness: u8, cause: ResetCause) -> (ImageRig, u8, u32) {
    let mut rig = node_4(true);
    rig.network.allow_reset(0, cause);
    // The fault may come before the answer.
    rig.queue(&sdo::request(4, &format!("2F 00 21 00 {brightness:02X}")));
    rig.expect("704: 00", Time::from_s(3));
    let told = rig.collect(Time::from_ms(20)).0;
    let [0x00, 0x61, 0x01, cause, address @ ..] = told[0].data() else { panic!("{told:?}") };
    (rig, *cause, u32::from_le_bytes(address.try_into().expect("four bytes")))
}

/// The text of the log from the last line on that begins so.
#[track_caller]
fn logged(rig: &ImageRig, begin: &str) -> String {
    let log = log::lines(rig.network.board(0));
    let line = log.iter().find(|line| line.text.starts_with(begin));
    line.unwrap_or_else(|| panic!("no line begins with {begin}")).text.clone()
}

#[test]
fn a_panic_of_a_product_is_told_with_its_file_and_its_line() {
    let (rig, cause, panic_line) = failed(1, ResetCause::Software);
    let source = workspace().join("target/products/faulty/src/main.rs");
    let source = fs::read_to_string(source).expect("it was built");
    let lines_before = source.lines().take_while(|line| !line.contains("panic!(")).count();
    assert_eq!((cause, panic_line), (2, lines_before as u32 + 1));
    assert_eq!(
        logged(&rig, "reset by a panic at "),
        format!("reset by a panic at src/main.rs:{panic_line}")
    );
}

#[test]
fn a_stack_overflow_of_a_product_names_the_function_that_called() {
    let (rig, cause, address) = failed(2, ResetCause::Software);
    let (name, _) = FAULTY.symbol_at(address).expect("a function");
    assert!(cause == 3 && name.contains("descend"), "{name}");
    logged(&rig, &format!("reset by a stack overflow below the call before {address:#x}"));
}

#[test]
fn the_log_names_the_silent_task_of_a_product() {
    let (rig, cause, tasks) = failed(3, ResetCause::Watchdog);
    assert_eq!((cause, tasks), (4, 1 << 7));
    logged(&rig, "reset by the watchdog: a task did not run in time");
    let log = log::lines(rig.network.board(0));
    let silent: Vec<_> = log.iter().filter(|line| line.text.starts_with("silent: ")).collect();
    assert!(silent.len() == 1 && silent[0].text == "silent: Task::own(2)", "{silent:?}");
}

#[test]
fn a_peripheral_that_is_not_modelled_is_a_line_of_the_report() {
    let rig = node_4(true);
    let report = unmodelled::report(rig.network.board(0));
    let [line] = &report[..] else { panic!("{report:?}") };
    assert!(line.starts_with("not modelled: I2C1, offset 08h, used 2 times by "), "{line}");
    assert!(line.contains("app"), "{line}");
}

#[test]
#[should_panic(expected = "to 40005408: not modelled")]
fn a_test_can_refuse_a_peripheral_that_is_not_modelled() {
    node_4(false);
}

#[test]
fn a_product_whose_state_is_too_large_for_the_stack_does_not_link() {
    let state = "values Value;\n\n    private buffer: [u8; 6_000] = [0; 6_000];";
    let change = ("src/application.rs", "values Value;", state);
    let error = product::build_changed("large", PART, 1, &[change]);
    let error = error.map(drop).expect_err("the stack is too small").to_string();
    assert!(error.contains("Give a large buffer to a task"), "{error}");
}

#[test]
fn switches_give_the_node_id_until_one_is_stored() {
    for (closed, boot_up) in [(0x7F, "77F: 00"), (0x40, "740: 00"), (0x05, "705: 00")] {
        assert_eq!(with_switches(closed).1, [boot_up]);
    }
    let (mut rig, _) = with_switches(0x05);
    set_switches(rig.network.board(0), 0x06);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(500)), ["706: 00"], "nothing is stored yet");
    assert_eq!(rig.lss("04 01, 5E, 11 22, 17"), ["5E 06", "11 00", "17 00"]);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(500)), ["722: 00"], "the stored one wins");
    assert_eq!(rig.lss("04 01, 11 FF, 17"), ["11 00", "17 00"]);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(500)), SILENCE, "a stored lack wins, too");
}

#[test]
fn open_switches_leave_a_new_device_without_a_node_id() {
    let (mut rig, sent) = with_switches(0);
    assert_eq!(sent, SILENCE);
    assert_eq!(rig.lss("4C"), ["50"]);
}

#[test]
fn an_led_to_the_supply_is_lit_while_its_pin_is_low() {
    let mut rig = node_4(true);
    let run = |rig: &ImageRig| rig.network.board(0).output(Pin('D', 12)).level;
    rig.nmt("01 04");
    rig.network.run_for(Time::from_ms(100));
    assert_eq!(run(&rig), Some(false), "RUN is lit in operational");
    rig.nmt("02 04");
    let mut high = 0;
    for _ in 0..24 {
        rig.network.run_for(Time::from_ms(50));
        high += u32::from(run(&rig) == Some(true));
    }
    assert_eq!(high, 20, "RUN flashes once, for 200 of 1200 ms, in stopped");
}
