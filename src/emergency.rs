//! Emergency messages (CiA 301, 7.2.7): what the node tells of its own troubles.

use crate::{Frame, NodeId};

/// The COB-ID of emergency messages is this plus the node-ID.
pub const COB_ID: u16 = 0x080;

/// A trouble that the board has seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Fault {
    /// 8140h: the controller was bus-off and takes part in the bus again.
    BusOffRecovered = 1 << 0,
    /// 8110h: the controller received frames faster than they were taken.
    Overrun = 1 << 1,
    /// 6310h: the stored settings were damaged and the defaults are in use, until something is stored.
    SettingsLost = 1 << 2,
}

/// What is still to be told, and what is still wrong.
#[derive(Clone, Debug)]
pub(crate) struct Emergency {
    untold: u8,
    are_settings_lost: bool,
    bus_offs: u16,
    overruns: u16,
}

/// Not a fault but the end of all: error code 0.
const ALL_IS_WELL: u8 = 1 << 3;

/// Error register 1001h: bit 0 any error, bit 4 communication error.
const GENERIC: u8 = 0x01;
const COMMUNICATION: u8 = 0x10;

/// What is told first comes first: the bit of `untold`, the error code, the error register.
const MESSAGES: &[(u8, u16, u8)] = &[
    (Fault::SettingsLost as u8, 0x6310, GENERIC),
    (Fault::BusOffRecovered as u8, 0x8140, GENERIC | COMMUNICATION),
    (Fault::Overrun as u8, 0x8110, GENERIC | COMMUNICATION),
    (ALL_IS_WELL, 0x0000, 0),
];

impl Emergency {
    pub const fn new() -> Self {
        Self { untold: 0, are_settings_lost: false, bus_offs: 0, overruns: 0 }
    }

    pub const fn report(&mut self, fault: Fault) {
        self.untold |= fault as u8;
        // All but lost settings is over by the time it is known.
        match fault {
            Fault::SettingsLost => self.are_settings_lost = true,
            Fault::BusOffRecovered => {
                self.untold |= ALL_IS_WELL;
                self.bus_offs = self.bus_offs.saturating_add(1);
            }
            Fault::Overrun => {
                self.untold |= ALL_IS_WELL;
                self.overruns = self.overruns.saturating_add(1);
            }
        }
    }

    /// How often [`Fault::BusOffRecovered`] was reported.
    pub const fn bus_offs(&self) -> u16 {
        self.bus_offs
    }

    /// How often [`Fault::Overrun`] was reported.
    pub const fn overruns(&self) -> u16 {
        self.overruns
    }

    pub const fn settings_are_stored(&mut self) {
        if self.are_settings_lost {
            self.are_settings_lost = false;
            self.untold |= ALL_IS_WELL;
        }
    }

    /// The error register 1001h.
    pub const fn error_register(&self) -> u8 {
        if self.are_settings_lost { GENERIC } else { 0 }
    }

    /// The next message, if there is anything to tell.
    pub fn next(&mut self, node: NodeId) -> Option<Frame> {
        let lasting = self.error_register();
        let (bit, code, register) = *MESSAGES.iter().find(|(bit, ..)| self.untold & bit != 0)?;
        self.untold &= !bit;
        if bit == ALL_IS_WELL && lasting != 0 {
            return None;
        }
        let [low, high] = code.to_le_bytes();
        let data = [low, high, register | lasting, 0, 0, 0, 0, 0];
        Some(Frame::with_eight_bytes(COB_ID + u16::from(node.get()), data))
    }
}
