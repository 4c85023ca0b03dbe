//! The boards on the bus: who is there, and what is done with one of them.

pub mod board;
pub mod live;
pub mod scan;
