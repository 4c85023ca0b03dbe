//! A CANopen LSS slave (CiA 305) for any CANopen stack: deterministic, without I/O.
//!
//! The library reads no clock, allocates nothing, knows no chip and cannot panic. It takes frames and the present time
//! and says what the node has to do; the same calls always return the same results. Here a master asks whether any
//! slave has no node-ID:
//!
//! ```
//! use lss_slave::{BitRate, BitRates, Frame, lss::{Address, Reaction, Slave}};
//!
//! let address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
//! let rates = BitRates::possible(40_000_000);
//! let mut slave = Slave::new(address, rates, None, BitRate::Kbit125.into());
//!
//! let is_anyone_unconfigured = [0x4C, 0, 0, 0, 0, 0, 0, 0];
//! let Some(Reaction::Answer(answer)) = slave.handle(&is_anyone_unconfigured) else { panic!() };
//! assert_eq!((answer.cob_id(), answer.data()), (0x7E4, &[0x50, 0, 0, 0, 0, 0, 0, 0][..]));
//! ```
//!
//! Joined to a small node of one's own:
//!
//! ```no_run
#![doc = include_str!("../examples/own_node.rs")]
//! ```
//!
//! # Where to begin
//! - [`lss::Slave`] is the state machine of CiA 305; [`lss::Reaction`] says what the node must do after a request.
//! - [`bit_rate::Control`] switches the bit rate with both delays, detects it, and finds the others if it is wrong.
//! - [`settings::Log`] keeps [`Settings`] in flash, safe from power cuts.
//! - [`BitRates`] holds the bit rates that a clock can produce, [`bit_rate::BitTiming`] the segments for each.
//!
//! The crate `canopen-node` is a whole node around them.
//!
//! # Features
//! - `defmt`: `defmt::Format` for the public types.

#![no_std]
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod bit_rate;
#[doc(hidden)]
pub mod bytes;
pub mod cob_id;
pub mod lss;
pub mod settings;

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

mod can;
mod node_id;
mod time;

pub use bit_rate::{BitRate, BitRateSetting, BitRates, BusEvent};
pub use can::Frame;
pub use node_id::{InvalidNodeId, NodeId};
pub use settings::Settings;
pub use time::Instant;
