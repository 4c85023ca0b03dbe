//! The key whose owner signs the programs that the loader takes.

/// The public key of Ed25519. `cargo update-file --key PEM` says what belongs here.
pub const KEY: [u8; 32] = [0; 32];
