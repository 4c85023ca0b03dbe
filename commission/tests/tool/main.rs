//! The commands of `lss` on emulated boards with the release image, in virtual time, and its failures.

mod emulated;
mod network;
mod program;
mod services;
