//! The COB-IDs by which a node tells a master's frames and boot-ups from others (CiA 301, predefined connection set).

/// The COB-ID of NMT commands (CiA 301, NMT module control).
pub const NMT_COMMAND: u16 = 0x000;
/// The COB-ID of SYNC in a new device (CiA 301, object 1005h).
pub const SYNC: u16 = 0x080;
/// The base COB-ID of emergency messages, to which the node-ID is added.
pub const EMERGENCY: u16 = 0x080;
/// The base COB-ID of SDO requests, to which the node-ID is added.
pub const SDO_REQUEST: u16 = 0x600;
/// The base COB-ID of boot-up and heartbeat, to which the node-ID is added (CiA 301, NMT error control).
pub const ERROR_CONTROL: u16 = 0x700;
