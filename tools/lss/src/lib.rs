//! The commands of `lss`, which commissions a CANopen network, on any adapter of `can-bus`.

mod address;
mod arguments;
mod commands;
mod failure;
mod give;
mod live;
mod picture;
mod progress;
mod recorder;
mod scan;
mod session;
mod table;

pub use arguments::{Arguments, Command};
pub use failure::Failure;
pub use recorder::Recorder;
pub use session::{Screen, Session};
