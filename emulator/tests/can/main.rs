//! Controllers on a wire.

mod errors;
mod frames;
mod modes;
mod node;
mod rates;
