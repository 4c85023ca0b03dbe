//! The loader's objects 1F50h, 1F51h, 1F56h, 1F57h and 2001h, as a client sees them.

use program_update::{
    Abort, Action, Area, Object, Status, Unsigned, Updater,
    start::{Cause, Start, Why, decide},
};

use crate::{
    device::{Device, Loader, Runs},
    flash::{Chip, Operation},
    program::{expected, file},
};

pub const SECOND: u32 = 1_000_000;
const STATE: Result<(), Abort> = Err(Abort::DeviceState);

fn device() -> Device {
    let files: Vec<_> = (0..3).map(|number| file(number, 20)).collect();
    Device::new(Chip::with(&files[0], 0), files)
}

pub fn stopped() -> (Device, Loader) {
    let mut device = device();
    let loader = *device.stop().expect("power");
    (device, loader)
}

pub fn values(loader: &Loader) -> [u32; 5] {
    use Object::{Control, FlashStatus, Software, Starts, State};
    [Control, Software, FlashStatus, State, Starts].map(|object| loader.read(object))
}

fn crc(file: &[u8]) -> u32 {
    u32::from_le_bytes(file[12..16].try_into().expect("4 bytes"))
}

pub fn run(device: &mut Device, loader: &mut Loader) -> Option<Action> {
    device.work(loader).expect("power")
}

#[test]
fn each_object_has_its_value_at_each_step_of_an_update() {
    let (mut device, mut loader) = stopped();
    let [old, new] = [crc(&device.files[0]), crc(&device.files[1])];
    assert_eq!(values(&loader), [0, old, 0, 0, 0]);
    assert_eq!(loader.write_control(3), Ok(()));
    assert_eq!(values(&loader), [0, old, 1, 1, 0], "clear: busy");
    loader.poll(0);
    assert_eq!(loader.write_control(3), Ok(()), "again, meanwhile");
    run(&mut device, &mut loader);
    assert_eq!(values(&loader), [3, 0, 0, 1, 0], "cleared");
    let file = device.files[1].clone();
    assert_eq!(device.download(&mut loader, &file, 7).expect("power"), Ok(()));
    assert_eq!(values(&loader), [0, new, 0, 2, 0], "loaded");
    assert_eq!(loader.header().map(|header| header.crc), Some(new));
    let Runs::Program(true) = device.start().expect("power") else { panic!("no trial") };
    assert_eq!(values(&device.stop().expect("power")), [0, new, 0, 2, 1], "on trial");
    let Runs::Program(true) = device.start().expect("power") else { panic!("no trial") };
    device.confirm().expect("power").expect("it is confirmed");
    assert_eq!(values(&device.stop().expect("power")), [0, new, 0, 3, 2], "kept");
    assert!(device.chip.holds(Area::Backup, &device.files[0]));
}

#[test]
fn three_starts_that_are_not_confirmed_restore_the_old_program() {
    let (mut device, mut loader) = stopped();
    device.update(&mut loader, 1).expect("power").expect("it is right");
    for _ in 0..3 {
        let Runs::Program(true) = device.start().expect("power") else { panic!("no trial") };
        assert_eq!(device.number(), 1);
    }
    let Runs::Loader(mut loader) = device.start().expect("power") else { panic!("a 4th trial") };
    assert_eq!(values(&loader), [0, crc(&device.files[1]), 1, 2, 3]);
    assert_eq!(run(&mut device, &mut loader), Some(Action::Reset));
    assert_eq!(values(&loader), [0, crc(&device.files[0]), 0, 4, 3]);
    let Runs::Program(false) = device.start().expect("power") else { panic!("not restored") };
    assert_eq!(device.number(), 0);
    let mut loader = device.stop().expect("power");
    assert_eq!(device.update(&mut loader, 2).expect("power"), Ok(()), "another update");
}

#[test]
fn a_write_of_1f51_is_answered_as_the_state_allows() {
    let (mut device, mut loader) = stopped();
    for value in 0..=255 {
        let expected = match value {
            0..=2 => Ok(()),
            3 => continue,
            0x80 => STATE,
            _ => Err(Abort::InvalidValue),
        };
        assert_eq!(loader.write_control(value), expected, "{value}");
    }
    loader.write_control(3).expect("it clears");
    assert_eq!(loader.write_control(1), STATE, "start while it clears");
    run(&mut device, &mut loader);
    assert_eq!(loader.write_control(1), STATE, "start without a program");
    assert_eq!(loader.write_control(0), Ok(()));
    assert_eq!(loader.write_control(2), Ok(()));
}

#[test]
fn start_and_reset_follow_100_ms_after_the_answer_was_acknowledged() {
    for value in [1, 2] {
        let (_, mut loader) = stopped();
        loader.answered(0);
        assert_eq!(loader.write_control(value), Ok(()));
        assert_eq!(loader.poll(SECOND), None, "the answer is not acknowledged");
        loader.answered(SECOND);
        loader.answered(SECOND + 50_000);
        assert_eq!(loader.poll(SECOND + 99_999), None);
        assert_eq!(loader.poll(SECOND + 100_000), Some(Action::Reset));
    }
}

#[test]
fn a_stop_or_a_download_within_the_100_ms_cancels_start_and_reset() {
    for value in [1, 2] {
        let cancels: [fn(&mut Loader); 2] = [
            |loader| assert_eq!(loader.write_control(0), Ok(())),
            |loader| assert_eq!(loader.write(0, &file(1, 20)[..7]), Ok(())),
        ];
        for cancel in cancels {
            let (_, mut loader) = stopped();
            assert_eq!(loader.write_control(value), Ok(()));
            loader.answered(SECOND);
            cancel(&mut loader);
            loader.answered(SECOND + 50_000);
            assert_eq!(loader.poll(2 * SECOND), None);
        }
    }
}

#[test]
fn a_reset_waits_for_the_end_of_an_operation_of_the_flash() {
    let (device, mut loader) = stopped();
    device.chip.0.borrow_mut().slow = 10;
    assert_eq!(loader.write_control(3), Ok(()));
    loader.poll(0);
    assert_eq!(loader.write_control(2), Ok(()));
    loader.answered(0);
    for _ in 0..10 {
        assert_eq!(loader.poll(SECOND), None);
    }
    assert_eq!(loader.poll(SECOND), Some(Action::Reset));
}

#[test]
fn without_a_request_for_60_s_the_loader_starts_the_program() {
    let (_, mut loader) = stopped();
    loader.requested(7 * SECOND);
    assert_eq!(loader.poll(67 * SECOND - 1), None);
    assert_eq!(loader.poll(67 * SECOND), Some(Action::Reset));
}

#[test]
fn a_loader_without_any_program_stays_and_takes_the_first_one_without_a_trial() {
    let files = vec![file(0, 20), file(1, 20)];
    let mut device = Device::new(Chip::blank(0), files);
    let Runs::Loader(mut loader) = device.start().expect("power") else { panic!("no program") };
    assert!(loader.is_without_program());
    assert_eq!(values(&loader), [3, 0, 1 << 1, 0, 0]);
    assert_eq!(loader.poll(100 * SECOND), None);
    let file = device.files[1].clone();
    assert_eq!(device.download(&mut loader, &file, 7).expect("power"), Err(Abort::DeviceState));
    assert_eq!(loader.read(Object::FlashStatus), Status::NotCleared.value(false));
    device.update(&mut loader, 1).expect("power").expect("it is right");
    assert!(!loader.is_without_program());
    let Runs::Program(false) = device.start().expect("power") else { panic!("a trial") };
    assert_eq!(device.number(), 1);
    let mut loader = device.stop().expect("power");
    assert_eq!(device.update(&mut loader, 0).expect("power"), Ok(()));
    let Runs::Program(true) = device.start().expect("power") else { panic!("no trial") };
}

#[test]
fn a_download_needs_a_clear_and_after_its_first_word_another_one() {
    let (mut device, mut loader) = stopped();
    let file = device.files[1].clone();
    assert_eq!(loader.write(0, &file[..511]), Ok(()), "the header is checked first");
    assert_eq!(loader.write(511, &file[511..518]), STATE);
    assert_eq!(loader.read(Object::FlashStatus), 8, "status 4: not cleared");
    assert_eq!(loader.write(518, &file[518..525]), STATE);
    let mut other = file.clone();
    other[20] ^= 1;
    assert_eq!(loader.write(0, &other[..512]), Err(Abort::NotStored));
    assert_eq!(loader.read(Object::FlashStatus), 252 << 16 | 2 << 1);
    assert_eq!(device.chip.operations(), 0);
    loader.write_control(3).expect("it clears");
    run(&mut device, &mut loader);
    for len in [7, 512, 515] {
        assert_eq!(loader.write(0, &file[..len]), Ok(()));
        loader.abort();
        assert_eq!(loader.read(Object::FlashStatus), 0, "nothing was written");
        assert_eq!(loader.write(7, &file[7..14]), STATE, "a rest without its beginning");
    }
    assert_eq!(loader.write(0, &file[..516]), Ok(()));
    loader.poll(0);
    loader.abort();
    run(&mut device, &mut loader);
    assert_eq!(loader.read(Object::FlashStatus), 8);
    assert_eq!(loader.write(0, &file), STATE);
    assert_eq!(device.update(&mut loader, 1).expect("power"), Ok(()));
}

#[test]
fn a_client_may_download_right_after_clear_and_send_short_segments() {
    // The lengths of Zephyr's segments, of Lely's, and of a block.
    let zephyr = |offset: usize| if offset % 1024 == 1022 { 2 } else { 7 };
    for (slow, len) in [(0, None), (300, Some(7)), (40, Some(889)), (300, None)] {
        let device = device();
        device.chip.0.borrow_mut().slow = slow;
        let file = file(1, 64);
        // The ring has room for a quarter of the program.
        let (chip, expected) = (device.chip.clone(), expected(768));
        let mut loader = Updater::<_, _, 16>::new(chip, Unsigned, expected, Why::Stop, 0);
        assert_eq!(loader.write_control(3), Ok(()));
        let mut offset = 0;
        while offset < file.len() {
            let wanted = len.unwrap_or(zephyr(offset)).min(file.len() - offset);
            let room = wanted.min(loader.room());
            assert_eq!(loader.write(offset as u32, &file[offset..offset + room]), Ok(()));
            offset += room;
            assert_eq!(loader.poll(0), None);
        }
        assert_eq!(loader.end(file.len() as u32), Ok(()));
        let answer = (0..1_000_000).find_map(|_| loader.poll(0));
        assert_eq!(answer, Some(Action::Answer(Ok(()))));
        assert!(device.chip.holds(Area::Run, &file));
    }
}

#[test]
fn more_than_there_is_room_for_is_refused() {
    let (mut device, mut loader) = stopped();
    let file = file(1, 64);
    loader.write_control(3).expect("it clears");
    run(&mut device, &mut loader);
    assert_eq!(loader.room(), 512 + 256);
    assert_eq!(loader.write(0, &file[..513]), Ok(()));
    assert_eq!(loader.room(), 255);
    assert_eq!(loader.write(513, &file[513..]), Ok(()));
    assert_eq!(loader.room(), 0);
    let (_, mut loader) = stopped();
    loader.write_control(3).expect("it clears");
    assert_eq!(loader.write(0, &[0; 769]), Err(Abort::Memory));
}

#[test]
fn an_abort_while_the_end_is_due_leaves_the_old_or_the_new_program() {
    for polls in 0..200 {
        let (mut device, mut loader) = stopped();
        let file = device.files[1].clone();
        loader.write_control(3).expect("it clears");
        run(&mut device, &mut loader);
        loader.write(0, &file).expect("room");
        loader.end(file.len() as u32).expect("it is right");
        for _ in 0..polls {
            if loader.poll(0).is_some() {
                return;
            }
        }
        loader.abort();
        assert_eq!(run(&mut device, &mut loader), None, "nobody waits for an answer");
        let is_loaded = loader.read(Object::Control) == 0;
        let status = loader.read(Object::FlashStatus);
        assert_eq!(status, if is_loaded || polls == 0 { 0 } else { 8 }, "after {polls} polls");
        match device.start().expect("power") {
            Runs::Program(true) => assert!(is_loaded && device.number() == 1),
            _ => assert!(!is_loaded),
        }
        assert_eq!(device.alone().expect("power"), 0);
    }
    panic!("the download is never answered");
}

#[test]
fn five_starts_that_fail_in_a_row_keep_the_loader_for_60_s() {
    let mut device = device();
    for _ in 0..2 {
        for failures in 0..5 {
            let cause = if failures == 0 { Cause::Other } else { Cause::Failure };
            let Runs::Program(false) = device.start_after(cause).expect("power") else {
                panic!("the loader after {failures} failures")
            };
        }
        let Runs::Loader(mut loader) = device.start_after(Cause::Failure).expect("power") else {
            panic!("the program after 5 failures")
        };
        assert_eq!(values(&loader)[..3], [0, crc(&device.files[0]), 9 << 1]);
        assert_eq!(loader.poll(device.now.wrapping_add(60 * SECOND - 1)), None);
        device.now = device.now.wrapping_add(60 * SECOND);
        assert_eq!(loader.poll(device.now), Some(Action::Reset));
    }
}

#[test]
fn a_watchdog_that_ends_the_loader_is_no_failure_of_the_program() {
    let (mut chip, mut mailbox) = (Chip::blank(0), None);
    for _ in 0..10 {
        let (start, next) = decide(&mut chip, mailbox, Cause::Failure);
        assert_eq!((start, next.failures), (Start::Loader(Why::NoProgram), 0));
        mailbox = Some(next);
    }
}

#[test]
fn only_sectors_that_hold_something_are_erased() {
    let files: Vec<_> = (0..3).map(|number| file(number, 12)).collect();
    let mut device = Device::new(Chip::with(&files[0], 0), files);
    let erases = |device: &Device, area| {
        let state = device.chip.0.borrow();
        state.operations.iter().filter(|operation| **operation == Operation::Erase(area)).count()
    };
    let mut loader = device.stop().expect("power");
    loader.write_control(3).expect("it clears");
    run(&mut device, &mut loader);
    assert_eq!([Area::Run, Area::Backup].map(|area| erases(&device, area)), [1, 1]);
    // A broken download has come to the second sector, so that nothing is known of it.
    let long = file(1, 60);
    loader.write(0, &long[..740]).expect("room");
    run(&mut device, &mut loader);
    loader.abort();
    loader.write_control(3).expect("it clears");
    run(&mut device, &mut loader);
    assert_eq!([Area::Run, Area::Backup].map(|area| erases(&device, area)), [3, 1]);
    assert_eq!(device.download(&mut loader, &long, 100).expect("power"), Ok(()));
}
