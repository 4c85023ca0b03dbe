//! Resets by a master at each step of an update, and a supply that is too low: the old or the new program runs then.

use emulator::{
    Time,
    board::{self, Board, Stop},
    chip::{ChipVariant, ResetCause},
};
use program_update::Status;
use testkit::update;

use super::rig::{IMAGES, PART, Rig, file};

/// Does these steps of an installation, then resets the node.
fn reset_after(steps: usize, command: &str) -> Rig {
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    let file = file("0.2.0");
    for step in 0..steps {
        match step {
            0 => assert!(rig.try_control(0).unwrap()),
            1 => assert!(rig.try_control(3).unwrap()),
            2 => rig.0.network.run_for(Time::from_ms(1500)),
            3 => assert_eq!(rig.try_finish().unwrap(), 0),
            4 => assert!(!rig.try_download(&file[..2000]).unwrap(), "it is cut short"),
            5 => {
                assert!(rig.try_control(3).unwrap());
                assert_eq!(rig.try_finish().unwrap(), 0);
                assert!(rig.try_download(&file).unwrap());
            }
            _ => assert!(rig.try_control(1).unwrap()),
        }
    }
    rig.0.transmit_command(command);
    rig.0.network.run_for(Time::from_ms(20));
    rig.revive();
    rig
}

#[test]
fn after_nmt_reset_node_at_each_step_the_old_or_the_new_program_runs() {
    for steps in 1..=7 {
        let mut rig = reset_after(steps, "81 05");
        let expected = if steps < 6 { "0.1.0" } else { "0.2.0" };
        assert_eq!(rig.version(), expected, "after step {steps}");
        rig.check_settings();
        assert_eq!(rig.0.network.board(0).misuse(), None);
    }
}

#[test]
fn an_update_at_a_low_supply_programs_half_words() {
    let mut operations = [3_300, 2_500].map(|mv| {
        let mut rig = Rig::new();
        rig.0.network.board_mut(0).set_supply(mv);
        rig.stop_and_clear();
        let operations = |rig: &Rig| rig.0.network.board(0).chip().flash().operations();
        let before = operations(&rig);
        assert!(rig.try_download(&file("0.2.0")).unwrap());
        let count = operations(&rig) - before;
        rig.start();
        assert_eq!(rig.control(0x80), Ok(()));
        assert_eq!((&*rig.version(), rig.number(0x2001, 1)), ("0.2.0", 3), "{mv} mV");
        rig.check_settings();
        count
    });
    operations[0] *= 2;
    assert_eq!(operations[0], operations[1]);
}

#[test]
fn at_a_supply_below_2_1_v_the_loader_says_so_and_the_old_program_stays() {
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    assert!(rig.try_control(0).unwrap());
    rig.0.network.board_mut(0).set_supply(2_000);
    let before = rig.0.network.board(0).chip().flash().operations();
    assert!(rig.try_control(3).unwrap());
    assert_eq!(rig.try_finish().unwrap(), Status::SupplyLow.value(false));
    assert_eq!(rig.0.network.board(0).chip().flash().operations(), before);
    rig.0.network.board_mut(0).set_supply(3_300);
    assert!(rig.try_control(1).unwrap());
    rig.revive();
    assert_eq!(rig.version(), "0.1.0");
    rig.check_settings();
}

/// A boot loader in ROM leaves its vector table, and the crystal's security system on.
#[test]
fn a_crystal_that_stops_while_the_loader_is_copied_resets_the_board() {
    let chip_variant = ChipVariant { boot_loader: true, ..ChipVariant::default() };
    let variant = board::Settings { chip_variant, ..Default::default() };
    let image = update::factory(&IMAGES[0], &file("0.1.0"));
    let mut board = Board::new(PART, &image, variant);
    let run = |board: &mut Board, until| while board.run_until(until) == Stop::CanWritten {};
    run(&mut board, Time::from_us(500));
    assert!((0x0800_0020..0x0800_0080).contains(&board.pc()), "{:#x}", board.pc());
    board.stop_crystal();
    let stopped = board.now();
    run(&mut board, stopped + Time::from_us(10));
    assert_eq!(board.resets().last(), Some(&(board.now(), ResetCause::Software)));
    assert_eq!(board.findings(), []);
}
