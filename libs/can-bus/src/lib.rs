//! What programs with a CAN adapter share: SLCAN and SocketCAN, the bus as an LSS master sees it, an SDO client,
//! frames in words, electronic data sheets, drawings, and questions to the person.

pub mod adapter;
pub mod address;
#[cfg(feature = "adapters")]
pub mod bus;
pub mod date;
pub mod eds;
pub mod explain;
#[cfg(feature = "adapters")]
pub mod person;
#[cfg(feature = "adapters")]
pub mod sdo;
pub mod slcan;
pub mod stop;
pub mod svg;
