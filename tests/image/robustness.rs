//! The robustness of the release image: hung tasks, faults, power cycles, a full log, bad crystals; and on every chip.

use emulator::chip::FLASH_BASE;

use crate::rig::*;

/// What node 40h sends after the firmware has failed: its boot-up, the cause with its address, and that it is over.
#[track_caller]
fn assert_told(rig: &mut ImageRig, cause: u8, address: u32) {
    let [a, b, c, d] = address.to_le_bytes();
    let told = format!("0C0: 00 61 01 {cause:02X} {a:02X} {b:02X} {c:02X} {d:02X}");
    assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00", &told, "0C0: 00 00 00 00 00 00 00 00"]);
}

/// Thumb instructions: a jump to itself, `bx lr`, which returns at once, and one that is permanently undefined.
const JUMP_TO_ITSELF: [u8; 2] = [0xFE, 0xE7];
const RETURN: [u8; 2] = [0x70, 0x47];
const UNDEFINED: [u8; 2] = [0x00, 0xDE];

#[test]
fn the_watchdog_resets_a_board_and_the_log_names_the_silent_task() {
    const ALL_STOP: &str = "silent: `init`, or the task of TIM2, or one of its priority or above";
    // The last one is the task that stores. A reception that does nothing serves its FIFO in vain.
    let all = [
        ("CAN1_RX0", JUMP_TO_ITSELF, ALL_STOP),
        ("CAN1_TX", JUMP_TO_ITSELF, ALL_STOP),
        ("CAN1_SCE", JUMP_TO_ITSELF, ALL_STOP),
        ("TIM2", JUMP_TO_ITSELF, ALL_STOP),
        ("RCC", JUMP_TO_ITSELF, "silent: the task that stores"),
        ("CAN1_TX", RETURN, "silent: the task of CAN TX"),
        ("CAN1_SCE", RETURN, "silent: the task of CAN SCE"),
        ("TIM2", RETURN, ALL_STOP),
        ("RCC", RETURN, "silent: the task that stores"),
    ];
    for (handler, instruction, named) in all.into_iter().step_by(every(2)) {
        let mut rig = node_40(0);
        let time = replace_until_reset(&mut rig, code(handler), &instruction, ResetCause::Watchdog);
        assert!(time < Time::from_ms(2_500), "{handler}: {time}");
        let tasks = match named {
            "silent: the task of CAN TX" => 1 << 1,
            "silent: the task of CAN SCE" => 1 << 2,
            "silent: the task that stores" => 1 << 3 | u32::from(instruction != RETURN) << 4,
            _ => 0,
        };
        assert_told(&mut rig, 4, tasks);
        assert_eq!(rig.lss("5E"), SILENCE, "in waiting state");
        assert!(rig.has_logged("reset by the watchdog"), "{handler}");
        assert!(rig.has_logged(named), "{handler}: {named}");
    }
}

#[test]
fn the_watchdog_resets_a_board_that_does_not_get_to_sleep() {
    let mut rig = node_40(0);
    let asleep_at = rig.network.board(0).pc() - FLASH_BASE;
    let time = replace_until_reset(&mut rig, asleep_at, &JUMP_TO_ITSELF, ResetCause::Watchdog);
    assert!(time < Time::from_ms(2_500), "{time}");
    assert_told(&mut rig, 4, 1 << 4);
    assert!(rig.has_logged("silent: `idle`"));
}

#[test]
fn a_fault_is_logged_and_ends_in_a_reset_at_once() {
    let mut rig = node_40(0);
    let faulty = code("CAN1_RX0");
    let time = replace_until_reset(&mut rig, faulty, &UNDEFINED, ResetCause::Software);
    assert!(time < Time::from_ms(300), "{time}");
    assert_told(&mut rig, 1, FLASH_BASE + faulty);
    assert!(rig.has_logged(&format!("reset by a hard fault at {:#x}", FLASH_BASE + faulty)));
}

#[test]
fn a_fault_stays_in_2000h_and_1003h_until_a_reset_that_is_none() {
    let mut rig = node_40(0);
    let faulty = code("CAN1_RX0");
    replace_until_reset(&mut rig, faulty, &UNDEFINED, ResetCause::Software);
    assert_told(&mut rig, 1, FLASH_BASE + faulty);
    let mut read = |index, sub_index| {
        let mut value = rig.sdo_client(0x40).upload(index, sub_index).expect("an object");
        value.resize(4, 0);
        u32::from_le_bytes(value.try_into().expect("four bytes"))
    };
    assert_eq!([read(0x2000, 8), read(0x2000, 9)], [1, FLASH_BASE + faulty]);
    assert_eq!(read(0x1003, 1), 0x6100 | 1 << 16 | (FLASH_BASE + faulty) << 24);
    assert_eq!(read(0x1001, 0), 0, "it is over");
    rig.network.allow_reset(0, ResetCause::Software);
    rig.transmit_command("81 40");
    assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
    assert!(rig.has_logged("reset by NMT or by the firmware"));
    assert_eq!(rig.sdo_client(0x40).upload(0x2000, 8), Ok(vec![0]));
}

#[test]
fn power_on_the_pin_and_a_debugger_are_no_failures() {
    let mut rig = node_40(0);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
    for (cause, line) in [
        (ResetCause::Pin, "power-on, or reset by the pin"),
        (ResetCause::Software, "reset by a debugger"),
    ] {
        rig.network.allow_reset(0, cause);
        rig.network.board_mut(0).reset(cause);
        assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
        assert!(rig.has_logged(line), "{line}");
    }
}

/// A jump to `to` in the place of the instruction at `at` (B.W, ARM DDI 0403, A7.7.12), or a call of it (BL, A7.7.18).
fn branch(at: u32, to: u32, second: u32) -> [u8; 4] {
    let distance = to.wrapping_sub(at + 4);
    let first = 0xF000 | distance >> 31 << 10 | distance >> 12 & 0x3FF;
    let second = second | distance >> 1 & 0x7FF;
    (first | second << 16).to_le_bytes()
}

const JUMP: u32 = 0xB800;
const CALL: u32 = 0xF800;

/// A value that logs as it is logged, or a recursion with a log line in it.
#[test]
fn a_fault_within_a_log_line_is_told_as_any_other() {
    let mut rig = node_40(0);
    let handler = code("CAN1_RX0");
    let faults = [&branch(handler, code("_defmt_acquire"), CALL)[..], &UNDEFINED].concat();
    let time = replace_until_reset(&mut rig, handler, &faults, ResetCause::Software);
    assert!(time < Time::from_ms(300), "{time}");
    assert_told(&mut rig, 1, FLASH_BASE + handler + 4);
    assert!(rig.has_logged(&format!("reset by a hard fault at {:#x}", FLASH_BASE + handler + 4)));
}

#[test]
fn a_panic_ends_in_a_logged_hard_fault_and_a_reset_at_once() {
    let mut rig = node_40(0);
    let handler = code("CAN1_RX0");
    // Ending a log line that has not begun makes the logger panic.
    let panics = branch(handler, code("_defmt_release"), JUMP);
    let time = replace_until_reset(&mut rig, handler, &panics, ResetCause::Software);
    assert!(time < Time::from_ms(300), "{time}");
    let [boot_up, told, _] = &rig.collect(Time::from_ms(20)).0[..] else { panic!("no emergency") };
    assert_eq!((boot_up.cob_id(), &told.data()[..4]), (0x740, &[0x00, 0x61, 1, 1][..]));
    assert!(rig.has_logged("reset by a hard fault at "));
}

#[test]
fn the_fastest_watchdog_clock_bears_the_slowest_flash() {
    // LSI may run at 47 kHz instead of 32, and an erase may take 500 ms.
    let variant =
        ChipVariant { lsi_hz: 47_000, flash_timing: Timing::Worst, ..ChipVariant::default() };
    let mut board = Board::new(PART, image(), chip(variant));
    board.set_flash(SETTINGS_OFFSET, &[0; 0x8000]);
    let mut rig = ImageRig::new(BitRate::Kbit125, [board]);
    assert_eq!(rig.collect(Time::from_s(30)), SILENCE);
    assert_eq!(rig.lss("4C"), ["50"]);
}

#[test]
fn settings_survive_power_cycles_and_resets() {
    let mut random = Random::from_environment();
    let mut rig = node_40(0);
    for _ in 0..20 {
        let node_id = random.within(1..128);
        let bit_rate = random.pick(&BitRate::ALL[..5]);
        let requests = format!("04 01, 11 {node_id:02X}, 13 00 {:02X}, 17", bit_rate.index());
        assert_eq!(rig.lss(&requests), ["11 00", "13 00", "17 00"]);
        rig.network.power_off(0);
        rig.set_master_bit_rate(bit_rate);
        rig.power_on(0);
        let boot_up = format!("{:03X}: 00", 0x700 + node_id);
        assert_eq!(rig.collect(Time::from_ms(20)), [boot_up.as_str()]);
        rig.network.allow_reset(0, ResetCause::Pin);
        rig.network.board_mut(0).reset(ResetCause::Pin);
        assert_eq!(rig.collect(Time::from_ms(20)), [boot_up.as_str()]);
    }
}

#[test]
fn a_board_keeps_its_settings_when_it_gets_the_firmware_of_another_product() {
    let board = example_board(settings(0x40, BitRate::Kbit1000));
    let mut other = ImageRig::new(BitRate::Kbit1000, [board]);
    other.collect(BOOT);
    let mut client = other.sdo_client(0x40);
    client.download(0x2101, 3, b"a label").expect("it is writable");
    client.download(0x1010, 1, b"save").expect("the flash works");
    let flash = other.network.board(0).flash();
    let content = &flash[SETTINGS_OFFSET as usize..][..SETTINGS_LENGTH];

    let mut rig = ImageRig::new(BitRate::Kbit1000, [board_with_flash(content)]);
    assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
    assert_stores(&mut rig);
}

#[test]
fn a_full_log_refuses_with_17_02_until_the_next_power_on_makes_room() {
    let rate = BitRate::Kbit1000;
    let stores: Vec<Stored> = (0..380).map(|n| settings((n % 127) as u8 + 1, rate)).collect();
    let mut rig = ImageRig::new(rate, [board_with_flash(&flash_with(&stores))]);
    rig.lss("04 01");
    let store = |rig: &mut ImageRig, n: usize| {
        rig.lss(&format!("11 {:02X}", n % 127 + 1));
        rig.lss("17")
    };
    let stored = (0..1_100).take_while(|&n| store(&mut rig, n) == ["17 00"]).count();
    // At least a bank: docs/reference.md.
    assert!((400..=802).contains(&stored), "{stored} stores");
    assert_eq!(store(&mut rig, stored), ["17 02"]);
    rig.power_cycle(0);
    rig.collect(Time::from_ms(20));
    rig.lss("04 01");
    assert_eq!(rig.lss("5E"), [format!("5E {:02X}", (stored - 1) % 127 + 1).as_str()]);
    assert_eq!(store(&mut rig, 0x4F), ["17 00"]);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["750: 00"]);
}

#[test]
fn the_same_session_has_the_same_trace_twice() {
    let live = || {
        let boards = [1, 2, 3].map(|number| {
            let heartbeat_ms = 10 * u16::from(number);
            board_with(number, settings(number, BitRate::Kbit1000).with_heartbeat_ms(heartbeat_ms))
        });
        let mut rig = ImageRig::new(BitRate::Kbit1000, boards);
        rig.lss("04 01, 5A, 11 04, 13 00 02, 17, 5E");
        rig.power_cycle(1);
        rig.nmt("01 00");
        rig.lss("15 32 00");
        rig.collect(Time::from_ms(300));
        let logs: Vec<_> = rig.network.boards().iter().map(log::lines).collect();
        let cycles: Vec<_> = rig.network.boards().iter().map(Board::cycles).collect();
        (rig.network.trace().to_vec(), logs, cycles)
    };
    assert!(live() == live());
}
