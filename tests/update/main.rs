//! Tests of a product whose program can be replaced over the bus: loader and program on an emulated board.

mod install;
mod rig;
