//! NMT (CiA 301): the NMT state, the commands that change it, boot-up and heartbeat.

mod producer;
pub(crate) mod slave;

#[doc(inline)]
pub use lss_slave::cob_id::{ERROR_CONTROL as ERROR_CONTROL_COB_ID, NMT_COMMAND as COMMAND_COB_ID};

use crate::{Frame, NodeId};

/// An NMT state; the value is the one in a heartbeat (CiA 301).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum State {
    /// The node has no node-ID yet or has not sent its boot-up. The boot-up carries this value.
    Initialisation = 0x00,
    /// Only LSS and NMT are served.
    Stopped = 0x04,
    /// All services are served.
    Operational = 0x05,
    /// All services but process data are served.
    PreOperational = 0x7F,
}

/// An NMT command (CiA 301, NMT module control).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Command {
    /// 1: enter [`State::Operational`].
    Start,
    /// 2: enter [`State::Stopped`].
    Stop,
    /// 128: enter [`State::PreOperational`].
    EnterPreOperational,
    /// 129: restart as after power-on.
    ResetNode,
    /// 130: restart communication with the pending node-ID.
    ResetCommunication,
}

impl Command {
    /// The command in `frame`, if there is one for the node `own` or for all nodes (node 0).
    pub fn from_frame(frame: &Frame, own: Option<NodeId>) -> Option<Self> {
        let &[command, addressee] = frame.data() else {
            return None;
        };
        if addressee != 0 && own.map(NodeId::get) != Some(addressee) {
            return None;
        }
        match command {
            1 => Some(Self::Start),
            2 => Some(Self::Stop),
            128 => Some(Self::EnterPreOperational),
            129 => Some(Self::ResetNode),
            130 => Some(Self::ResetCommunication),
            _ => None,
        }
    }

    /// Whether the command is one of the two resets.
    pub const fn is_reset(self) -> bool {
        matches!(self, Self::ResetNode | Self::ResetCommunication)
    }
}

/// The effect of a communication error on the NMT state: 1029h sub-index 1 (CiA 301).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum ErrorBehaviour {
    /// Enter [`State::PreOperational`], but only from [`State::Operational`].
    EnterPreOperational = 0,
    /// Change nothing.
    KeepState = 1,
    /// Enter [`State::Stopped`].
    EnterStopped = 2,
}

impl ErrorBehaviour {
    /// The behaviour of a device whose application declares no other.
    pub(crate) const DEFAULT: Self = Self::EnterPreOperational;
    pub(crate) const fn new(value: u8) -> Option<Self> {
        match value {
            0 => Some(Self::EnterPreOperational),
            1 => Some(Self::KeepState),
            2 => Some(Self::EnterStopped),
            _ => None,
        }
    }
}

/// The frame that reports the state of `node`: a heartbeat, or the boot-up in [`State::Initialisation`].
pub(crate) const fn error_control(node: NodeId, state: State) -> Frame {
    Frame::with_one_byte(ERROR_CONTROL_COB_ID + node.get() as u16, state as u8)
}
