//! A program that can be replaced over the bus, and the loader that replaces it.

#[cfg(target_os = "none")]
mod areas;
#[cfg(target_os = "none")]
mod boot;
#[cfg(target_os = "none")]
pub mod loader;
mod objects;
#[cfg(target_os = "none")]
mod program;

pub use objects::Update;
#[cfg(target_os = "none")]
pub use program::Steps;
pub use program_update::program::Confirm;
