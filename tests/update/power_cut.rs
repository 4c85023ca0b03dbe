//! The power fails in each erase and in each word of the journal.

use emulator::{Time, chip::PowerCut};
use testkit::random::Random;

use super::{
    master::Silence,
    rig::{Rig, file},
};

/// An operation that takes longer is an erase.
const ERASE: Time = Time::from_ms(100);
/// The operations before and after an erase or a step of the master that are cut.
const AROUND: u64 = 2;

/// The erases and the words of the journal among the operations of an installation: those beside an erase or a step.
fn decisive(rig: &Rig, marks: &[u64]) -> Vec<u64> {
    let board = rig.0.network.board(0);
    let chip = board.chip();
    let times = chip.flash().operation_times();
    let is_erase = |at: &u64| times[*at as usize].end - times[*at as usize].start > ERASE;
    let all = marks[0]..*marks.last().expect("steps");
    let near: Vec<u64> = all.clone().filter(is_erase).chain(marks.iter().copied()).collect();
    all.filter(|at| near.iter().any(|near| near.abs_diff(*at) <= AROUND)).collect()
}

/// Installs a program while the power fails in this operation; then the old or the new one runs, with all settings.
fn cut(operation: u64, seed: u64) {
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    rig.0.network.board(0).chip().flash_mut().cut_power(PowerCut { operation, seed });
    let outcome = rig.install(&file("0.2.0"), &mut Vec::new());
    assert!(matches!(outcome, Err(Silence)), "operation {operation}");
    assert!(!rig.0.network.board(0).is_powered(), "operation {operation}, seed {seed}");
    rig.0.network.run_for(Time::from_ms(10));
    rig.0.network.power_on(0);
    rig.revive();
    let version = rig.version();
    assert!(["0.1.0", "0.2.0"].contains(&&*version), "{version} after operation {operation}");
    rig.check_settings();
    assert_eq!(rig.0.network.board(0).misuse(), None);
}

#[test]
fn after_a_power_cut_in_a_decisive_operation_the_old_or_the_new_program_runs() {
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    let mut marks = Vec::new();
    rig.install(&file("0.2.0"), &mut marks).expect("the power is on");
    let mut random = Random::from_environment();
    for operation in decisive(&rig, &marks) {
        cut(operation, random.u64());
    }
}
