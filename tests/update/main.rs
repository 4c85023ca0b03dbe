//! Tests of a product whose program can be replaced over the bus: loader and program on an emulated board.

mod bad_programs;
mod blocks;
mod busy;
mod chips;
mod faults;
mod fleet;
mod install;
mod links;
mod master;
mod power_cut;
mod resets;
mod rig;
mod signed;
mod times;
mod trial;
mod wrong_files;
