//! The part of the product that also runs on a computer: its identity, its defaults and its application. Tools and
//! tests take them from here, such as `cargo xtask eds` for the electronic data sheet.

#![cfg_attr(not(test), no_std)]

pub mod application;
pub mod device;
