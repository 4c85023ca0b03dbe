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

/// A loader with program 0, cleared.
fn cleared() -> (Chip, Loader) {
    let chip = Device::new(Chip::with(&file(0, 20), 0), Vec::new()).chip;
    let mut loader = Loader::new(chip.clone(), Signed, expected(768), Why::Stop, 0);
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
