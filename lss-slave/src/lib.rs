//! A CANopen LSS slave (CiA 305) and the small node around it: deterministic, without I/O.
//!
//! The library reads no clock, allocates nothing, knows no chip and cannot panic. It takes frames and the present time
//! and returns [`Action`]s; the same calls always return the same actions. A board carries the actions out. Here a
//! master asks whether any slave has no node-ID:
//!
//! ```
//! use lss_slave::{Action, BitRate, BitRates, Device, Frame, Instant, Node, Settings, lss::Address};
//!
//! let address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
//! let device = Device::new(address, BitRates::possible(40_000_000))
//!     .with_defaults(Settings::new(BitRate::Kbit125.into()))
//!     .with_name("Example");
//! let mut node = Node::new(device, None);
//! let now = Instant::from_micros(0);
//! assert_eq!(node.poll(now), None, "no boot-up without a node-ID");
//!
//! let is_anyone_unconfigured = Frame::new(0x7E5, &[0x4C, 0, 0, 0, 0, 0, 0, 0]).unwrap();
//! let Some(Action::Transmit(answer)) = node.handle_frame(&is_anyone_unconfigured, now) else { panic!() };
//! assert_eq!((answer.cob_id(), answer.data()), (0x7E4, &[0x50, 0, 0, 0, 0, 0, 0, 0][..]));
//! ```
//!
//! A complete port, on a bus within the process:
//!
//! ```no_run
#![doc = include_str!("../examples/in_process_bus.rs")]
//! ```
//!
//! # Where to begin
//! - [`Node`] documents the calls that drive it and their order; [`Action`] documents what the board must do.
//! - [`Device`] describes the device, [`Settings`] its configuration; [`settings::Log`] keeps the settings in flash.
//! - [`BitRates`] holds the bit rates that a clock can produce, [`bit_rate::BitTiming`] the segments for each.
//! - [`lss::Slave`] is the state machine of CiA 305 alone, for a node that has its own NMT and SDO.
//!
//! # Features
//! - `defmt`: `defmt::Format` for the public types.

#![no_std]
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod application;
pub mod bit_rate;
pub mod emergency;
pub mod indicator;
pub mod lss;
pub mod nmt;
pub mod object_dictionary;
pub mod process_data;
pub mod sdo;
pub mod settings;

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

mod bus_event;
mod can;
mod device;
mod node;
mod node_id;
mod supervision;
mod time;

pub use application::Application;
pub use bit_rate::{BitRate, BitRateSetting, BitRates};
pub use bus_event::BusEvent;
pub use can::Frame;
pub use device::Device;
pub use node::{Action, Node, Receives};
pub use node_id::{InvalidNodeId, NodeId};
pub use settings::Settings;
pub use time::Instant;
