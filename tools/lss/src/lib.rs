//! The commands of `lss`, which commissions a CANopen network, on any adapter of `can-bus`.

mod address;
mod arguments;
mod commands;
mod failure;
mod network;
mod picture;
mod plan;
mod progress;
mod recorder;
mod run;
mod session;

pub use arguments::{Arguments, Command};
pub use commands::adapters;
pub use failure::Failure;
pub use progress::Shows;
pub use session::{Screen, Session};
