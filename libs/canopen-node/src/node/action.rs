//! The actions that a node returns and the board carries out.

use super::outgoing::{Service, Services};
use crate::{BitRate, Frame, NodeId, Settings};

/// An action for the board to carry out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[must_use]
pub enum Action {
    /// Send this frame, and report its service to [`handle_sent`](crate::Node::handle_sent) when it was acknowledged. Frames
    /// of equal COB-ID must leave in the order of their actions. A TPDO may replace an older one of its COB-ID that has
    /// not left.
    Transmit(Frame, Service),
    /// Receive the COB-IDs that a node with this node-ID [`receives`](crate::Node::receives). Drop all pending frames except
    /// those of LSS: they carry the previous COB-IDs. A frame that is on the bus now may finish; later frames
    /// of the node leave after it.
    SetNodeId(Option<NodeId>),
    /// Receive the frames that the node [`receives`](crate::Node::receives): a master has changed a COB-ID of process
    /// data, or the bit rate is proven.
    SetReceives,
    /// Drop the pending frames of these services: they name another NMT state, or the new one forbids them. All of them
    /// when a switch of the bit rate begins, or when nobody acknowledges. A frame that is on the bus now may finish.
    Drop(Services),
    /// Drop the pending frames and run the controller at this bit rate, leaving bus-off if necessary, with the frames
    /// that the node [`receives`](crate::Node::receives).
    SetBitRate(BitRate),
    /// Run the controller silently at this bit rate: drop the pending frames and send no dominant bit, not even an
    /// acknowledge. Receive all frames, and report the first frame and the first error to
    /// [`handle_bus_event`](crate::Node::handle_bus_event).
    Listen(BitRate),
    /// Make these settings persistent, then call [`handle_stored`](crate::Node::handle_stored). A node with parameters
    /// also has [`write_parameters`](crate::Node::write_parameters).
    Store(Settings),
    /// Reset the device as after a power cut; the node restarts with the persistent settings.
    ResetDevice,
}

impl Action {
    /// Sends a frame of the SDO server.
    pub(super) const fn sdo(frame: Frame) -> Self {
        Self::Transmit(frame, Service::Sdo)
    }
}
