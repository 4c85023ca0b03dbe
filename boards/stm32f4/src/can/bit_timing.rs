//! Bit timing of the bxCAN: the register values of the bit rates.

use canopen_node::bit_rate::BitTiming;

use crate::chip::APB1_HZ;

/// The CAN_BTR values by index of the bit timing table; 0 for a rate that this clock cannot make and the node never
/// requests.
pub const BTR: [u32; 10] = {
    let timings = BitTiming::table(APB1_HZ);
    let mut values = [0; 10];
    let mut i = 0;
    while i < timings.len() {
        if let Some(timing) = timings[i] {
            values[i] = register(timing);
        }
        i += 1;
    }
    values
};

/// The value of CAN_BTR without its silent and loop-back bits (RM0090, 32.9.2).
const fn register(timing: BitTiming) -> u32 {
    (timing.sync_jump_width as u32 - 1) << 24
        | (timing.segment2 as u32 - 1) << 20
        | (timing.segment1 as u32 - 1) << 16
        | (timing.prescaler as u32 - 1)
}
