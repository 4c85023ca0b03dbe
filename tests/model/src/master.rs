//! The LSS master of the model, which follows CiA 305: it gives each LSS address its own node-ID.

use canopen_node::{BitRate, Frame, nmt};
use testkit::frames::{number, request};

use crate::board::address;

/// The master, between two frames.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Master {
    pub bit_rate: BitRate,
    pub task: Task,
    /// The first two bytes of the answer that the master waits for.
    pub awaited: Option<Awaited>,
    /// The number of node-IDs in use, for a master that hands them out in the order of finding.
    pub handed_out: Option<u8>,
}

/// A command specifier, and the error code that stands for success if the answer has one.
pub type Awaited = (u8, Option<u8>);

/// A procedure and the number of its next step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Task {
    Idle,
    /// Switch state selective.
    Select {
        board: usize,
        step: usize,
    },
    /// Fastscan, by a master that knows all but the two lowest bits of the serial number.
    Scan {
        step: usize,
        found: u32,
    },
    /// Configure the node-ID of the selected board and store it.
    Assign {
        board: usize,
        step: usize,
    },
    /// Configure, activate and store a bit rate for all boards.
    Switch {
        to: BitRate,
        step: usize,
    },
    /// Switch state global to waiting, at the end or after a failure.
    Leave,
    /// An NMT command to all nodes.
    Command(u8),
}

/// The node-ID that the master's table has for a board.
pub const fn node_id(board: usize) -> u8 {
    5 + board as u8
}

/// The switch delay: 10 ms.
const ACTIVATE: &str = "15 0A 00";
/// The serial number up to the two bits that Fastscan finds.
const SERIAL_NUMBER: u32 = address(0).serial_number;

impl Master {
    pub const fn new(bit_rate: BitRate) -> Self {
        Self { bit_rate, task: Task::Idle, awaited: None, handed_out: None }
    }

    /// The node-ID for the board: of the table, or the next one.
    fn node_id(&self, board: usize) -> u8 {
        self.handed_out.map_or(node_id(board), |count| node_id(count.into()))
    }

    /// Takes note that the next node-ID is in use.
    fn hand_out(&mut self) {
        self.handed_out = self.handed_out.map(|count| count + 1);
    }

    /// Receives a frame that is no LSS answer: a boot-up shows that a node-ID is in use.
    pub fn hear(&mut self, frame: &Frame) {
        if frame.cob_id() == nmt::ERROR_CONTROL_COB_ID + u16::from(self.node_id(0))
            && self.handed_out.is_some()
        {
            self.hand_out();
        }
    }

    /// The next frame and the answer to wait for.
    pub fn next_frame(&self) -> Option<(Frame, Option<Awaited>)> {
        let lss = |text: &str, awaited| Some((request(text), awaited));
        let part = |command: &str, value| request(&format!("{command} {}", number(value)));
        let scan = |value, bit, sub, next| {
            let text = format!("51 {} {bit:02X} {sub:02X} {next:02X}", number(value));
            Some((request(&text), Some((0x4F, None))))
        };
        let known = address(0);
        match self.task {
            Task::Idle => None,
            Task::Select { step: 0, .. } | Task::Scan { step: 0, .. } | Task::Leave => {
                lss("04 00", None)
            }
            Task::Select { step: 1, .. } => Some((part("40", known.vendor_id), None)),
            Task::Select { step: 2, .. } => Some((part("41", known.product_code), None)),
            Task::Select { step: 3, .. } => Some((part("42", known.revision_number), None)),
            Task::Select { board, .. } => {
                Some((part("43", address(board).serial_number), Some((0x44, None))))
            }
            Task::Scan { step: 1, .. } => scan(0, 0x80, 0, 0),
            Task::Scan { step: 2, .. } => scan(known.vendor_id, 0, 0, 1),
            Task::Scan { step: 3, .. } => scan(known.product_code, 0, 1, 2),
            Task::Scan { step: 4, .. } => scan(known.revision_number, 0, 2, 3),
            Task::Scan { step: 5, .. } => scan(SERIAL_NUMBER, 1, 3, 3),
            Task::Scan { step: 6, found } => scan(SERIAL_NUMBER + found, 0, 3, 3),
            Task::Scan { found, .. } => scan(SERIAL_NUMBER + found, 0, 3, 0),
            Task::Assign { board, step: 0 } => {
                lss(&format!("11 {:02X}", self.node_id(board)), Some((0x11, Some(0))))
            }
            Task::Assign { .. } | Task::Switch { step: 3, .. } => lss("17", Some((0x17, Some(0)))),
            Task::Switch { step: 0, .. } => lss("04 01", None),
            Task::Switch { to, step: 1 } => {
                lss(&format!("13 00 {:02X}", to.index()), Some((0x13, Some(0))))
            }
            Task::Switch { .. } => lss(ACTIVATE, None),
            Task::Command(command) => {
                let frame = Frame::new(nmt::COMMAND_COB_ID, &[command, 0]).expect("a frame");
                Some((frame, None))
            }
        }
    }

    /// Goes on after a frame that needs no answer, or a right answer.
    pub fn advance(&mut self) {
        self.awaited = None;
        if let Task::Assign { step: 1, .. } = self.task {
            self.hand_out();
        }
        self.task = match self.task {
            Task::Select { board, step: 4 } => Task::Assign { board, step: 0 },
            Task::Select { board, step } => Task::Select { board, step: step + 1 },
            // The final step, with the whole serial number.
            Task::Scan { step: 7, found } => Task::Assign { board: found as usize, step: 0 },
            Task::Scan { step, found } => Task::Scan { step: step + 1, found },
            Task::Assign { board, step: 0 } => Task::Assign { board, step: 1 },
            Task::Switch { to, step: 2 } => {
                self.bit_rate = to;
                Task::Switch { to, step: 3 }
            }
            Task::Switch { step: 3, .. } | Task::Assign { .. } => Task::Leave,
            Task::Switch { to, step } => Task::Switch { to, step: step + 1 },
            Task::Idle | Task::Leave | Task::Command(_) => Task::Idle,
        };
    }

    /// Goes on without an answer.
    pub fn give_up(&mut self) {
        self.awaited = None;
        self.task = match self.task {
            Task::Scan { step: 5, .. } => Task::Scan { step: 6, found: 2 },
            Task::Scan { step: 6, found } => Task::Scan { step: 7, found: found + 1 },
            Task::Scan { step: 1, .. } | Task::Leave | Task::Command(_) => Task::Idle,
            _ => Task::Leave,
        };
    }

    /// Takes a frame from a node, if it is one that the master waits for.
    pub fn receive(&mut self, frame: &Frame) {
        let [command, error, ..] = frame.padded_data();
        match self.awaited {
            Some((awaited, None)) if awaited == command => self.advance(),
            Some((awaited, Some(success))) if awaited == command => {
                if error == success {
                    self.advance()
                } else {
                    self.give_up()
                }
            }
            _ => {}
        }
    }

    /// The board that the master has just selected, if it has selected one.
    pub const fn selected(&self) -> Option<usize> {
        match self.task {
            Task::Assign { board, .. } => Some(board),
            _ => None,
        }
    }
}
