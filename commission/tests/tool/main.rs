//! The commands of `lss` on emulated boards with the release image, in virtual time, and its failures.

mod assign;
mod emulated;
mod find;
mod network;
mod power;
mod program;
mod replace;
mod services;
mod set_rate;
mod slcan;
mod watch;
