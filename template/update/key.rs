//! Whose programs the loader takes, and which of them.

/// The public key of Ed25519 whose owner signs them. `cargo update-file --key PEM` writes it.
pub const KEY: [u8; 32] = [0; 32];

/// Whether it takes a lower release than the installed one: with it, whoever has recorded an old update can bring back the
/// faults of its program.
pub const DOWNGRADE: bool = false;
