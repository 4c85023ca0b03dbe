//! Shared parts of the tests and tools: a node in the process, the release image on emulated boards, a flash with power
//! cuts, frames as text, data sheets, random numbers.

#[cfg(feature = "image")]
pub mod boards;
pub mod cargo;
pub mod eds;
#[cfg(feature = "image")]
pub mod elf;
pub mod emulated;
#[cfg(feature = "image")]
pub mod explain;
pub mod frames;
#[cfg(feature = "image")]
pub mod hex;
#[cfg(feature = "image")]
pub mod image;
#[cfg(feature = "image")]
pub mod image_rig;
#[cfg(feature = "image")]
pub mod io_board;
#[cfg(feature = "log")]
pub mod log;
#[cfg(feature = "image")]
pub mod lss_session;
pub mod node_rig;
#[cfg(feature = "image")]
pub mod parallel;
pub mod power_cut;
#[cfg(feature = "products")]
pub mod product;
#[cfg(feature = "products")]
pub mod release;
pub mod sdo;
pub mod sdo_messages;
#[cfg(feature = "image")]
pub mod sessions;
pub mod settings;
pub mod slave_bus;
#[cfg(feature = "image")]
pub mod stack;
#[cfg(feature = "image")]
pub mod storm;
pub mod supervised;
#[cfg(feature = "image")]
pub mod unmodelled;
#[cfg(feature = "products")]
pub mod update;
#[cfg(feature = "image")]
pub mod wire;

pub use memory_flash::{self as flash, random};
