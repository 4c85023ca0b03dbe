//! The boards on the bus: who is on it, and what is done with one of them.

pub mod board;
pub mod live;
pub mod loader;
pub mod nodes;
pub mod rate;
pub mod rows;
pub mod scan;
