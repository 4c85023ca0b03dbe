//! Resets by a master at each step of an update, and a supply that is too low: the old or the new program runs then.

use emulator::Time;

use super::rig::{Rig, file};

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
fn with_a_low_supply_the_loader_says_so_and_the_old_program_stays() {
    const STATUS_NOT_ALLOWED: u32 = 7 << 1;
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    assert!(rig.try_control(0).unwrap());
    rig.0.network.board_mut(0).set_supply(2_500);
    assert!(rig.try_control(3).unwrap());
    assert_eq!(rig.try_finish().unwrap(), STATUS_NOT_ALLOWED);
    rig.0.network.board_mut(0).set_supply(3_300);
    assert!(rig.try_control(1).unwrap());
    rig.revive();
    assert_eq!(rig.version(), "0.1.0");
    rig.check_settings();
}
