//! A flash that fails, forgets or is write-protected: the status that a client sees, and what runs afterwards.

use program_update::{
    Abort, Action, Area, Flash, FlashError, Object, journal,
    start::{Cause, Start, Why, decide},
};

use crate::{
    device::{Device, Loader, Runs},
    flash::{Chip, Operation},
    objects::{SECOND, run, stopped, values},
    program::file,
};

/// Their offsets in BACKUP.
const SAVED: [u32; 2] = [0x1C0, 0x1C4];

#[test]
fn a_program_with_a_wrong_bit_is_not_started_but_the_one_before() {
    for at in [0, 200, 515, 591] {
        let mut damaged = file(1, 20);
        damaged[at] ^= 4;
        let mut device = Device::new(Chip::with(&damaged, 0), Vec::new());
        let Runs::Loader(mut loader) = device.start().expect("power") else { panic!("started") };
        assert_eq!(values(&loader)[..3], [3, 0, 1 << 1]);
        assert_eq!(loader.poll(100 * SECOND), None);

        let (mut device, mut loader) = stopped();
        device.update(&mut loader, 1).expect("power").expect("it is right");
        device.start().expect("power");
        device.confirm().expect("power").expect("it is confirmed");
        device.chip.put(Area::Run, &damaged);
        assert_eq!(device.alone().expect("power"), 0);
        device.chip.put(Area::Run, &damaged);
        device.chip.put(Area::Backup, &damaged);
        let Runs::Loader(loader) = device.start().expect("power") else { panic!("started") };
        assert!(loader.is_without_program());
    }
}

/// Each operation of an update fails once in each way: the client sees it, and the next update succeeds.
#[test]
fn each_operation_that_fails_has_a_status_and_leaves_a_program() {
    let operations = {
        let (mut device, mut loader) = stopped();
        device.update(&mut loader, 1).expect("power").expect("it is right");
        device.chip.0.borrow().operations.clone()
    };
    assert!(operations.len() > 250);
    for fails in operations {
        let hows = [FlashError::Failed, FlashError::Protected, FlashError::SupplyLow].map(Some);
        for how in hows.into_iter().chain([None]) {
            let (mut device, mut loader) = stopped();
            {
                let mut state = device.chip.0.borrow_mut();
                match (how, fails) {
                    (Some(how), _) => state.faults = vec![(fails, how)],
                    (None, Operation::Program(area, offset)) => state.stuck = vec![(area, offset)],
                    (None, Operation::Erase(_)) => continue,
                }
            }
            let outcome = device.update(&mut loader, 1).expect("power");
            let (old, status) = (device.files[0].clone(), loader.read(Object::FlashStatus));
            // A word that is blank anyway may be stuck.
            if how.is_some() || outcome.is_err() {
                assert!(outcome.is_err(), "{fails:?} {how:?}");
                let expected = match how {
                    Some(FlashError::Failed) | None => 5,
                    Some(FlashError::Protected) => 7,
                    Some(FlashError::SupplyLow) => 8,
                };
                assert_eq!(status, expected << 1, "{fails:?} {how:?}");
                let is_there = |area| device.chip.holds(area, &old);
                assert!(is_there(Area::Run) || is_there(Area::Backup), "{fails:?} {how:?}");
            }
            {
                let mut state = device.chip.0.borrow_mut();
                (state.faults, state.stuck) = (Vec::new(), Vec::new());
            }
            if outcome.is_err() {
                assert_eq!(device.alone().expect("power"), 0, "{fails:?} {how:?}");
                let mut loader = device.stop().expect("power");
                assert_eq!(device.update(&mut loader, 1).expect("power"), Ok(()));
            }
        }
    }
}

#[test]
fn a_copy_in_which_a_word_has_changed_does_not_count() {
    let last = |area| Operation::Program(area, journal::OFFSET - 4);
    let (mut device, mut loader) = stopped();
    device.chip.0.borrow_mut().spoils = Some((last(Area::Backup), (Area::Backup, 560)));
    assert_eq!(device.update(&mut loader, 1).expect("power"), Err(Abort::Hardware));
    assert_eq!(loader.read(Object::FlashStatus), 5 << 1);
    assert_eq!(device.alone().expect("power"), 0);

    device.chip.0.borrow_mut().spoils = Some((last(Area::Run), (Area::Run, 560)));
    let mut loader = device.stop().expect("power");
    loader.write_control(3).expect("it clears");
    run(&mut device, &mut loader);
    let Runs::Loader(mut loader) = device.start().expect("power") else { panic!("no restore") };
    assert_eq!(run(&mut device, &mut loader), None);
    assert_eq!(loader.read(Object::FlashStatus), 5 << 1);
    device.chip.0.borrow_mut().spoils = None;
    assert_eq!(device.alone().expect("power"), 0);
}

#[test]
fn a_restore_whose_mark_cannot_be_set_again_starts_the_program_at_once() {
    let files = vec![file(0, 20)];
    // A clear was cut in the second SAVED, which still reads set.
    let mut backup = files[0].clone();
    backup[0x1C0..0x1C4].fill(0);
    backup[0x1C4..0x1C8].copy_from_slice(&journal::SET.to_le_bytes());
    let chip = Chip::with(&files[0], 0);
    chip.put(Area::Backup, &backup);
    let mut device = Device::new(chip, files);
    let Runs::Loader(mut loader) = device.start().expect("power") else { panic!("no restore") };
    let again = Operation::Program(Area::Backup, 0x1C4);
    device.chip.0.borrow_mut().spoils = Some((again, (Area::Backup, 0x1C4)));
    assert_eq!(run(&mut device, &mut loader), Some(Action::Reset));
    let Runs::Program(false) = device.start().expect("power") else { panic!("not started") };
}

#[test]
fn a_clear_that_the_flash_ends_is_none() {
    let (mut device, mut loader) = stopped();
    let erase = (Operation::Erase(Area::Run), FlashError::Failed);
    device.chip.0.borrow_mut().faults = vec![erase];
    loader.write_control(3).expect("it clears");
    run(&mut device, &mut loader);
    let file = device.files[1].clone();
    assert_eq!(loader.write(0, &file[..512]), Err(Abort::DeviceState));
    device.chip.0.borrow_mut().faults.clear();
    assert_eq!(device.update(&mut loader, 1).expect("power"), Ok(()));
}

/// RUN is cleared, and BACKUP holds the only program.
fn with_one_copy() -> (Device, Box<Loader>) {
    let (mut device, mut loader) = stopped();
    loader.write_control(3).expect("it clears");
    run(&mut device, &mut loader);
    let first = device.files[1][..520].to_vec();
    loader.write(0, &first).expect("room");
    run(&mut device, &mut loader);
    loader.abort();
    (device, loader.into())
}

#[test]
fn two_marks_that_fail_but_read_as_set_do_not_cost_the_only_program() {
    let (mut device, mut loader) = with_one_copy();
    let again = |offset| (Operation::Program(Area::Backup, offset), FlashError::Failed);
    device.chip.0.borrow_mut().faults = SAVED.map(again).to_vec();
    loader.write_control(3).expect("it clears");
    run(&mut device, &mut loader);
    device.chip.0.borrow_mut().faults.clear();
    loader.write_control(3).expect("it clears");
    run(&mut device, &mut loader);
    assert_eq!(device.alone().expect("power"), 0);
}

#[test]
fn a_mark_that_does_not_read_as_set_is_not_taken_back_while_backup_is_all_there_is() {
    let (mut device, _) = with_one_copy();
    let mut backup = device.files[0].clone();
    let weak = journal::SET | 1 << 8;
    for offset in SAVED {
        backup[offset as usize..][..4].copy_from_slice(&weak.to_le_bytes());
    }
    device.chip.put(Area::Backup, &backup);
    let Runs::Loader(mut loader) = device.start().expect("power") else { panic!("started") };
    loader.write_control(3).expect("it clears");
    run(&mut device, &mut loader);
    assert_eq!(loader.read(Object::FlashStatus), 0);
    assert_eq!(SAVED.map(|offset| device.chip.read(Area::Backup, offset)), [weak; 2]);
    assert_eq!(device.update(&mut loader, 1).expect("power"), Ok(()), "it can be updated");
}

#[test]
fn a_restore_that_the_flash_refuses_leaves_the_loader_on_the_bus() {
    let (mut device, mut loader) = stopped();
    device.update(&mut loader, 1).expect("power").expect("it is right");
    let erase = Operation::Erase(Area::Run);
    device.chip.0.borrow_mut().faults = vec![(erase, FlashError::Protected)];
    for _ in 0..3 {
        device.start().expect("power");
    }
    for _ in 0..3 {
        let Runs::Loader(mut loader) = device.start().expect("power") else { panic!("started") };
        assert_eq!(run(&mut device, &mut loader), None);
        assert_eq!(loader.read(Object::FlashStatus), 7 << 1);
        device.now = device.now.wrapping_add(60 * SECOND);
        assert_eq!(loader.poll(device.now), Some(Action::Reset), "it tries again");
    }
    device.chip.0.borrow_mut().faults.clear();
    assert_eq!(device.alone().expect("power"), 0);
}

#[test]
fn a_trial_that_the_flash_does_not_note_is_not_started() {
    let (mut device, mut loader) = stopped();
    device.update(&mut loader, 1).expect("power").expect("it is right");
    let tries = [0x1CC, 0x1D0, 0x1D4].map(|offset| (Area::Backup, offset));
    device.chip.0.borrow_mut().stuck = tries.to_vec();
    let (start, _) = decide(&mut device.chip, device.mailbox, Cause::Other);
    assert_eq!(start, Start::Loader(Why::Restore));
    device.chip.0.borrow_mut().stuck.remove(2);
    let (start, _) = decide(&mut device.chip, device.mailbox, Cause::Other);
    assert_eq!(start, Start::Program, "a word takes it");
    assert_eq!(device.alone().expect("power"), 0);
}

/// Both words of KEPT, by their offsets in BACKUP.
fn kept(device: &mut Device) -> [u32; 2] {
    [0x1D8, 0x1DC].map(|offset| device.chip.read(Area::Backup, offset))
}

#[test]
fn one_word_of_a_confirmation_is_enough_and_a_start_completes_it() {
    let (mut device, mut loader) = stopped();
    device.update(&mut loader, 1).expect("power").expect("it is right");
    device.start().expect("power");
    device.chip.0.borrow_mut().stuck = vec![(Area::Backup, 0x1DC)];
    let _ = device.confirm().expect("power");
    assert_eq!(kept(&mut device), [journal::SET, u32::MAX]);
    device.chip.0.borrow_mut().stuck.clear();
    device.power_on();
    assert!(matches!(device.start().expect("power"), Runs::Program(false)));
    assert_eq!(kept(&mut device), [journal::SET; 2]);
}

#[test]
fn a_restore_takes_back_both_words_of_the_confirmation() {
    let (mut device, mut loader) = stopped();
    device.update(&mut loader, 1).expect("power").expect("it is right");
    device.start().expect("power");
    device.confirm().expect("power").expect("it is confirmed");
    assert_eq!(kept(&mut device), [journal::SET; 2]);
    let mut damaged = file(1, 20);
    damaged[515] ^= 4;
    device.chip.put(Area::Run, &damaged);
    assert_eq!(device.alone().expect("power"), 0);
    assert_eq!(kept(&mut device), [journal::VOID; 2]);
}

#[test]
fn a_loader_that_finds_nothing_to_restore_starts_the_program() {
    let (device, _) = stopped();
    let mut loader = device.loader(Why::Restore);
    assert_eq!(loader.poll(device.now), Some(Action::Reset));
}
