//! LSS, the layer setting services of CiA 305: address, messages and the slave's state machine.

mod address;
mod message;
mod state_machine;

pub use address::{Address, AddressPart};
pub use message::{FastscanStep, IdentifyKey, Request, Response, StoreError};
pub use state_machine::{Reaction, State, StateMachine};

/// The COB-ID of requests from the LSS master to the slaves.
pub const REQUEST_COB_ID: u16 = 0x7E5;
/// The COB-ID of answers from an LSS slave to the master.
pub const RESPONSE_COB_ID: u16 = 0x7E4;
