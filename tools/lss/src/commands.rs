//! The commands, one a file.

mod apply;
pub mod assign;
mod blink;
mod find;
mod identify;
mod list;
mod one_board;
mod power;
mod raw;
mod set_id;
mod set_rate;
mod store;
mod watch;

pub use apply::apply;
pub use assign::assign;
pub use blink::blink;
pub use find::find;
pub use identify::identify;
pub use list::list;
pub use one_board::inquire;
pub use raw::raw;
pub use set_id::set_id;
pub use set_rate::set_rate;
pub use store::store;
pub use watch::watch;
