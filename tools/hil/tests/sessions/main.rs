//! `cargo hil` against `cargo emulate`: whole boards, boards broken on purpose, and bad benches.

mod broken;
mod conformance;
mod folder;
mod lone;
mod port;
mod product;
mod proxy;
mod run;
mod whole;
