//! A CANopen LSS slave (CiA 305) for any CANopen stack: deterministic, without I/O.
//!
//! The library reads no clock, allocates nothing, knows no chip and cannot panic. It takes frames and the present time
//! and says what the node has to do; the same calls always return the same results. This is all that LSS needs, over a
//! driver with the traits of `embedded-can`:
//!
//! ```
//! use std::collections::VecDeque; // Without an allocator `heapless::Deque`, with room for four frames.
//! use embedded_can::nb::Can;
//! use lss_slave::{Action, BitRate, BitRates, Frame, Instant, Settings, Slave, lss::{Address, StoreError}};
//!
//! const ADDRESS: Address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
//! /// The CAN driver, a timer, and a place for the settings.
//! trait Board: Can<Frame = Frame> {
//!     fn now(&self) -> Instant;
//!     fn load(&mut self) -> Option<Settings>;
//!     fn store(&mut self, settings: Settings) -> Result<(), StoreError>;
//!     fn run_at(&mut self, rate: BitRate, is_silent: bool);
//!     fn drop_frames(&mut self);
//! }
//!
//! fn run(board: &mut impl Board) {
//!     let settings = board.load().unwrap_or(Settings::new(BitRate::Kbit125.into()));
//!     let mut slave = Slave::new(ADDRESS, BitRates::possible(40_000_000), settings);
//!     board.run_at(slave.bit_rate().in_use(), slave.bit_rate().is_listening());
//!     let mut boot_up = slave.boot_up();
//!     // The frames for which the controller has no room yet. While there are some, requests wait in the controller.
//!     let mut outbox = VecDeque::new();
//!     loop {
//! #       if board.now().as_micros() > 200_000 { return }
//!         let now = board.now();
//!         let frame = if outbox.is_empty() { board.receive().ok() } else { None };
//!         let mut reaction = frame.and_then(|frame| slave.handle_frame(&frame, now));
//!         while let Some(action) = reaction.take().or_else(|| slave.poll(now)) {
//!             match action {
//!                 Action::Transmit(answer) => outbox.push_back(answer),
//!                 Action::Store => {
//!                     let outcome = board.store(slave.lss().pending());
//!                     slave.handle_stored(outcome);
//!                 }
//!                 Action::ResetCommunication => {
//!                     slave.reset_communication();
//!                     boot_up = slave.boot_up();
//!                 }
//!                 Action::SetBitRate(rate) => board.run_at(rate, false),
//!                 Action::Listen(rate) => board.run_at(rate, true),
//!                 Action::DropFrames => {
//!                     board.drop_frames();
//!                     outbox.clear();
//!                 }
//!                 Action::FilterFrames => {}
//!             }
//!         }
//!         if let Some(frame) = boot_up.take_if(|_| slave.may_send()) {
//!             slave.note_sent(now);
//!             outbox.push_back(frame);
//!         }
//!         while let Some(frame) = outbox.pop_front() {
//!             match board.transmit(&frame) {
//!                 Ok(None) => {}
//!                 Ok(Some(replaced)) => outbox.push_front(replaced), // By a frame of a higher priority.
//!                 Err(_) => {
//!                     outbox.push_front(frame);
//!                     break;
//!                 }
//!             }
//!         }
//!     }
//! }
//! # fn main() { test() }
//! # include!(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/first_page/board.rs"));
//! ```
//!
//! A driver's own frame becomes a [`Frame`] by [`Frame::received`], and the other way by its
//! `embedded_can::Frame::new(frame.id(), frame.data())`. When a node-ID replaces another one, it takes effect at NMT reset
//! communication: the node then does as at [`Action::ResetCommunication`]. The loop may sleep until
//! [`poll_at`](Slave::poll_at) or the next interrupt.
//!
//! With [`Slave::with_rescue`] (the feature `rescue`, on by default) and the controller's events it also finds its
//! network at another bit rate. A device that has one bit rate for ever needs the state machine alone:
//!
//! ```
//! use lss_slave::{
//!     BitRate, BitRates, Frame,
//!     cob_id::ERROR_CONTROL,
//!     lss::{Address, REQUEST_COB_ID, Reaction, Response, StateMachine},
//! };
//!
//! /// What a slave at 125 kbit/s, which stores nothing, sends after a frame.
//! fn answer(slave: &mut StateMachine, frame: &Frame) -> Option<Frame> {
//!     if frame.cob_id() != REQUEST_COB_ID {
//!         return None;
//!     }
//!     match slave.handle(frame.data().try_into().ok()?)? {
//!         Reaction::Answer(answer) => Some(answer),
//!         Reaction::StoreConfiguration => {
//!             Some(Response::StoreConfiguration(Err(lss_slave::lss::StoreError::NotSupported)).to_frame())
//!         }
//!         Reaction::ResetCommunication => {
//!             slave.reset_communication();
//!             let boot_up = ERROR_CONTROL + u16::from(slave.active_node_id()?.get());
//!             Frame::new(boot_up, &[0])
//!         }
//!         // There is no other rate to which it could switch.
//!         Reaction::ActivateBitTiming(_) => None,
//!     }
//! }
//!
//! let address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
//! let rates = BitRates::only(BitRate::Kbit125);
//! let mut slave = StateMachine::new(address, rates, None, BitRate::Kbit125.into());
//! let mut ask = |request: [u8; 8]| answer(&mut slave, &Frame::new(REQUEST_COB_ID, &request).unwrap());
//! let found = ask([0x4C, 0, 0, 0, 0, 0, 0, 0]).unwrap();
//! assert_eq!((found.cob_id(), found.data()[0]), (0x7E4, 0x50), "a slave without a node-ID");
//! assert_eq!(ask([0x04, 1, 0, 0, 0, 0, 0, 0]), None);
//! let refused = ask([0x13, 0, BitRate::Kbit500.index(), 0, 0, 0, 0, 0]).unwrap();
//! assert_eq!(refused.data()[..2], [0x13, 1], "another bit rate is refused");
//! ```
//! # Where to begin
//! - [`Slave`] is the whole slave; [`Action`] says what the node must do.
//! - [`lss::StateMachine`] is the state machine of CiA 305 alone.
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
mod slave;
mod time;

pub use bit_rate::{BitRate, BitRateSetting, BitRates, BusEvent};
pub use can::Frame;
pub use node_id::{InvalidNodeId, NodeId};
pub use settings::Settings;
pub use slave::{Action, Slave};
pub use time::{Deadline, Instant};
