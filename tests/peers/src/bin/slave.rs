//! This project's LSS slave without a node.

#![no_std]
#![no_main]

use bench::{IDENTITY, Place, received_data, received_identifier, transmit};
use lss_slave::{
    BitRate, BitRates,
    lss::{Address, REQUEST_COB_ID, Reaction, Response, StateMachine},
};

const BIT_RATES: BitRates = BitRates::possible(40_000_000);

/// The LSS state, whose size is measured.
// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
static LSS_STATE: Place<StateMachine> = Place::empty();

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn prepare() {
    let [vendor_id, product_code, revision_number, serial_number] = IDENTITY;
    let address = Address { vendor_id, product_code, revision_number, serial_number };
    LSS_STATE.fill(StateMachine::new(address, BIT_RATES, None, BitRate::Kbit125.into()));
}

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn receive() {
    if received_identifier() != REQUEST_COB_ID {
        return;
    }
    let (length, data) = received_data();
    if length != 8 {
        return;
    }
    // SAFETY: `prepare` has filled it, and the reference ends here.
    let slave = unsafe { LSS_STATE.get() };
    let answer = match slave.handle(&data) {
        Some(Reaction::Answer(answer)) => answer,
        Some(Reaction::StoreConfiguration) => Response::StoreConfiguration(Ok(())).to_frame(),
        Some(Reaction::ActivateBitTiming(_)) => {
            slave.activate_bit_rate(slave.pending_bit_rate());
            return;
        }
        Some(Reaction::ResetCommunication) => return slave.reset_communication(),
        None => return,
    };
    transmit(answer.cob_id(), answer.data().len(), answer.padded_data());
}
