//! The release image on difficult hardware: a low supply, a crystal that does not start or stops, a slow core, a
//! brown-out, a boot loader, a probe.

use emulator::{
    can::Clock,
    chip::{Access, RAM_BASE, StartUp, Thresholds, Width},
};

use crate::rig::*;

fn says(board: &Board, text: &str) -> usize {
    log::lines(board).iter().filter(|line| line.text.starts_with(text)).count()
}

fn run(board: &mut Board, until: Time) {
    while board.now() < until {
        board.run_until(until);
    }
}

/// The answers to a store of another node-ID, and the flash operations that it takes.
fn store(rig: &mut ImageRig, node_id: u8) -> (Frames, u64) {
    let operations = |rig: &ImageRig| rig.network.board(0).chip().flash().operations();
    let before = operations(rig);
    rig.lss(&format!("04 01, 11 {node_id:02X}"));
    let answers = rig.lss("17");
    (answers, operations(rig) - before)
}

/// Programming by words needs 2.7 V, by bytes 1.8 V: the emulated flash reports the wrong width.
#[test]
fn a_store_programs_words_if_the_supply_is_safely_above_2_7_v_or_else_bytes() {
    for thresholds in [Thresholds::Lowest, Thresholds::Typical, Thresholds::Highest] {
        let mut rig = node_40_on(ChipVariant { thresholds, ..ChipVariant::default() });
        let (answers, words) = store(&mut rig, 4);
        assert_eq!(answers, ["17 00"]);
        let lower = [2_900, 2_800, 2_749, 2_700, 2_500, 2_100];
        for (node_id, mv) in (5..).zip(lower.into_iter().chain([3_000])) {
            rig.network.board_mut(0).set_supply(mv);
            let (answers, operations) = store(&mut rig, node_id);
            assert_eq!(answers, ["17 00"], "{thresholds:?} {mv} mV");
            let by_words = operations == words;
            assert!(by_words || operations == 4 * words, "{thresholds:?} {mv} mV: {operations}");
            assert!(mv < 3_000 || by_words, "{thresholds:?} {mv} mV");
        }
        rig.power_cycle(0);
        assert_eq!(rig.collect(Time::from_ms(20)), ["70B: 00"]);
    }
}

#[test]
fn a_supply_that_rises_slowly_is_waited_for_before_the_flash_is_erased() {
    let mut rig = blank_rig();
    rig.network.power_off(0);
    rig.network.board_mut(0).set_flash(SETTINGS_OFFSET, &[0xFF; 0x8000]);
    rig.network.board_mut(0).set_supply(2_000);
    let operations = |rig: &ImageRig| rig.network.board(0).chip().flash().operations();
    let before = operations(&rig);
    let since = rig.network.now();
    rig.network.power_on(0);
    rig.network.run_for(Time::from_ms(80));
    assert_eq!(operations(&rig), before);
    rig.network.board_mut(0).set_supply(3_300);
    rig.boot(0, since);
    assert!(operations(&rig) > before, "it has formatted");
    assert_eq!(rig.lss("04 01, 11 04, 17"), ["11 00", "17 00"]);
}

/// The emulated chip reports too few wait states for its supply.
#[test]
fn a_node_whose_supply_stays_low_is_on_the_bus_and_formats_and_stores() {
    for mv in [2_310, 2_500, 2_700] {
        let mut board = blank_board(0);
        board.set_supply(mv);
        let mut rig = ImageRig::new(DEFAULT_BIT_RATE, [board]);
        assert_eq!(rig.lss("4C"), ["50"]);
        assert_stores(&mut rig);
    }
}

#[test]
fn a_supply_below_2_1_v_is_told_and_waited_for_at_the_clock_of_the_reset() {
    let mut board = blank_board(0);
    board.power_off();
    board.set_supply(2_000);
    board.power_on();
    run(&mut board, Time::from_s(2));
    let low = "the supply is below 2.1 V, which the clock needs: waiting for it";
    assert!((3..7).contains(&says(&board, low)), "{:#?}", log::lines(&board));
    assert!(!board.chip().can(1).is_in_use());
    board.set_supply(2_400);
    run(&mut board, Time::from_s(3));
    assert_eq!(board.chip().can(1).bit_rate(), bit_per_s(DEFAULT_BIT_RATE));
    assert_eq!(board.findings(), []);
}

/// After the failure the board must not send; a frame under way ends as an error.
#[test]
fn a_crystal_that_stops_is_logged_and_ends_in_a_reset_at_once() {
    for under_way in [false, true] {
        let mut rig = node_40_on(ChipVariant::default());
        if under_way {
            rig.transmit_command("82 40");
            rig.network.run_for(Time::from_us(30));
        }
        let from = rig.network.now();
        rig.network.allow_reset(0, ResetCause::Software);
        rig.network.board_mut(0).stop_crystal();
        rig.network.run_for(Time::from_ms(50));
        let resets = rig.network.board(0).resets();
        assert_eq!(resets.len(), 2);
        assert!(resets[1].0 < from + Time::from_us(10), "after {}", resets[1].0 - from);
        let is_sent = |event: &&Event| {
            event.time > from
                && matches!(event.what, What::Frame { .. } | What::InitializationLeft)
                && event.source == Source::Board(0)
        };
        assert_eq!(rig.network.trace().iter().filter(is_sent).count(), 0);
        let restart = rig.network.now();
        rig.network.board_mut(0).start_crystal();
        rig.boot(0, restart);
        rig.collect(Time::from_ms(20));
        assert_eq!(rig.lss("5E"), SILENCE);
        assert_eq!(rig.lss("04 01, 5E"), ["5E 40"]);
        let log = log::lines(rig.network.board(0));
        let says = says(rig.network.board(0), "reset because the crystal stopped");
        assert_eq!(says, 1, "{log:#?}");
    }
}

/// HSE in the other mode: a crystal does not start with HSEBYP, an external clock not without.
#[test]
fn an_external_clock_in_place_of_the_crystal_starts_100_ms_later_and_is_told() {
    let mut rig = node_40_on(ChipVariant { external_clock: true, ..ChipVariant::default() });
    assert!(rig.has_logged("CRYSTAL_IS_EXTERNAL_CLOCK in device.rs is wrong"));
    assert!(answers(&mut rig));
    assert_stores(&mut rig);
}

/// The board with this crystal, after half a second.
fn board_with_crystal(hz: u32, hsi_ppm: i32) -> Board {
    let variant = chip(ChipVariant { hsi_ppm, ..ChipVariant::default() });
    let variant = board::Settings { crystal: Clock { hz, ppm: 0 }, ..variant };
    let mut board = board_of(variant, settings(5, BitRate::Kbit125));
    run(&mut board, Time::from_ms(500));
    board
}

#[test]
fn a_crystal_of_another_frequency_is_told_with_its_value_and_never_drives_the_bus() {
    for mhz in [4, 7, 9, 10, 12, 16, 24, 25, 26, 50] {
        for hsi_ppm in [-10_000, 0, 10_000] {
            let board = board_with_crystal(mhz * 1_000_000, hsi_ppm);
            let line = log::lines(&board).pop().expect("a line").text;
            let words = line.strip_prefix("the crystal has ").expect("the last line");
            let khz: u32 = words.split(' ').next().and_then(|khz| khz.parse().ok()).expect(&line);
            assert!(khz.abs_diff(mhz * 1_000) <= 11 * mhz, "{mhz} MHz, HSI {hsi_ppm}: {line}");
            assert!(!board.chip().can(1).is_in_use() && board.findings().is_empty(), "{mhz} MHz");
        }
    }
}

#[test]
fn a_right_crystal_starts_at_each_temperature_of_the_oscillator_that_measures_it() {
    let warning = "the crystal seems to have ";
    for (hz, hsi_ppm, warns) in [
        (8_000_000, 0, 0),
        (8_000_000, -10_000, 0),
        (8_000_000, 10_000, 0),
        (8_000_000, -80_000, 1),
        (8_000_000, 45_000, 1),
        (8_320_000, 0, 1),
    ] {
        let board = board_with_crystal(hz, hsi_ppm);
        assert_eq!(says(&board, warning), warns, "{hz} Hz, HSI {hsi_ppm}");
        assert!(board.chip().can(1).is_in_use() && board.findings().is_empty(), "{hz} {hsi_ppm}");
    }
}

#[test]
fn a_crystal_that_does_not_start_causes_a_reset_and_a_log_twice_a_second() {
    let mut board = Board::new(
        PART,
        image(),
        chip(ChipVariant { hse_start: Time::MAX, ..ChipVariant::default() }),
    );
    run(&mut board, Time::from_ms(1_700));
    let resets = board.resets();
    assert!(resets[1..].iter().all(|&(_, cause)| cause == ResetCause::Software), "{resets:?}");
    for pair in resets.windows(2) {
        let lasted = pair[1].0 - pair[0].0;
        assert!(Time::from_ms(300) < lasted && lasted < Time::from_ms(700), "{lasted}");
    }
    // Each start tells of the one before.
    let lines = says(&board, "reset because the crystal did not start");
    assert_eq!((lines, board.findings()), (resets.len() - 1, vec![]));
}

/// As a task that changes the mode of another pin of the port does if it is interrupted between reading and writing.
#[test]
fn the_transmit_pin_gets_its_mode_again_within_250_ms_if_other_code_takes_it_back() {
    const GPIOB_MODER: u32 = 0x4002_0400;
    let mut rig = node_40(0);
    let access = |rig: &ImageRig| Access {
        address: GPIOB_MODER,
        width: Width::Word,
        now: rig.network.now(),
        pc: 0,
    };
    let moder = |rig: &ImageRig| rig.network.board(0).chip().read(access(rig)).expect("a register");
    let right = moder(&rig);
    let output = right & !(0b11 << 18) | 0b01 << 18;
    rig.network.board(0).chip().write(access(&rig), output).expect("a register");
    assert_eq!(moder(&rig), output);
    rig.network.run_for(Time::from_ms(250));
    assert_eq!(moder(&rig), right);
    assert_eq!(rig.lss("04 01, 5E"), ["5E 40"]);
}

#[test]
fn parts_as_slow_or_as_quick_as_allowed_are_enough_to_answer_and_to_store() {
    let usual = ChipVariant::default();
    let crystal = |us| ChipVariant { hse_start: Time::from_us(us), ..usual };
    for variant in [
        crystal(100),
        crystal(10_000),
        crystal(90_000),
        ChipVariant { slowdown: 2, ..usual },
        ChipVariant { slowdown: 3, ..usual },
        ChipVariant { start_up: StartUp::Fastest, ..crystal(100) },
        ChipVariant { start_up: StartUp::Slowest, ..crystal(10_000) },
        // The core runs on while the flash is busy.
        ChipVariant { cached_code: true, ..usual },
    ] {
        println!("{variant:?}");
        let mut rig = node_40_on(variant);
        assert!(answers(&mut rig));
        assert_stores(&mut rig);
    }
}

/// With the brown-out level of the flash's needs, a supply that sags at any time of a store leaves old or new settings.
#[test]
fn a_brown_out_while_settings_are_written_loses_none() {
    let mut found_new = 0;
    for us in (0..=220).step_by(5) {
        let mut rig = node_40_on(ChipVariant::default());
        rig.network.board(0).chip().flash_mut().set_brown_out_level(3);
        rig.lss("04 01, 11 04");
        rig.transmit_request("17");
        rig.network.run_for(Time::from_us(us));
        rig.network.allow_reset(0, ResetCause::BrownOut);
        rig.network.board_mut(0).set_supply(2_800);
        rig.network.run_for(Time::from_ms(2));
        let since = rig.network.now();
        rig.network.board_mut(0).set_supply(3_300);
        rig.boot(0, since);
        let shown = rig.collect(Time::from_ms(20));
        let is_new = shown == ["704: 00"];
        assert!(is_new || shown == ["740: 00"], "after {us} us: {shown:?}");
        found_new += u32::from(is_new);
    }
    assert!((5..40).contains(&found_new), "{found_new} of 45 found the new settings");
}

/// The Discovery feeds its chip from 3 V through a diode.
#[test]
fn a_store_at_the_2_93_v_of_a_discovery_works_on_every_chip() {
    for thresholds in [Thresholds::Lowest, Thresholds::Typical, Thresholds::Highest] {
        let of_chip = chip(ChipVariant { thresholds, ..ChipVariant::default() });
        let board = Board::new(PART, image(), board::Settings { supply_mv: 2_930, ..of_chip });
        let mut rig = ImageRig::new(BitRate::Kbit125, [board]);
        let joined = rig.network.now();
        // A new board erases two sectors by words.
        assert!(joined < Time::from_ms(550), "{thresholds:?}: {joined}");
        assert_stores(&mut rig);
        let since = rig.network.now();
        rig.power_cycle(0);
        assert!(rig.network.now() < since + Time::from_ms(30), "{thresholds:?}");
    }
}

/// `dfu-util ... :leave` with BOOT0 high.
#[test]
fn a_board_that_a_boot_loader_starts_is_on_the_bus_within_10_ms() {
    let variant = ChipVariant { boot_loader: true, ..ChipVariant::default() };
    let mut rig = rig_of(chip(variant), settings(0x40, BitRate::Kbit125));
    let (boot_up, frames) = rig.next_frame();
    assert_eq!(frames, ["740: 00"]);
    let stack = RAM_BASE..RAM_BASE + 0x4000;
    assert!(stack.contains(&rig.network.board(0).sp()), "it has its own stack");
    let started = StartUp::Typical.reset();
    assert!(boot_up < started + Time::from_ms(10), "{}", boot_up - started);
    assert_eq!(rig.lss("04 01, 5E"), ["5E 40"]);
    rig.network.run_for(Time::from_s(5));
    rig.network.allow_reset(0, ResetCause::Software);
    let since = rig.network.now();
    rig.transmit_command("81 40");
    rig.boot(0, since);
    assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
}

#[test]
fn the_debug_port_stays_on_in_sleep_when_a_probe_has_switched_that_off() {
    const DBGMCU_CR: u32 = 0xE004_2004;
    let mut rig = node_40_on(ChipVariant::default());
    let dbg_sleep = |rig: &ImageRig| {
        let board = rig.network.board(0);
        let now = board.now();
        let access = Access { address: DBGMCU_CR, width: Width::Word, now, pc: 0 };
        let was = board.chip().read(access).expect("a register");
        board.chip().write(access, 0).expect("a register");
        was & 1
    };
    assert_eq!(dbg_sleep(&rig), 1);
    // Two roll calls.
    rig.network.run_for(Time::from_ms(510));
    assert_eq!(dbg_sleep(&rig), 1);
}
