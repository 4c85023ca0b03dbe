//! The commands of `lss` on emulated boards with the release image and on boards in the process, in virtual time, and
//! its failures.

mod adapters;
mod apply;
mod assign;
mod bad_boards;
mod blink;
mod emulated;
mod find;
mod foreign;
mod in_process;
mod many_boards;
mod network;
mod nodes;
mod one_at_a_time;
mod picture;
mod power;
mod program;
mod replace;
mod services;
mod set_rate;
mod sheets;
mod slcan;
mod update;
mod watch;
