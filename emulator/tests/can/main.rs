//! Controllers on a wire.

mod errors;
mod frames;
mod node;
mod rates;
