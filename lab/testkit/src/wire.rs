//! Frames and bit rates of the libraries, as the emulated bus has them.

use canopen_node::BitRate;
use emulator::can::{Frame, Id};

/// A bit rate in bits a second.
pub fn bit_per_s(bit_rate: BitRate) -> u32 {
    u32::from(bit_rate.kbit_per_s()) * 1000
}

/// The bus frame for a frame of the library.
pub fn on_the_wire(frame: &canopen_node::Frame) -> Frame {
    Frame::data(Id::Standard(frame.cob_id()), frame.data())
}

/// The frame of the library for a bus frame, if a driver passes it on.
pub fn from_the_wire(frame: &Frame) -> Option<canopen_node::Frame> {
    match frame.id {
        Id::Standard(id) if !frame.remote && frame.dlc <= 8 => {
            canopen_node::Frame::new(id, frame.payload())
        }
        _ => None,
    }
}
