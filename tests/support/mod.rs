//! What the tests of the library share: a board around the node, a flash whose power can fail, frames as text, random numbers.
#![allow(dead_code, reason = "each test file uses some of it")]

pub mod bench;
pub mod board;
pub mod flash;
pub mod frames;
pub mod random;
pub mod sdo;
pub mod settings;
pub mod stack;
pub mod storm;
pub mod supervised;
