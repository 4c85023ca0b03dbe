//! The commands.

mod apply;
mod assign;
mod find;
mod list;
mod node;
mod one_board;
mod power;
mod set_rate;
mod update;
mod watch;

pub use apply::apply;
pub use assign::assign;
pub use find::find;
pub use list::list;
pub use node::{RESET, START, STOP, adapters, data_type, nmt, read, write};
pub use one_board::{blink, identify, inquire, raw, set_id, store};
pub use set_rate::set_rate;
pub use update::update;
pub use watch::watch;
