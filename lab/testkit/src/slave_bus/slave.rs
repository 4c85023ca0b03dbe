//! A slave on the bus within the process, and what it does otherwise than a board of ours.

use std::ops::Range;

use canopen_node::{Application, Frame, application::NoApplication};

use super::{NEVER, defect::Defect};
use crate::node_rig::NodeRig;

/// How a slave treats LSS requests. Times are in microseconds.
#[derive(Clone, Debug)]
pub struct Habits {
    /// The time to an answer.
    pub answer_us: Range<u64>,
    /// The time between two looks at the one frame that it holds; others that come until then are lost. 0: it takes
    /// each frame at once.
    pub poll_us: u64,
    /// Whether it misses a request that comes in the time to the answer to the last one.
    pub loses_requests: bool,
    /// The number of the tool's frames after which it has no connection.
    pub leaves_after: u64,
    /// The command specifiers that it does not know.
    pub without: &'static [u8],
    /// The time to the same answer once more; 0: none.
    pub again_us: u64,
    /// The time that a store takes.
    pub store_us: u64,
    /// The NMT state in its boot-up message; 0 is right.
    pub boot_up: u8,
    /// The time to any frame but an LSS answer; empty: none.
    pub other_us: Range<u64>,
    /// Whether it answers each question of Fastscan and of identify remote slave.
    pub claims_all: bool,
    /// The bytes of its LSS answers; 8 are right.
    pub answer_bytes: usize,
}

impl Default for Habits {
    /// Those of a board of ours.
    fn default() -> Self {
        Self {
            answer_us: 100..300,
            poll_us: 0,
            loses_requests: false,
            leaves_after: u64::MAX,
            without: &[],
            again_us: 0,
            store_us: 1_000,
            boot_up: 0,
            other_us: 0..0,
            claims_all: false,
            answer_bytes: 8,
        }
    }
}

/// Something that happens to a slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Happening {
    PowerOff,
    PowerOn,
    /// It loses the connection to the bus, and its power stays.
    PullOut,
    PlugIn,
}

/// A slave on the bus.
pub struct Slave<A: Application = NoApplication> {
    pub rig: NodeRig<A>,
    pub habits: Habits,
    pub defect: Option<Defect>,
    pub is_powered: bool,
    pub is_connected: bool,
    /// The frame that waits for the next look.
    pub(super) held: Option<(u64, Frame)>,
    /// The end of the store in progress.
    pub(super) stored_at: u64,
    pub(super) last_answer: u64,
    /// The time of the answer to the last request, if it has one.
    pub(super) ready_at: u64,
    /// The time of the next call.
    pub(super) due: u64,
}

impl<A: Application + Clone> Slave<A> {
    pub(super) fn new(mut rig: NodeRig<A>, habits: Habits) -> Self {
        rig.let_stores_take_time();
        Self {
            rig,
            habits,
            defect: None,
            is_powered: true,
            is_connected: true,
            held: None,
            stored_at: NEVER,
            last_answer: 0,
            ready_at: 0,
            due: 0,
        }
    }

    /// Lets the slave's time pass until `now`.
    pub(super) fn catch_up(&mut self, now: u64) {
        self.rig.pass_us(now.saturating_sub(self.rig.now()));
    }
}
