//! The events of the node that an application may need.

use crate::{BitRate, NodeId, nmt};

/// An event of the node that an application may need.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Event {
    /// The node has entered another NMT state.
    Nmt(nmt::State),
    /// The node runs or listens at another bit rate.
    BitRate(BitRate),
    /// The values of the RPDO with this number, from 1, have taken effect.
    Received(u8),
    /// The RPDO with this number, from 1, has not come within its event timer.
    Late(u8),
    /// A SYNC was received in NMT operational. TPDOs that it asks for carry the values as they are after this event.
    Sync,
    /// A node that the heartbeat consumer watches has booted.
    BootUp(NodeId),
    /// The heartbeat of a node that the heartbeat consumer watches is missing.
    HeartbeatLost(NodeId),
    /// A heartbeat that was missing is back. If it is a boot-up, [`BootUp`](Self::BootUp) follows.
    HeartbeatBack(NodeId),
}
