//! The plan of a network: what the files say, what is found, and how the one becomes the other.

pub mod dcf;
pub mod differences;
pub mod files;
pub mod found;
pub mod new_boards;
pub mod node;
pub mod node_ids;
pub mod replacement;
pub mod sheet;
pub mod table;
pub mod update_file;
pub mod values;
