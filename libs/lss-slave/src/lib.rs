//! A CANopen LSS slave (CiA 305) for any CANopen stack: deterministic, without I/O.
//!
//! The library reads no clock, allocates nothing, knows no chip and cannot panic. It takes frames and the present time
//! and says what the node has to do; the same calls always return the same results. This is all that LSS needs, over a
//! driver with the traits of `embedded-can`:
//!
//! ```
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
//!     loop {
//! #       if board.now().as_micros() > 100_000 { return }
//!         let now = board.now();
//!         let mut reaction = board.receive().ok().and_then(|frame| slave.handle_frame(&frame, now));
//!         while let Some(action) = reaction.take().or_else(|| slave.poll(now)) {
//!             let answer = match action {
//!                 Action::Transmit(answer) => Some(answer),
//!                 Action::Store => {
//!                     let outcome = board.store(slave.lss().pending());
//!                     slave.handle_stored(outcome);
//!                     None
//!                 }
//!                 Action::ResetCommunication => {
//!                     slave.reset_communication();
//!                     boot_up = slave.boot_up();
//!                     None
//!                 }
//!                 Action::SetBitRate(rate) => { board.run_at(rate, false); None }
//!                 Action::Listen(rate) => { board.run_at(rate, true); None }
//!                 Action::StopTransmitting => { board.drop_frames(); None }
//!                 Action::ResumeTransmitting | Action::FilterFrames => None,
//!             };
//!             answer.map(|frame| board.transmit(&frame));
//!         }
//!         boot_up.take_if(|_| slave.may_send()).map(|frame| { slave.note_sent(now); board.transmit(&frame) });
//!     }
//! }
//! #
//! # /// A board whose master sends one request in a millisecond.
//! # #[derive(Default)]
//! # struct Simulated {
//! #     micros: core::cell::Cell<u32>,
//! #     requests: std::collections::VecDeque<lss_slave::lss::Request>,
//! #     log: Vec<String>,
//! #     stored: Option<Settings>,
//! # }
//! #
//! # impl Can for Simulated {
//! #     type Frame = Frame;
//! #     type Error = embedded_can::ErrorKind;
//! #     fn transmit(&mut self, frame: &Frame) -> nb::Result<Option<Frame>, Self::Error> {
//! #         self.log.push(format!("{frame:?}"));
//! #         Ok(None)
//! #     }
//! #     fn receive(&mut self) -> nb::Result<Frame, Self::Error> {
//! #         self.requests.pop_front().map(|request| request.to_frame()).ok_or(nb::Error::WouldBlock)
//! #     }
//! # }
//! #
//! # impl Board for Simulated {
//! #     fn now(&self) -> Instant {
//! #         self.micros.set(self.micros.get() + 1_000);
//! #         Instant::from_micros(self.micros.get())
//! #     }
//! #     fn load(&mut self) -> Option<Settings> {
//! #         self.stored
//! #     }
//! #     fn store(&mut self, settings: Settings) -> Result<(), StoreError> {
//! #         self.stored = Some(settings);
//! #         Ok(())
//! #     }
//! #     fn run_at(&mut self, rate: BitRate, is_silent: bool) {
//! #         self.log.push(format!("{rate}, silent: {is_silent}"));
//! #     }
//! #     fn drop_frames(&mut self) {
//! #         self.log.push("drops its frames".into());
//! #     }
//! # }
//! #
//! # use lss_slave::lss::Request;
//! # let requests = [
//! #     Request::SwitchToConfiguration,
//! #     Request::ConfigureNodeId(5),
//! #     Request::ConfigureBitTiming { table: 0, index: BitRate::Kbit500.index() },
//! #     Request::StoreConfiguration,
//! #     Request::SwitchToWaiting,
//! #     Request::SwitchToConfiguration,
//! #     Request::ActivateBitTiming(10),
//! # ];
//! # let mut board = Simulated { requests: requests.into(), ..Simulated::default() };
//! # run(&mut board);
//! # let zeros = "00, 00, 00, 00, 00, 00, 00";
//! # assert_eq!(
//! #     board.log,
//! #     [
//! #         "125 kbit/s, silent: false".into(),
//! #         format!("7E4: [11, {zeros}]"),
//! #         format!("7E4: [13, {zeros}]"),
//! #         format!("7E4: [17, {zeros}]"),
//! #         "705: [00]".into(),
//! #         "drops its frames".into(),
//! #         "500 kbit/s, silent: false".into(),
//! #     ]
//! # );
//! # board.log.clear();
//! # board.micros.set(0);
//! # run(&mut board);
//! # assert_eq!(board.log, ["500 kbit/s, silent: false", "705: [00]"], "both settings are stored");
//! ```
//!
//! A driver's own frame becomes a [`Frame`] by [`Frame::received`], and the other way by its
//! `embedded_can::Frame::new(frame.id(), frame.data())`. When a node-ID replaces another one, it takes effect at NMT reset
//! communication: the node then does as at [`Action::ResetCommunication`]. The loop may sleep until
//! [`poll_at`](Slave::poll_at) or the next interrupt.
//!
//! With [`Slave::with_rescue`] and the controller's events it also finds its network at another bit rate. A device that
//! has one bit rate for ever needs the state machine alone:
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
