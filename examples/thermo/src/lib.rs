//! The part of the product that also runs on a computer: its identity, its defaults and its application. The tests take
//! them from here.

#![cfg_attr(not(test), no_std)]

pub mod application;
pub mod device;
