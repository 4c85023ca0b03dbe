//! The LSS slave of canopen-rs without a node.

#![no_std]
#![no_main]

use bench::{IDENTITY, Place, received_data, received_identifier, transmit};
use canopen_rs::lss::{
    LSS_MASTER_COB_ID, LSS_SLAVE_COB_ID, LssAddress, LssSlave, UNCONFIGURED_NODE_ID,
};

/// The LSS state, whose size is measured.
// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
static LSS_STATE: Place<LssSlave> = Place::empty();

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn prepare() {
    let [vendor_id, product_code, revision_number, serial_number] = IDENTITY;
    let address = LssAddress { vendor_id, product_code, revision_number, serial_number };
    LSS_STATE.fill(LssSlave::new(address, UNCONFIGURED_NODE_ID));
}

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn receive() {
    if received_identifier() != LSS_MASTER_COB_ID {
        return;
    }
    let (length, data) = received_data();
    if length != 8 {
        return;
    }
    // SAFETY: `prepare` has filled it, and the reference ends here.
    if let Some(answer) = unsafe { LSS_STATE.get() }.handle(&data) {
        transmit(LSS_SLAVE_COB_ID, 8, answer);
    }
}
