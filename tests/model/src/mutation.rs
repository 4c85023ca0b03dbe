//! Defects that a test gives to the boards: the checker must find each of them.

use canopen_node::{Frame, lss};
use testkit::frames::request;

use crate::board::address;

/// A defect at the interface of the node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Mutation {
    /// The memory confirms a store without storing.
    ConfirmsWithoutStoring,
    /// The memory reports a store as failed, and stores its settings in place of the next ones, which it confirms.
    StoresWhatFailed,
    /// The board never sends again after a switch of the bit rate.
    StaysSilent,
    /// The node takes the numbers of other devices in Fastscan for its own.
    MatchesEveryScan,
    /// The node takes the serial numbers of others in switch state selective for its own.
    MatchesEverySelect,
    /// The node ignores switch state global to waiting.
    IgnoresWaiting,
    /// The node takes a node-ID in LSS waiting state.
    TakesEveryNodeId,
    /// The node forgets that it is selected, but not the node-ID that it was given: the supervision once did so after
    /// three lone bit errors.
    LeavesItsSession,
}

impl Mutation {
    /// The frames that the node receives in place of `frame`.
    pub fn received(mutation: Option<Self>, board: usize, frame: &Frame) -> Vec<Frame> {
        let own = address(board).serial_number.to_le_bytes();
        let with_own_serial_number = || {
            let mut data = frame.padded_data();
            data[1..5].copy_from_slice(&own);
            vec![Frame::new(lss::REQUEST_COB_ID, &data).expect("eight bytes")]
        };
        match (mutation, frame.padded_data()) {
            _ if frame.cob_id() != lss::REQUEST_COB_ID => vec![*frame],
            (Some(Self::MatchesEveryScan), [0x51, .., 3, _]) => with_own_serial_number(),
            (Some(Self::MatchesEverySelect), [0x43, ..]) => with_own_serial_number(),
            (Some(Self::IgnoresWaiting), [0x04, 0, ..]) => vec![],
            (Some(Self::TakesEveryNodeId), [0x11, ..]) => {
                vec![request("04 01"), *frame, request("04 00")]
            }
            _ => vec![*frame],
        }
    }
}
