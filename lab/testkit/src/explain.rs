//! The meaning of a frame on the emulated bus in one sentence.

use emulator::can::{Frame, Id};

/// The meaning of `frame`, without its sender: a short sentence on one line.
pub fn explain(frame: &Frame) -> String {
    match frame.id {
        Id::Extended(_) => "29-bit identifier, not CANopen".into(),
        Id::Standard(_) if frame.remote => "remote frame".into(),
        Id::Standard(id) => can_bus::explain::explain(id, frame.payload()),
    }
}
