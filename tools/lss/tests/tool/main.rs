//! The commands of `lss` on emulated boards with the release image and on boards in the process, in virtual time, and
//! its failures.

mod apply;
mod assign;
mod emulated;
mod find;
mod foreign;
mod in_process;
mod network;
mod picture;
mod power;
mod program;
mod replace;
mod services;
mod set_rate;
mod slcan;
mod watch;
