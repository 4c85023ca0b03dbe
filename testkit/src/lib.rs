//! Shared parts of the tests and tools: a node in the process, the release image on emulated boards, a flash with power
//! cuts, frames as text, data sheets, random numbers.

#[cfg(feature = "image")]
pub mod boards;
pub mod cargo;
pub mod eds;
#[cfg(feature = "image")]
pub mod elf;
#[cfg(feature = "image")]
pub mod explain;
pub mod flash;
pub mod frames;
#[cfg(feature = "image")]
pub mod image;
#[cfg(feature = "image")]
pub mod image_rig;
#[cfg(feature = "image")]
pub mod io_board;
#[cfg(feature = "image")]
pub mod lss_session;
pub mod node_rig;
pub mod power_cut;
pub mod random;
pub mod rig_bus;
pub mod sdo;
pub mod sdo_messages;
pub mod settings;
pub mod soak;
#[cfg(feature = "image")]
pub mod stack;
#[cfg(feature = "image")]
pub mod stack_bound;
#[cfg(feature = "image")]
pub mod storm;
pub mod supervised;
#[cfg(feature = "image")]
pub mod thumb;
