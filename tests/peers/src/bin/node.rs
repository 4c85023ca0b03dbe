//! This project's node.

#![no_std]
#![no_main]

use bench::{Place, own::Own};
use canopen_node::application::NoApplication;

static NODE: Place<Own<NoApplication>> = Place::empty();

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn prepare() {
    NODE.fill(Own::new(NoApplication));
}

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn receive() {
    // SAFETY: `prepare` has filled it, and the reference ends here.
    unsafe { NODE.get() }.receive();
}
