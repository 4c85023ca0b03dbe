//! Your application: the objects of your product beside the node's own, and their behaviour. Edit this file.
//!
//! Here they are a lamp, which a client and an RPDO switch:
//!
//! ```
//! # use canopen_node::{objects, pdo::Rpdo};
//! objects! {
//!     /// The objects of the product, with their values.
//!     pub struct Application, values Value;
//!
//!     0x6200 "Write output 8-bit" {
//!         1 "Lamp" lamp: u8 = 0, rww in 0..=1;
//!     }
//! }
//!
//! impl canopen_node::Application for Application {
//!     const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x6200, 1)])];
//! }
//! ```
//!
//! `cargo xtask eds` then adds it to the electronic data sheet. [`objects!`] explains the other types, accesses and
//! options; `docs/product.md` shows how a task reads and writes the values.

use canopen_node::objects;

/// The node with the application.
pub type Node = canopen_node::Node<Application>;

objects! {
    /// The objects of the product, with their values.
    pub struct Application, values Value;
}

impl canopen_node::Application for Application {}
