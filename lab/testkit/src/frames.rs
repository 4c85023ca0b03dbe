//! Frames as text, in the notation of the CANopen manuals: `704: 00`, or just `04 01` where the COB-ID is obvious.

use std::fmt;

use canopen_node::{Frame, lss, nmt};

/// The expected frames if nothing may be sent.
pub const SILENCE: [&str; 0] = [];

/// A request of the LSS master: `text` is its bytes, padded with 0 to eight.
pub fn request(text: &str) -> Frame {
    padded(lss::REQUEST_COB_ID, text)
}

/// An NMT command: `text` is its bytes.
pub fn command(text: &str) -> Frame {
    Frame::new(nmt::COMMAND_COB_ID, &bytes(text)).expect("a frame")
}

/// A frame of no use to the node.
pub fn stranger() -> Frame {
    Frame::new(0x181, &[1, 2, 3]).expect("a frame")
}

/// A frame of the master: an LSS request, unless `text` names another COB-ID before a colon.
pub fn of_master(text: &str) -> Frame {
    frame(text, lss::REQUEST_COB_ID)
}

/// A frame of a node: an LSS answer, unless `text` names another COB-ID before a colon.
pub fn of_node(text: &str) -> Frame {
    frame(text, lss::RESPONSE_COB_ID)
}

fn frame(text: &str, lss_cob_id: u16) -> Frame {
    match text.split_once(": ") {
        None => padded(lss_cob_id, text),
        Some((cob_id, text)) => {
            let cob_id = u16::from_str_radix(cob_id, 16).expect("a COB-ID");
            Frame::new(cob_id, &bytes(text)).expect("a frame")
        }
    }
}

fn padded(cob_id: u16, text: &str) -> Frame {
    let mut bytes = bytes(text);
    bytes.resize(8, 0);
    Frame::new(cob_id, &bytes).expect("a frame")
}

/// The bytes of `text`, in hexadecimal.
pub fn bytes(text: &str) -> Vec<u8> {
    text.split_whitespace().map(|byte| u8::from_str_radix(byte, 16).expect("hex")).collect()
}

/// A 32-bit number as the four bytes of a message, little endian.
pub fn number(number: u32) -> String {
    let [a, b, c, d] = number.to_le_bytes();
    format!("{a:02X} {b:02X} {c:02X} {d:02X}")
}

/// The text of `frame`, with all of its bytes.
pub fn text(frame: &Frame) -> String {
    let bytes: String = frame.data().iter().map(|byte| format!(" {byte:02X}")).collect();
    format!("{:03X}:{bytes}", frame.cob_id())
}

/// The frames that a node has sent, comparable with their text: `[]`, `["5E 40", "704: 00"]`.
#[derive(Clone, PartialEq, Eq)]
pub struct Frames(pub Vec<Frame>);

impl Frames {
    /// The texts of the frames.
    pub fn texts(&self) -> Vec<String> {
        self.0.iter().map(text).collect()
    }
}

impl<const N: usize> PartialEq<[&str; N]> for Frames {
    fn eq(&self, texts: &[&str; N]) -> bool {
        *self == texts.as_slice()
    }
}

impl PartialEq<&[&str]> for Frames {
    fn eq(&self, texts: &&[&str]) -> bool {
        self.0.iter().copied().eq(texts.iter().map(|text| of_node(text)))
    }
}

impl fmt::Debug for Frames {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.0.iter().map(text)).finish()
    }
}
