//! This project's node with an application: a number that an RPDO sets.

#![no_std]
#![no_main]

use bench::{Place, own::Own};
use canopen_node::{Application, objects, pdo::Rpdo};

objects! {
    /// The objects.
    struct Objects, values Value;

    0x2100 {
        0 "Number" number: u32 = 0, rww;
    }
}

impl Application for Objects {
    const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x2100, 0)])];
}

static NODE: Place<Own<Objects>> = Place::empty();

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn prepare() {
    NODE.fill(Own::new(Objects::new()));
}

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn receive() {
    // SAFETY: `prepare` has filled it, and the reference ends here.
    unsafe { NODE.get() }.receive();
}
