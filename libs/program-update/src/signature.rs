//! The signature of an update file: Ed25519 over its header, which has the SHA-256 of the program.

use ed25519_dalek::{Signature, VerifyingKey};
pub use sha2::{Digest, Sha256};

use crate::header::{Field, HEADER_LEN, signed};

/// A public key of Ed25519.
pub type PublicKey = [u8; 32];

/// Whether the header is signed by the owner of a key. It takes about 30 ms on a Cortex-M4 at 160 MHz.
#[must_use]
pub fn is_signed(header: &[u8; HEADER_LEN], key: &PublicKey) -> bool {
    let signature = header.get(Field::Signature as usize..).and_then(<[u8]>::first_chunk);
    let (Some(signature), Ok(key)) = (signature, VerifyingKey::from_bytes(key)) else {
        return false;
    };
    key.verify_strict(signed(header), &Signature::from_bytes(signature)).is_ok()
}
