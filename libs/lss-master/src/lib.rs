//! A CANopen LSS master (CiA 305): deterministic, without I/O.
//!
//! The library reads no clock, allocates nothing, knows no adapter and cannot panic. It takes frames and the present
//! time and returns frames to send, instants and results; the same calls always return the same outputs. The messages
//! are those of [`lss_slave::lss`]. Here the master finds a slave that has no node-ID, which answers at once:
//!
//! ```
//! use lss_master::{Fastscan, Instant, Master, Output, Timing};
//! use lss_slave::{BitRate, BitRates, lss::{Address, Reaction, StateMachine}};
//!
//! let address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
//! let mut slave = StateMachine::new(address, BitRates::possible(40_000_000), None, BitRate::Kbit125.into());
//!
//! let mut master = Master::new(Timing::default());
//! let mut scan = master.start(Fastscan::new());
//! let mut now = Instant::from_micros(0);
//! let found = loop {
//!     match scan.poll(now) {
//!         Output::Transmit(request) => {
//!             let data = request.data().try_into().expect("a request has eight bytes");
//!             if let Some(Reaction::Answer(answer)) = slave.handle(data) {
//!                 now = now.plus_micros(1_000);
//!                 scan.handle_frame(&answer, now);
//!             }
//!         }
//!         Output::Wait(until) => now = until,
//!         Output::SetBitRate(_) => {}
//!         Output::Done(found) => break found,
//!     }
//! };
//! assert_eq!(found, Ok(Some(address)));
//! ```
//!
//! A network is commissioned on a bus within the process by
//!
//! ```no_run
#![doc = include_str!("../examples/commission.rs")]
//! ```
//!
//! # Where to begin
//! - [`run`] carries out a [`Procedure`] on a [`Bus`]. Where nothing may wait, [`Master::start`] begins it, and
//!   [`Session`] documents the calls.
//! - Single services: any [`Request`](lss_slave::lss::Request), [`Select`], [`SelectAlone`], [`InquireAddress`],
//!   [`InquireNodeId`], [`Identify`].
//! - Who is there: [`Fastscan`] finds slaves without a node-ID, [`Find`] all of a product.
//! - What they are to be: [`Configure`], [`Assign`], [`SwitchBitRate`].
//! - [`Timing`] says how long the master waits; it adapts to slow slaves.

#![no_std]
#![forbid(unsafe_code)]
#![deny(missing_docs)]

mod assign;
mod error;
mod fastscan;
mod find;
mod inquire;
mod master;
mod procedure;
mod run;
mod service;
mod switch_bit_rate;

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub use assign::{Assign, Configure};
pub use error::Error;
pub use fastscan::Fastscan;
pub use find::Find;
pub use inquire::{InquireAddress, InquireNodeId, Select, SelectAlone};
pub use lss_slave::Instant;
pub use master::{Master, Output, Session, Timing};
pub use procedure::{Outcome, Procedure, Step};
pub use run::{Bus, run};
pub use service::{Identify, Service};
pub use switch_bit_rate::{Member, SwitchBitRate};
