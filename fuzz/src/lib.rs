//! The part of a board that targets share.

use canopen_node::lss::Address;

/// The LSS address of a board.
pub const ADDRESS: Address =
    Address { vendor_id: 0x11, product_code: 0x22, revision_number: 0x33, serial_number: 0x44 };
/// More actions than are ever due at one time.
const MOST_ACTIONS: usize = 32;

/// Calls `act_once`, which carries out the next action and returns whether there was one, until nothing is due.
///
/// # Panics
/// If the actions come to no end.
pub fn act_until_nothing_is_due(mut act_once: impl FnMut() -> bool) {
    let actions = (0..=MOST_ACTIONS).take_while(|_| act_once()).count();
    assert!(actions <= MOST_ACTIONS, "{MOST_ACTIONS} actions without an end");
}
