//! The port to embassy-stm32 on its emulated chips, in virtual time: what a session over an adapter cannot do to a board.
//! `.ci/run ports` builds the programs.

use emulator::{
    Time,
    board::{self, Board},
    can::Clock,
    chip::{Access, ChipVariant, Part, PowerCut, ResetCause, Width},
    image::Image,
    network::{Short, What},
};
use testkit::{
    cargo,
    frames::SILENCE,
    image_rig::{DEFAULT_BIT_RATE, ImageRig},
    log,
};

/// Defines a test of each property with each chip.
macro_rules! shown_on {
    ($($chip:ident $part:ident),*: $properties:tt) => {$(
        mod $chip {
            shown_on!(@ $part $properties);
        }
    )*};
    (@ $part:ident { $($property:ident),* }) => {$(
        #[test]
        fn $property() {
            super::$property(emulator::chip::Part::$part);
        }
    )*};
}

shown_on! { stm32f407 Stm32f407, stm32g431 Stm32g431: {
    the_program_starts_at_every_reset_with_a_transceiver_on_a_quiet_bus,
    a_crystal_that_does_not_start_is_logged_and_ends_in_resets,
    a_clock_that_is_not_that_of_the_crystal_ends_in_a_reset,
    the_node_recovers_from_bus_off_as_soon_as_the_bus_is_whole,
    after_a_halt_of_the_core_the_node_is_back_in_100_ms_without_old_answers
} }

/// A board as the file of its chip in `boards/embassy/src/chip/` names it.
fn board_with(part: Part, chip_variant: ChipVariant) -> Board {
    let program = cargo::workspace().join(format!("target/embassy/{}.elf", part.name()));
    let image = Image::load(program).expect("built by `.ci/run ports`");
    let mhz = if part == Part::Stm32g431 { 24 } else { 8 };
    let crystal = Clock { hz: mhz * 1_000_000, ppm: 0 };
    Board::new(part, &image, board::Settings { crystal, chip_variant, ..Default::default() })
}

/// Node 4 with a heartbeat of 1 s, in LSS configuration state.
fn node_4(part: Part) -> ImageRig {
    let mut rig = ImageRig::new(DEFAULT_BIT_RATE, []);
    rig.network.permit_misuse();
    rig.network.add_board(board_with(part, ChipVariant::default()));
    rig.boot(0, Time::ZERO);
    rig.lss("04 01, 11 04, 17, 04 00");
    rig.lss("04 01");
    rig
}

/// Checks that the board was reset this often, and has misused its chip in no other way than the driver does.
fn assert_clean(rig: &ImageRig, resets: usize) {
    // embassy-stm32 clears bits of RCC_DCKCFGR, which only some STM32F4 have, and locks FLASH_CR with SER set.
    const EXPLAINED: [u32; 2] = [0x4002_388C, 0x4002_3C10];
    let board = rig.network.board(0);
    let mut findings = board.findings();
    findings.retain(|finding| !EXPLAINED.contains(&finding.address));
    assert_eq!((findings, board.lockup()), (vec![], None));
    assert_eq!(board.resets().len(), 1 + resets, "{:?}", board.resets());
}

/// The answers to a question, beside heartbeats.
fn ask(rig: &mut ImageRig, question: &str) -> Vec<String> {
    let mut texts = rig.lss(question).texts();
    texts.retain(|text| text.starts_with("7E4"));
    texts
}

/// PB8 of an STM32G4 would be BOOT0: a receiver there holds it high.
fn the_program_starts_at_every_reset_with_a_transceiver_on_a_quiet_bus(part: Part) {
    let mut rig = node_4(part);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(50)).texts()[0], "704: 00");
    let since = rig.network.now();
    rig.transmit_command("81 04");
    rig.boot(0, since);
    assert_eq!(rig.collect(Time::from_ms(50)).texts()[0], "704: 00");
    assert_clean(&rig, 2);
}

/// RCC_CSR: the watchdog, which keeps LSI on, is older than the wait for the crystal.
fn a_crystal_that_does_not_start_is_logged_and_ends_in_resets(part: Part) {
    const LSIRDY: u32 = 1 << 1;
    let variant = ChipVariant { hse_start: Time::MAX, ..ChipVariant::default() };
    let mut board = board_with(part, variant);
    let until = Time::from_ms(1_000);
    while board.now() < until {
        board.run_until(until);
    }
    let csr = if part == Part::Stm32g431 { 0x4002_1094 } else { 0x4002_3874 };
    assert_ne!(read(&board, csr) & LSIRDY, 0);
    let resets = board.resets();
    assert!(resets[1..].iter().all(|&(_, cause)| cause == ResetCause::Software), "{resets:?}");
    assert!((3..=10).contains(&resets.len()), "{resets:?}");
    let says = |text| log::lines(&board).iter().filter(|line| line.text.starts_with(text)).count();
    // The last start may not have come to it.
    let lines = says("the crystal does not start, resetting");
    assert!((resets.len() - 1..=resets.len()).contains(&lines), "{lines} of {}", resets.len());
}

fn access(board: &Board, address: u32) -> Access {
    Access { address, width: Width::Word, now: board.now(), pc: 0 }
}

fn read(board: &Board, address: u32) -> u32 {
    let access = access(board, address);
    board.chip().read(access).expect("a register")
}

/// Something else sets the PLL between the two writes of the program.
fn a_clock_that_is_not_that_of_the_crystal_ends_in_a_reset(part: Part) {
    const PLLON: u32 = 1 << 24;
    // RCC_CR and RCC_PLLCFGR, a bit of it that the program sets before PLLON, and a bit of the factor N.
    let (cr, pllcfgr, last, factor) = match part {
        Part::Stm32g431 => (0x4002_1000, 0x4002_100C, 1 << 24, 1 << 8),
        _ => (0x4002_3800, 0x4002_3804, 1 << 22, 1 << 6),
    };
    let mut board = board_with(part, ChipVariant::default());
    while read(&board, pllcfgr) & last == 0 {
        assert!(board.now() < Time::from_ms(100), "the program does not set the PLL");
        board.run_until(board.now() + Time::from_ns(10));
    }
    assert_eq!(read(&board, cr) & PLLON, 0, "it is not on yet");
    let set = read(&board, pllcfgr);
    let access = access(&board, pllcfgr);
    board.chip().write(access, set ^ factor).expect("a register");
    while board.resets().len() == 1 {
        assert!(board.now() < Time::from_ms(500), "no reset");
        board.run_until(board.now() + Time::from_ms(1));
    }
    assert_eq!(board.resets()[1].1, ResetCause::Software);
    let log = log::lines(&board);
    assert!(log.iter().any(|line| line.text.starts_with("the clock is not that")), "{log:?}");
}

/// FDCAN waits for its program to begin the recovery (RM0440 44.4.7).
fn the_node_recovers_from_bus_off_as_soon_as_the_bus_is_whole(part: Part) {
    let mut rig = node_4(part);
    let since = rig.network.now();
    rig.short_circuit(Short::Recessive, Time::from_s(3));
    assert!(rig.did(0, since).any(|event| event.what == What::BusOff));
    // 128 times 11 bits, or one time more, and the time to a look at the controller.
    rig.reach("5E", "5E 04", Time::from_ms(300));
    rig.collect(Time::from_ms(300));
    for line in ["CAN: bus-off", "CAN: recovered from bus-off"] {
        assert!(rig.has_logged(line), "{line}");
    }
    assert_clean(&rig, 0);
}

fn after_a_halt_of_the_core_the_node_is_back_in_100_ms_without_old_answers(part: Part) {
    let mut rig = node_4(part);
    rig.collect(Time::from_ms(300));
    // More than half a turn of the count of microseconds, too.
    for seconds in [2, 2, 2, 40 * 60] {
        let until = rig.network.now() + Time::from_s(seconds);
        rig.network.board_mut(0).halt();
        rig.network.run_for(Time::from_ms(20));
        rig.collect(Time::ZERO);
        for request in ["5E", "5A", "604: 40 00 10 00 00 00 00 00", "5B"] {
            rig.send(request);
            rig.network.run_for(Time::from_ms(100));
        }
        rig.network.run_until(until);
        assert_eq!(rig.collect(Time::ZERO), SILENCE, "while it was halted");
        rig.network.board_mut(0).resume();
        assert_eq!(rig.collect(Time::from_ms(100)), ["704: 7F"], "{seconds} s");
        assert_eq!(ask(&mut rig, "5E"), ["7E4: 5E 04 00 00 00 00 00 00"]);
        rig.collect(Time::from_s(3));
    }
    assert_clean(&rig, 0);
}

#[test]
fn an_nmi_that_is_not_for_the_flash_ends_in_a_reset_at_once() {
    let mut rig = node_4(Part::Stm32g431);
    let since = rig.network.now();
    rig.network.board_mut(0).chip().fail_parity();
    rig.boot(0, since);
    let resets = rig.network.board(0).resets();
    assert_eq!(resets.last().map(|(_, cause)| *cause), Some(ResetCause::Software));
    assert!(resets[1].0 < since + Time::from_ms(1), "{resets:?}");
    assert_clean(&rig, 1);
}

/// The handler of the NMI: without it the program would hang until the watchdog resets it, again and again.
#[test]
fn after_a_power_cut_in_any_write_of_a_store_double_errors_do_not_stop_the_start() {
    let (mut double_errors, mut found_new) = (0, 0);
    for (operation, seed) in (0..12).flat_map(|operation| (0..6).map(move |seed| (operation, seed)))
    {
        let mut rig = node_4(Part::Stm32g431);
        let first = rig.network.board(0).chip().flash().operations();
        let cut = PowerCut { operation: first + operation, seed };
        rig.network.board(0).chip().flash_mut().cut_power(cut);
        rig.send("11 05, 17");
        rig.network.run_for(Time::from_ms(50));
        let was_cut = !rig.network.board(0).is_powered();
        assert!(was_cut || operation > 2, "{operation} of a store");
        rig.power_cycle(0);
        double_errors += rig.network.board(0).chip().flash().double_errors().count();
        let shown = rig.collect(Time::from_ms(50)).texts();
        let shown = shown.last().map(String::as_str);
        let is_new = shown == Some("705: 00");
        assert!(is_new || shown == Some("704: 00"), "{operation} {seed}: {shown:?}");
        found_new += u32::from(is_new);
        assert_clean(&rig, 1);
    }
    assert!(double_errors > 5 && found_new > 5, "{double_errors} {found_new}");
}
