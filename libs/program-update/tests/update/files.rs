//! Which files a loader takes, and what it says of the others.

use program_update::{
    Abort, Area, Header, Object, Release, Status, Unsigned,
    header::{Field, check_file, text},
    start::Why,
};
use testkit::random::Random;

use crate::{
    device::{Device, Loader},
    flash::Chip,
    program::{RUN, expected, file, header_of},
};

const REFUSED: Result<(), Abort> = Err(Abort::NotStored);
const DAMAGED: Result<(), Abort> = Err(Abort::Hardware);

/// A device with program 0, whose loader has cleared RUN.
fn cleared() -> (Device, Loader) {
    let files = vec![file(0, 20)];
    let mut device = Device::new(Chip::with(&files[0], 0), files);
    let mut loader = *device.stop().expect("power");
    clear(&mut device, &mut loader);
    (device, loader)
}

fn clear(device: &mut Device, loader: &mut Loader) {
    assert_eq!(loader.write_control(3), Ok(()));
    assert_eq!(device.work(loader).expect("power"), None);
    assert_eq!(status(loader), 0);
}

fn status(loader: &Loader) -> u32 {
    loader.read(Object::FlashStatus)
}

/// A file with a changed header.
fn with(change: impl FnOnce(&mut Header)) -> Vec<u8> {
    let mut file = file(1, 20);
    let (bytes, _) = file.split_first_chunk_mut().expect("a header");
    let mut header = Header::parse(bytes).expect("it is valid");
    change(&mut header);
    *bytes = header.to_bytes();
    file
}

/// A file with a changed program, whose header is right.
fn of(program: &[u8]) -> Vec<u8> {
    let release = Release::new(1, 1, 0).expect("small numbers");
    let mut file = header_of(program, release).to_bytes().to_vec();
    file.extend(program);
    file
}

/// A file with a changed byte.
fn with_byte(at: usize) -> Vec<u8> {
    let mut file = file(1, 20);
    file[at] ^= 1;
    file
}

#[test]
fn a_wrong_field_is_refused_with_its_offset_before_a_word_is_written() {
    let cases = [
        (with_byte(3), Field::Magic),
        (with(|header| header.vendor_id += 1), Field::Vendor),
        (with(|header| header.product_code += 1), Field::Product),
        (with(|header| header.hardware += 1), Field::Hardware),
        (with(|header| header.chip = text("stm32f407")), Field::Chip),
        (with(|header| header.controller = 2), Field::Controller),
        (with(|header| header.address = RUN + 0x10000), Field::Address),
        (with(|header| header.length = 0), Field::Length),
        (with(|header| header.length = 4), Field::Length),
        (with(|header| header.length += 1), Field::Length),
        (with_byte(16), Field::HeaderCrc),
        (with_byte(130), Field::HeaderCrc),
        (with_byte(253), Field::HeaderCrc),
        (with_byte(320), Field::Rest),
        (with_byte(511), Field::Rest),
    ];
    let (mut device, mut loader) = cleared();
    let before = device.chip.operations();
    for (file, field) in cases {
        let outcome = device.download(&mut loader, &file, 100).expect("power");
        assert_eq!(outcome, REFUSED, "{field:?}");
        assert_eq!(status(&loader), (field as u32) << 16 | 2 << 1);
        assert_eq!(check_file(&file, &expected(768), None), Err(Status::Refused(field)));
        assert_eq!(device.chip.operations(), before, "{field:?}: a word is written");
    }
    let right = file(1, 20);
    let outcome = device.download(&mut loader, &right, 100).expect("power");
    assert_eq!(outcome, Ok(()), "a right file needs no other clear");
}

#[test]
fn a_program_that_is_longer_than_its_place_is_refused_with_status_6() {
    let (mut device, mut loader) = cleared();
    let most = 768 - 512;
    let file = with(|header| header.length = most + 4);
    assert_eq!(device.download(&mut loader, &file, 100).expect("power"), REFUSED);
    assert_eq!(status(&loader), 8 << 16 | 6 << 1);
    let file = crate::program::file(1, most as usize / 4);
    assert_eq!(device.download(&mut loader, &file, 100).expect("power"), Ok(()));
    assert!(device.chip.holds(Area::Run, &file));
}

#[test]
fn a_file_that_is_too_short_or_too_long_is_not_taken() {
    let whole = file(1, 20);
    let (mut device, mut loader) = cleared();
    for len in (0..whole.len()).step_by(17).chain([511, 512, 513, 588, 591]) {
        let outcome = device.download(&mut loader, &whole[..len], 100).expect("power");
        let expected = if len == 0 { Err(Abort::DeviceState) } else { DAMAGED };
        assert_eq!(outcome, expected, "{len} bytes");
        if len > 0 {
            device.work(&mut loader).expect("power");
            assert_eq!(status(&loader), 8 << 16 | 3 << 1, "{len} bytes");
        }
        clear(&mut device, &mut loader);
    }
    for more in [1, 4, 100] {
        let mut file = whole.clone();
        file.resize(whole.len() + more, 0xFF);
        assert_eq!(device.download(&mut loader, &file, 100).expect("power"), DAMAGED);
        assert_eq!(status(&loader), 8 << 16 | 3 << 1);
        clear(&mut device, &mut loader);
    }
    assert_eq!(loader.read(Object::Control), 3);
    // The client announces another length than it sends.
    assert_eq!(loader.write(0, &whole), Ok(()));
    assert_eq!(loader.end(whole.len() as u32 - 4), DAMAGED);
    assert_eq!(loader.write(0, &whole[..588]), Ok(()));
    assert_eq!(loader.end(whole.len() as u32), DAMAGED);
}

#[test]
fn a_program_with_a_wrong_crc_or_vectors_is_not_taken() {
    let program = file(1, 20)[512..].to_vec();
    let vector = |at: usize, value: u32| {
        let mut program = program.clone();
        program[at..at + 4].copy_from_slice(&value.to_le_bytes());
        of(&program)
    };
    let cases = [
        (with_byte(512 + 30), Field::Crc),
        (with(|header| header.crc ^= 1), Field::Crc),
        (vector(0, 0x2000_0000), Field::Address),
        (vector(0, 0x2002_0008), Field::Address),
        (vector(0, 0x2001_0004), Field::Address),
        (vector(0, u32::MAX), Field::Address),
        (vector(4, RUN + 0x208), Field::Address),
        (vector(4, RUN + 0x205), Field::Address),
        (vector(4, RUN + 0x200 + 81), Field::Address),
        (vector(4, 0x0800_0201), Field::Address),
        (vector(4, u32::MAX), Field::Address),
    ];
    let (mut device, mut loader) = cleared();
    for (file, field) in cases {
        assert_eq!(device.download(&mut loader, &file, 100).expect("power"), DAMAGED, "{field:?}");
        assert_eq!(status(&loader), (field as u32) << 16 | 3 << 1);
        assert_eq!(check_file(&file, &expected(768), None), Err(Status::Damaged(field)));
        assert_eq!(loader.read(Object::Control), 3);
        assert_eq!(loader.read(Object::Software), 0);
        assert_eq!(loader.write_control(1), Err(Abort::DeviceState));
        clear(&mut device, &mut loader);
    }
}

#[test]
fn of_100_000_mutated_files_none_is_taken() {
    const SIGNATURE: std::ops::Range<usize> = 256..320;
    let mut random = Random::from_environment();
    let whole = file(1, 20);
    let expected = expected(768);
    let (mut device, mut loader) = cleared();
    for number in 0..100_000 {
        let mut file = whole.clone();
        match random.within(0..8) {
            0 => file.truncate(random.within(1..whole.len() as u64) as usize),
            1 => file.extend(random.bytes::<4>()),
            2 => {
                let from = random.within(0..whole.len() as u64) as usize;
                file[from..].fill(random.pick(&[0, 0xFF]));
            }
            3 => {
                let at = random.within(512..whole.len() as u64 - 1) as usize;
                file.swap(at, at + 1);
            }
            _ => {
                for _ in 0..=random.within(0..4) {
                    let at = random.within(0..whole.len() as u64) as usize;
                    // Without a check of signatures, all of them are right.
                    if !SIGNATURE.contains(&at) {
                        file[at] ^= 1 << random.within(0..8);
                    }
                }
            }
        }
        let mut unsigned = file.clone();
        if let Some(signature) = unsigned.get_mut(SIGNATURE) {
            signature.copy_from_slice(&whole[SIGNATURE]);
        }
        if unsigned == whole {
            continue;
        }
        assert!(check_file(&file, &expected, None).is_err(), "{number}");
        let outcome = device.download(&mut loader, &file, 100).expect("power");
        assert!(outcome.is_err(), "{number}");
        assert_eq!(loader.read(Object::Control), 3);
        assert_ne!(status(&loader), 0);
        loader.abort();
        clear(&mut device, &mut loader);
    }
    assert_eq!(device.alone().expect("power"), 0, "the old program runs again");
}

#[test]
fn a_file_for_one_chip_is_refused_on_each_other_one() {
    const CHIPS: [&str; 14] = [
        "stm32f405",
        "stm32f407",
        "stm32f412",
        "stm32f413",
        "stm32f415",
        "stm32f417",
        "stm32f423",
        "stm32f427",
        "stm32f429",
        "stm32f437",
        "stm32f439",
        "stm32f446",
        "stm32f469",
        "stm32f479",
    ];
    for chip in CHIPS {
        let header = with(|header| header.chip = text(chip));
        for device in CHIPS {
            let expected = program_update::Expected { chip: text(device), ..expected(768) };
            let outcome = check_file(&header, &expected, None).map(|_| ());
            let is_right = chip == device;
            assert_eq!(outcome, if is_right { Ok(()) } else { Err(Status::Refused(Field::Chip)) });
        }
    }
}

#[test]
fn a_lower_release_is_refused_only_where_no_downgrade_is_allowed() {
    for (allows_downgrade, is_pending) in [(true, false), (false, false), (false, true)] {
        let files: Vec<_> = (0..3).map(|number| file(number, 20)).collect();
        let chip = Chip::with(&files[1], 0);
        let expected = program_update::Expected { allows_downgrade, ..expected(768) };
        let mut device = Device::new(chip.clone(), files.clone());
        let mut loader = Loader::new(chip, Unsigned, expected, Why::Stop, 0);
        assert_eq!(loader.write_control(3), Ok(()));
        if is_pending {
            device.work(&mut loader).expect("power");
        } else {
            device.chip.0.borrow_mut().slow = 10;
        }
        let lower = device.download(&mut loader, &files[0], 16).expect("power");
        let refused = Status::Refused(Field::Release).value(!is_pending);
        if !allows_downgrade {
            assert_eq!((lower, status(&loader)), (REFUSED, refused));
            for equal_or_higher in [1, 2] {
                device.work(&mut loader).expect("power");
                let file = &files[equal_or_higher];
                assert_eq!(device.download(&mut loader, file, 16).expect("power"), Ok(()));
                clear(&mut device, &mut loader);
            }
        } else {
            assert_eq!(lower, Ok(()));
        }
    }
}
