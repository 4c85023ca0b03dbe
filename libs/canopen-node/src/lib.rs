//! A CANopen node (CiA 301) that an LSS master can configure (CiA 305): deterministic, without I/O.
//!
//! The library reads no clock, allocates nothing, knows no chip and cannot panic. It takes frames and the present time
//! and returns [`Action`]s; the same calls always return the same actions. A board carries the actions out. Here a
//! master asks whether any slave has no node-ID:
//!
//! ```
//! use canopen_node::{Action, BitRate, BitRates, Device, Frame, Instant, Node, Settings, lss::Address};
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
//! let Some(Action::Transmit(answer, _)) = node.handle_frame(&is_anyone_unconfigured, now) else { panic!() };
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
//! - [`objects!`] declares the objects of a product, [`Application`] its behaviour.
//!
//! LSS, bit rates and settings are those of the crate `lss-slave`, which serves other CANopen stacks too.
//!
//! # Features
//! - `rescue`, on by default: the code of [`Device::with_rescue`], about 1 KB.
//! - `defmt`: `defmt::Format` for the public types, and the log of the [`runner`].

#![no_std]
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod application;
mod cob_id;
pub mod emergency;
mod heartbeat;
pub mod indicator;
pub mod nmt;
pub mod object_dictionary;
pub mod pdo;
pub mod runner;
pub mod sdo;
mod sync;

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

mod count;
mod declaration_error;
mod device;
mod node;
mod numbers;

pub use application::Application;
pub use count::Count;
pub use device::Device;
pub use lss_slave::{
    BitRate, BitRateSetting, BitRates, BusEvent, Deadline, Frame, Instant, InvalidNodeId, NodeId,
    Settings, bit_rate, lss, settings,
};
pub use node::{Action, Node, Program, Receives, Service, Services};
pub use numbers::Numbers;

/// What the macros name; it is no part of the interface.
#[doc(hidden)]
pub mod private {
    pub use pastey;

    pub use crate::{
        application::{
            check::{check, check_count, check_methods, fail},
            declaration::{Row, count, firsts, longest, table},
            field::{Plain, ValueOf, bits, check_limits, len, read},
        },
        emergency::own::of_application,
    };
}
