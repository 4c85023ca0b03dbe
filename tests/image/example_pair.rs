//! The example `io` and the node in the process with the same content of the flash, asked the same.

use std::ops::RangeInclusive;

use canopen_node::{BitRate, Frame};
use emulator::{Time, board::Board, chip::Part};
use example_io::application as io;
use testkit::{
    flash::BoardFlash,
    frames,
    image::example,
    image_rig::{ImageRig, SETTINGS_OFFSET, flash_with, settings},
    node_rig::{self, NodeRig},
};

pub const NODE_ID: u8 = 0x40;

pub type Model = NodeRig<io::Application, { io::TPDOS }, { io::RPDOS }, { io::PRODUCERS }>;

/// The board and its model.
pub struct Pair {
    pub rig: ImageRig,
    pub model: Model,
}

/// A board with this content of its settings' flash.
pub fn rig(content: &[u8]) -> ImageRig {
    let mut board = Board::new(Part::Stm32f407, example(), Default::default());
    board.set_flash(SETTINGS_OFFSET, content);
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    rig.collect(Time::from_ms(50));
    rig
}

impl Pair {
    pub fn new() -> Self {
        Self::with(&flash_with(&[settings(NODE_ID, BitRate::Kbit1000)]))
    }

    /// Both with this content of their settings' flash.
    pub fn with(content: &[u8]) -> Self {
        let device = node_rig::device(node_rig::ADDRESS)
            .with_name("LSS slave")
            .with_versions("1.0", "0.1.0")
            .with_defaults(settings(0xFF, BitRate::Kbit1000).with_heartbeat_ms(1000));
        let flash = BoardFlash::with_content(content.to_vec(), 0);
        let mut model = NodeRig::with_application(device, flash, 0, io::Application::new());
        model.take_actions();
        Self { rig: rig(content), model }
    }

    /// Sends a request to both, and compares what their SDO servers answer.
    pub fn ask(&mut self, request: [u8; 8]) {
        let frame = Frame::new(0x600 + u16::from(NODE_ID), &request).expect("a frame");
        self.exchange(&frame, 0x580 + u16::from(NODE_ID)..=0x580 + u16::from(NODE_ID));
    }

    /// Sends a frame to both, and compares what they answer with one of these COB-IDs; returns the number of answers.
    pub fn exchange(&mut self, frame: &Frame, cob_ids: RangeInclusive<u16>) -> usize {
        let is_answer = |answer: &&Frame| cob_ids.contains(&answer.cob_id());
        let expected: Vec<Frame> =
            self.model.receive(frame).0.iter().filter(is_answer).copied().collect();
        self.rig.queue(frame);
        let span = Time::from_us(600) + Time::from_us(150) * expected.len() as u64;
        let mut sent: Vec<Frame> =
            self.rig.collect(span).0.iter().filter(is_answer).copied().collect();
        while sent.len() < expected.len() {
            let (_, more) = self.rig.next_frame();
            assert!(!more.0.is_empty(), "{frame:?}: {sent:?}, not {expected:?}");
            sent.extend(more.0.iter().filter(is_answer));
        }
        assert_eq!(sent, expected, "{frame:?}");
        sent.len()
    }

    /// Sends a request, padded with 0 to eight bytes, to both.
    pub fn say(&mut self, text: &str) {
        let mut request = frames::bytes(text);
        request.resize(8, 0);
        self.ask(request.try_into().expect("eight bytes"));
    }
}

/// A message with an address and a number.
pub fn message(command: u8, index: u16, sub_index: u8, value: u32) -> [u8; 8] {
    let ([i0, i1], [d0, d1, d2, d3]) = (index.to_le_bytes(), value.to_le_bytes());
    [command, i0, i1, sub_index, d0, d1, d2, d3]
}
