//! The program's side of the objects: hand-over, trial and confirmation.

use program_update::{
    Abort, Command, Mailbox, Object, Started,
    program::{Confirm, Control, Program, Wanted},
};
use testkit::random::Random;

use crate::{
    device::{Device, Runs},
    flash::Chip,
    program::file,
};

const SECOND: u32 = 1_000_000;

/// A device whose program 1 is on trial.
fn on_trial() -> Device {
    let files = vec![file(0, 20), file(1, 20)];
    let mut device = Device::new(Chip::with(&files[0], 0), files);
    let mut loader = device.stop().expect("power");
    device.update(&mut loader, 1).expect("power").expect("it is right");
    let Runs::Program(true) = device.start().expect("power") else { panic!("no trial") };
    device
}

fn program(device: &mut Device, confirm: Confirm) -> Program {
    Program::new(&mut device.chip, device.mailbox, confirm, 0)
}

#[test]
fn the_program_answers_1f51_as_the_state_allows() {
    let mut device = on_trial();
    let program = program(&mut device, Confirm::ByItself);
    for value in 0..=255 {
        for is_pre_operational in [false, true] {
            let expected = match value {
                0 if is_pre_operational => Ok(Control::Stop),
                0 | 3 => Err(Abort::DeviceState),
                1 => Ok(Control::Answer),
                2 => Ok(Control::Reset),
                0x80 => Ok(Control::Confirm),
                _ => Err(Abort::InvalidValue),
            };
            assert_eq!(program.write_control(value, is_pre_operational), expected, "{value}");
        }
    }
}

#[test]
fn the_objects_of_a_program_on_trial_and_of_one_that_is_kept() {
    use Object::{Control, FlashStatus, Software, Starts, State};
    let objects = [Control, Software, FlashStatus, State, Starts];
    let mut device = on_trial();
    let crc = u32::from_le_bytes(device.files[1][12..16].try_into().expect("4 bytes"));
    let mut program = program(&mut device, Confirm::ByMaster);
    assert!(program.is_on_trial());
    assert_eq!(objects.map(|object| program.read(object)), [1, crc, 0, 2, 1]);
    assert_eq!(program.confirm(&mut device.chip), Ok(()));
    assert_eq!(objects.map(|object| program.read(object)), [1, crc, 0, 3, 1]);
    assert!(!program.is_on_trial());
    let Runs::Program(false) = device.start().expect("power") else { panic!("another trial") };
}

#[test]
fn a_program_confirms_itself_after_an_answer_and_10_s_without_a_fault() {
    let mut device = on_trial();
    let mut program = program(&mut device, Confirm::ByItself);
    assert_eq!(program.poll(true, 15 * SECOND), None, "nobody has spoken to it");
    program.answered(15 * SECOND);
    program.answered(16 * SECOND);
    assert_eq!(program.poll(true, 25 * SECOND - 1), None);
    assert_eq!(program.poll(false, 25 * SECOND), None, "it is not well");
    assert_eq!(program.poll(true, 35 * SECOND - 1), None);
    assert_eq!(program.poll(true, 35 * SECOND), Some(Wanted::Confirm));
    assert_eq!(program.confirm(&mut device.chip), Ok(()));
    assert_eq!(program.poll(true, 36 * SECOND), None);
    assert_eq!(program.poll(true, 60 * SECOND), Some(Wanted::HasRun));
    assert_eq!(program.poll(true, 61 * SECOND), None);
}

#[test]
fn a_program_that_a_master_must_confirm_does_not_confirm_itself() {
    let mut device = on_trial();
    let mut program = program(&mut device, Confirm::ByMaster);
    program.answered(SECOND);
    assert_eq!(program.poll(true, 60 * SECOND - 1), None);
    assert_eq!(program.poll(true, 60 * SECOND), Some(Wanted::Reset), "not confirmed for 60 s");
}

#[test]
fn a_confirmation_that_the_flash_refuses_is_not_answered_as_done() {
    let mut device = on_trial();
    device.chip.0.borrow_mut().stuck = vec![(program_update::Area::Backup, 0x1DC)];
    let mut program = program(&mut device, Confirm::ByItself);
    assert_eq!(program.confirm(&mut device.chip), Err(Abort::Hardware));
    assert!(program.is_on_trial());
}

#[test]
fn a_program_without_an_update_confirms_without_writing() {
    let mut device = Device::new(Chip::with(&file(0, 20), 0), vec![file(0, 20)]);
    device.start().expect("power");
    let mut program = program(&mut device, Confirm::ByItself);
    assert_eq!(program.confirm(&mut device.chip), Ok(()));
    assert_eq!(device.chip.operations(), 0);
    assert_eq!(program.read(Object::State), 0);
}

#[test]
fn a_mailbox_comes_back_as_it_was_and_with_any_wrong_bit_not_at_all() {
    let mailbox = Mailbox {
        command: Command::Stop,
        started: Started::Trial,
        failures: 3,
        node_id: 127,
        heartbeat_ms: 0x1234,
        kbit: 1000,
    };
    let words = mailbox.to_words();
    assert_eq!(Mailbox::from_words(&words), Some(mailbox));
    for bit in 0..256 {
        let mut words = words;
        words[bit / 32] ^= 1 << (bit % 32);
        assert_eq!(Mailbox::from_words(&words), None, "bit {bit}");
    }
    let mut random = Random::from_environment();
    for _ in 0..10_000 {
        assert_eq!(Mailbox::from_words(&std::array::from_fn(|_| random.u32())), None);
    }
    assert_eq!(Mailbox::from_words(&[0; 8]), None);
    assert_eq!(Mailbox::from_words(&[u32::MAX; 8]), None);
}
