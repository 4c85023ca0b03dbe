//! The commands, one a file.

mod identify;
mod inquire;
mod raw;
mod set_id;
mod store;

pub use identify::identify;
pub use inquire::inquire;
pub use raw::raw;
pub use set_id::set_id;
pub use store::store;
