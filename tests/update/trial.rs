//! What loader and program do by themselves: the emergency without a program, the trial, failures in a row, and the
//! hand-over of what is in force.

use canopen_node::BitRate;
use emulator::{
    Time,
    board::{self, Board},
    chip::{FLASH_BASE, ResetCause},
    image::Image,
};
use program_update::{Status, header::HEADER_LEN};
use testkit::{
    boards,
    image_rig::{ImageRig, SETTINGS_OFFSET},
    sdo::Client,
    update,
};

use super::{
    bad_programs::{UNDEFINED, with_first_instruction},
    rig::{IMAGES, NODE, PART, RATE, RUN, Rig, file, file_of, program, stored},
};

/// The states in 2001h.
const TRIAL: u32 = 2;
const KEPT: u32 = 3;

fn board_with(image: &Image) -> Board {
    let settings = board::Settings { unique_id: boards::unique_id(0), ..Default::default() };
    let mut board = Board::new(PART, image, settings);
    board.set_flash(SETTINGS_OFFSET, &stored());
    board
}

/// A board whose new program has just been started on trial.
fn on_trial() -> Rig {
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    rig.stop_and_clear();
    assert!(rig.try_download(&file("0.2.0")).unwrap());
    rig.start();
    rig
}

#[test]
fn a_loader_without_a_program_sends_emergency_6200h() {
    let mut rig = Rig(ImageRig::new(RATE, [board_with(&IMAGES[0])]), Time::from_ms(500));
    let frames = rig.0.collect(Time::from_ms(20));
    let texts: Vec<String> = frames.0.iter().map(testkit::frames::text).collect();
    assert_eq!(texts, ["705: 00", "085: 00 62 01 00 00 00 00 00"]);
    // 1F51h = 3: no valid program.
    assert_eq!(rig.number(0x1F51, 1), 3);
}

#[test]
fn a_program_on_trial_confirms_itself_10_s_after_an_sdo_answer_not_before() {
    let mut rig = on_trial();
    rig.0.network.run_for(Time::from_s(12));
    assert_eq!(rig.number(0x2001, 1), TRIAL, "nobody had asked");
    rig.0.network.run_for(Time::from_ms(9_700));
    assert_eq!(rig.number(0x2001, 1), TRIAL);
    rig.0.network.run_for(Time::from_ms(600));
    assert_eq!(rig.number(0x2001, 1), KEPT);
}

#[test]
fn a_program_on_trial_that_nobody_confirms_is_reset_after_60_s() {
    let mut rig = on_trial();
    let started = rig.0.network.now();
    let resets = rig.0.network.board(0).resets().len();
    rig.0.network.run_until(started + Time::from_ms(59_500));
    assert_eq!(rig.0.network.board(0).resets().len(), resets);
    let again = rig.0.expect("705: 00", Time::from_s(1));
    assert!(again < started + Time::from_ms(60_500), "{} ms", (again - started).as_ms());
    assert_eq!(rig.0.network.board(0).resets().len(), resets + 1);
    assert_eq!((rig.number(0x2001, 1), rig.number(0x2001, 2)), (TRIAL, 2), "the second start");
}

/// A probe resets the chip by SYSRESETREQ, as the firmware does, and leaves nothing.
fn reset_by_a_debugger(rig: &mut Rig) {
    rig.0.network.allow_reset(0, ResetCause::Software);
    rig.0.network.board_mut(0).reset(ResetCause::Software);
    rig.0.expect("705: 00", Time::from_ms(200));
}

#[test]
fn resets_by_a_debugger_are_no_failures_of_a_program() {
    let mut rig = Rig::new();
    for _ in 0..7 {
        reset_by_a_debugger(&mut rig);
        // The program runs, not the loader.
        assert_eq!((rig.number(0x1F51, 1), rig.version().as_str()), (1, "0.1.0"));
    }
}

#[test]
fn resets_by_a_debugger_take_no_start_of_a_trial() {
    let mut rig = on_trial();
    for _ in 0..4 {
        reset_by_a_debugger(&mut rig);
        assert_eq!((rig.number(0x2001, 1), rig.number(0x2001, 2)), (TRIAL, 1));
        assert_eq!(rig.version(), "0.2.0");
    }
}

#[test]
fn after_five_failures_in_a_row_the_loader_stays_for_60_s() {
    let fails = with_first_instruction(&program("0.2.0"), UNDEFINED);
    let image = update::factory(&IMAGES[0], &file_of(&fails, "0.2.0"));
    let mut rig = Rig(ImageRig::new(RATE, []), Time::from_ms(500));
    rig.0.network.permit_misuse();
    rig.0.network.add_board(board_with(&image));
    let at = rig.0.expect("705: 00", Time::from_s(20));
    // The power, and the five.
    assert_eq!(rig.0.network.board(0).resets().len(), 6);
    // Stopped, with a valid program, and why.
    assert_eq!(rig.number(0x1F51, 1), 0);
    assert_eq!(rig.number(0x1F57, 1), (Status::Failing).value(false));
    rig.0.network.run_until(at + Time::from_ms(59_500));
    assert_eq!(rig.0.network.board(0).resets().len(), 6);
    // It tries again, and fails as before.
    rig.0.expect("705: 00", Time::from_s(20));
    assert_eq!(rig.0.network.board(0).resets().len(), 12);
}

#[test]
fn node_id_bit_rate_and_heartbeat_in_force_are_handed_over_both_ways() {
    const OTHER: u8 = 9;
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    rig.0.ask("04 01, 11 09, 13 00 02", "11 00, 13 00");
    rig.0.activate(10);
    rig.0.network.run_for(Time::from_ms(11));
    rig.0.set_master_bit_rate(BitRate::Kbit500);
    rig.0.network.run_for(Time::from_ms(15));
    rig.0.transmit_request("04 00");
    rig.0.transmit_command(&format!("82 {NODE:02X}"));
    rig.0.expect("709: 00", Time::from_ms(50));
    // 1017h = 50 ms.
    assert_eq!(rig.0.sdo_client(OTHER).download(0x1017, 0, &[50, 0]), Ok(()));
    let check = |rig: &mut Rig, state: u8, control: u8| {
        let heartbeat = format!("709: {state:02X}");
        let first = rig.0.expect(&heartbeat, Time::from_ms(100));
        let next = rig.0.expect(&heartbeat, Time::from_ms(100));
        assert_eq!((next - first + Time::from_us(500)).as_ms(), 50);
        assert_eq!(rig.0.sdo_client(OTHER).upload(0x1F51, 1), Ok(vec![control]));
    };
    check(&mut rig, 0x7F, 1);
    assert_eq!(rig.0.sdo_client(OTHER).download(0x1F51, 1, &[0]), Ok(()));
    check(&mut rig, 0x7F, 0);
    assert_eq!(rig.0.sdo_client(OTHER).download(0x1F51, 1, &[1]), Ok(()));
    rig.0.expect("709: 00", Time::from_ms(500));
    check(&mut rig, 0x7F, 1);
    rig.check_settings();
    // They were not stored.
    rig.0.set_master_bit_rate(RATE);
    rig.0.power_cycle(0);
    rig.0.expect("705: 00", Time::from_ms(100));
}

#[test]
fn what_was_in_force_is_taken_once() {
    let mut rig = on_trial();
    assert_eq!(rig.control(0x80), Ok(()));
    rig.0.ask("04 01, 11 09, 17", "11 00, 17 00");
    rig.0.transmit_request("04 00");
    rig.0.network.allow_reset(0, ResetCause::Pin);
    rig.0.network.board_mut(0).reset(ResetCause::Pin);
    rig.0.expect("709: 00", Time::from_ms(100));
}

#[test]
fn a_program_with_a_task_that_hangs_does_not_confirm_itself() {
    const CAN1_SCE: u32 = 16 + 22;
    const RETURN: [u8; 2] = [0x70, 0x47];
    let mut rig = on_trial();
    let handler = {
        let flash = rig.0.network.board(0).flash();
        let vector = RUN + HEADER_LEN as u32 + 4 * CAN1_SCE - FLASH_BASE;
        let bytes = flash[vector as usize..].first_chunk().expect("a vector");
        (u32::from_le_bytes(*bytes) & !1) - FLASH_BASE
    };
    let code =
        *rig.0.network.board(0).flash()[handler as usize..].first_chunk::<2>().expect("code");
    // An answer begins the 10 s, in whose last second the task hangs.
    assert_eq!(rig.number(0x2001, 1), TRIAL);
    rig.0.network.run_for(Time::from_ms(9_200));
    rig.0.network.board_mut(0).set_flash(handler, &RETURN);
    rig.0.network.run_for(Time::from_ms(1_400));
    rig.0.network.board_mut(0).set_flash(handler, &code);
    assert_eq!(rig.number(0x2001, 1), TRIAL);
    rig.0.network.run_for(Time::from_ms(10_500));
    assert_eq!(rig.number(0x2001, 1), KEPT, "it runs again");
}
