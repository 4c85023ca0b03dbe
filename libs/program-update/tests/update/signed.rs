//! A loader that takes only signed programs: Ed25519 over the header, SHA-256 of the program.

use ed25519_dalek::{Signer, SigningKey};
use program_update::{
    Abort, Action, Header, Object, Signed, Status, Updater,
    header::{Field, SIGNED_LEN},
    signature::{Digest, Sha256, is_signed},
    start::Why,
};

use crate::{
    device::Device,
    flash::Chip,
    program::{expected, file},
};

type Loader = Updater<Chip, Signed, 64>;

fn key() -> SigningKey {
    SigningKey::from_bytes(&[7; 32])
}

/// Program 1 in a file with the signature of a key.
fn signed_by(key: &SigningKey, change: impl FnOnce(&mut Header)) -> Vec<u8> {
    let mut file = file(1, 20);
    let bytes = file.first_chunk().expect("a header");
    let mut header = Header::parse(bytes).expect("its fields");
    header.sha256 = Sha256::digest(&file[512..]).into();
    change(&mut header);
    let signature = key.sign(&header.to_bytes()[..SIGNED_LEN]);
    let header = Header { signature: signature.to_bytes(), ..header };
    file[..512].copy_from_slice(&header.to_bytes());
    file
}

/// A loader with program 0.
fn stopped() -> (Chip, Loader) {
    let chip = Device::new(Chip::with(&file(0, 20), 0), Vec::new()).chip;
    let loader = Loader::new(chip.clone(), Signed, expected(768), Why::Stop, 0);
    (chip, loader)
}

/// The same, cleared.
fn cleared() -> (Chip, Loader) {
    let (mut chip, mut loader) = stopped();
    let header = &signed_by(&key(), |_| ())[..512];
    assert_eq!(download(&mut chip, &mut loader, header, true), Err(Abort::DeviceState));
    assert_eq!(loader.write_control(3), Ok(()));
    while loader.is_busy() {
        assert_eq!(loader.poll(0), None);
    }
    (chip, loader)
}

/// Does what the loader asks for until it answers.
fn answer(chip: &mut Chip, loader: &mut Loader, is_first: bool) -> Option<Result<(), Abort>> {
    for _ in 0..2000 {
        let next = match loader.poll(0) {
            Some(Action::Verify) => {
                let public = key().verifying_key().to_bytes();
                let is_signed = is_signed(loader.header_bytes(), &public);
                loader.verified(is_signed)
            }
            Some(Action::Hash { words }) => loader.hashed(&hash(chip, words)),
            other => other,
        };
        match next {
            Some(Action::Answer(outcome)) => return Some(outcome),
            Some(other) => panic!("{other:?}"),
            None if is_first && !loader.is_busy() => return None,
            None => {}
        }
    }
    None
}

fn hash(chip: &mut Chip, words: u32) -> [u8; 32] {
    use program_update::{Area, Flash};
    let mut hash = Sha256::new();
    (0..words).for_each(|i| hash.update(chip.read(Area::Run, 512 + 4 * i).to_le_bytes()));
    hash.finalize().into()
}

/// Downloads a file. The check of the signature ends after its header, or only when the client has sent all.
fn download(chip: &mut Chip, loader: &mut Loader, file: &[u8], is_late: bool) -> Result<(), Abort> {
    for (i, part) in file.chunks(16).enumerate() {
        loader.write(16 * i as u32, part)?;
        if !is_late && i == 31 {
            assert_eq!(answer(chip, loader, true), None);
        }
    }
    loader.end(file.len() as u32)?;
    answer(chip, loader, false).expect("an answer")
}

#[test]
fn only_a_program_with_the_signature_of_the_key_and_its_hash_is_installed() {
    let other_key = SigningKey::from_bytes(&[8; 32]);
    let refused = (Err(Abort::NotStored), Status::Refused(Field::Signature));
    let cases = [
        (file(1, 20), refused),
        (signed_by(&other_key, |_| ()), refused),
        (
            signed_by(&key(), |header| header.sha256[31] ^= 1),
            (Err(Abort::Hardware), Status::Damaged(Field::Hash)),
        ),
        (signed_by(&key(), |_| ()), (Ok(()), Status::Ok)),
    ];
    for (file, (outcome, status)) in cases {
        for is_late in [false, true] {
            let (mut chip, mut loader) = cleared();
            let before = chip.operations();
            assert_eq!(download(&mut chip, &mut loader, &file, is_late), outcome);
            assert_eq!(loader.read(Object::FlashStatus), status.value(false));
            let is_written = chip.operations() > before;
            assert_eq!(is_written, outcome != Err(Abort::NotStored), "late: {is_late}");
        }
    }
}

#[test]
fn nothing_is_erased_before_a_header_has_the_signature_and_each_clear_wants_one() {
    let header = |key: &SigningKey| signed_by(key, |_| ())[..512].to_vec();
    let other_key = SigningKey::from_bytes(&[8; 32]);
    let refused = Status::Refused(Field::Signature).value(false);
    for is_late in [false, true] {
        let (mut chip, mut loader) = stopped();
        for header in [None, Some(header(&other_key)), Some(file(1, 20)[..512].to_vec())] {
            if let Some(header) = header {
                let outcome = download(&mut chip, &mut loader, &header, is_late);
                assert_eq!(outcome, Err(Abort::NotStored));
                assert_eq!(loader.read(Object::FlashStatus), refused);
            }
            assert_eq!(loader.write_control(3), Err(Abort::DeviceState));
            assert_eq!(loader.read(Object::FlashStatus), refused);
            assert!(!loader.is_busy());
        }
        assert_eq!(chip.operations(), 0);
        // The header alone, then the whole file: each is proven before "not cleared" is answered.
        let whole = signed_by(&key(), |_| ());
        for len in [512, whole.len()] {
            let outcome = download(&mut chip, &mut loader, &whole[..len], is_late);
            assert_eq!(outcome, Err(Abort::DeviceState));
            assert_eq!(loader.read(Object::FlashStatus), Status::NotCleared.value(false));
        }
        assert_eq!(loader.write_control(3), Ok(()));
        assert_eq!(answer(&mut chip, &mut loader, true), None);
        assert_eq!(download(&mut chip, &mut loader, &whole, is_late), Ok(()));
        assert_eq!(loader.write_control(3), Err(Abort::DeviceState), "the header has been used");
    }
}

#[test]
fn a_signature_does_not_count_for_the_download_after_it() {
    let (_, mut loader) = cleared();
    let begin = |loader: &mut Loader, file: &[u8]| {
        for (i, part) in file.chunks(16).take(33).enumerate() {
            loader.write(16 * i as u32, part).expect("it fits");
        }
    };
    begin(&mut loader, &signed_by(&key(), |_| ()));
    assert_eq!(loader.poll(0), Some(Action::Verify));
    loader.abort();
    begin(&mut loader, &file(1, 20));
    assert_eq!(loader.verified(true), None);
    assert_eq!(loader.poll(0), Some(Action::Verify), "the other one needs its own");
    assert_eq!(loader.verified(false), None);
    assert_eq!(loader.write(33 * 16, &[0; 16]), Err(Abort::NotStored));
}

#[test]
fn an_abort_while_the_hash_is_calculated_leaves_the_loader_ready_for_another_clear() {
    let (mut chip, mut loader) = cleared();
    let file = signed_by(&key(), |_| ());
    loader.write(0, &file[..512]).expect("room");
    assert_eq!(answer(&mut chip, &mut loader, true), None);
    loader.write(512, &file[512..]).expect("room");
    loader.end(file.len() as u32).expect("it is whole");
    let asked = (0..100).find_map(|_| loader.poll(0)).expect("an action");
    let Action::Hash { words } = asked else { panic!("{asked:?}") };
    loader.abort();
    assert!(!loader.is_busy());
    assert_eq!(loader.hashed(&hash(&mut chip, words)), None);
    assert_eq!(loader.poll(0), None);
    assert_eq!(loader.read(Object::FlashStatus), Status::NotCleared.value(false));
}

/// A key that is the neutral point: without further checks the signature of nobody fits each header.
#[test]
fn a_key_of_small_order_has_no_signature() {
    let neutral = std::array::from_fn(|i| u8::from(i == 0));
    let mut signature = [0; 64];
    signature[0] = 1;
    let bytes = signed_by(&key(), |_| ());
    let header = Header::parse(bytes.first_chunk().expect("a header")).expect("its fields");
    assert!(!is_signed(&Header { signature, ..header }.to_bytes(), &neutral));
}
