//! Your application: the objects of your product beside the node's own, and their behaviour. Edit this file.
//!
//! An object takes three lines, here a brightness of 0 to 100 percent. `cargo eds` adds it to the electronic data sheet.
//! [`objects!`] explains the other types, accesses and options; `docs/product.md` shows how a task reads and writes the
//! values.

use canopen_node::objects;

/// The node with the application.
pub type Node = canopen_node::Node<Application>;

objects! {
    /// The objects of the product, with their values.
    pub struct Application, values Value;

    0x2100 {
        0 "Brightness in percent" brightness: u8 = 50, rw in 0..=100, stored;
    }
}

impl canopen_node::Application for Application {}
