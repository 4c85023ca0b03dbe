//! What an application that commands its network hears.

use crate::{
    Application, Frame, Instant, NodeId,
    application::Event,
    lss::{self, StoreError},
};

/// An application that is the LSS master of its network. Its `hear` and `handle` pass all to the [`Inbox`].
pub trait Master: Application {
    /// What has come for the master.
    fn inbox(&mut self) -> &mut Inbox;
}

/// What has come for the master of a network: the answer to an LSS request, the outcome of a store, and who is there.
#[derive(Clone, Debug)]
pub struct Inbox {
    answer: Option<(Frame, Instant)>,
    stored: Option<Result<(), StoreError>>,
    /// A bit for each node-ID.
    nodes: u128,
    has_rival: bool,
}

impl Inbox {
    /// Nothing has come.
    pub const EMPTY: Self = Self { answer: None, stored: None, nodes: 0, has_rival: false };

    /// Takes a frame that the application [hears](Application::hear): an LSS answer, an LSS request of another master, or
    /// a sign of a node in the predefined connection set (emergency, TPDO 1, SDO answer, heartbeat or boot-up).
    pub fn hear(&mut self, frame: &Frame, now: Instant) {
        match frame.cob_id() {
            lss::RESPONSE_COB_ID => self.answer = Some((*frame, now)),
            lss::REQUEST_COB_ID => self.has_rival = true,
            cob_id @ (0x081..=0x0FF | 0x181..=0x1FF | 0x581..=0x5FF | 0x701..=0x77F) => {
                self.nodes |= 1 << (cob_id & 0x7F);
            }
            _ => {}
        }
    }

    /// Takes an event that the application [handles](Application::handle): the end of a store.
    pub const fn handle(&mut self, event: Event) {
        if let Event::Stored(outcome) = event {
            self.stored = Some(outcome);
        }
    }

    /// Whether an answer waits.
    pub const fn has_answer(&self) -> bool {
        self.answer.is_some()
    }

    /// The last LSS answer, and when it came.
    pub const fn take_answer(&mut self) -> Option<(Frame, Instant)> {
        self.answer.take()
    }

    /// The outcome of the last store.
    pub const fn take_stored(&mut self) -> Option<Result<(), StoreError>> {
        self.stored.take()
    }

    /// Whether this node was heard since the last call of [`forget`](Self::forget).
    pub const fn has_heard(&self, node: NodeId) -> bool {
        self.nodes >> (node.get() & 0x7F) & 1 == 1
    }

    /// Whether another LSS master was heard since then.
    pub const fn has_rival(&self) -> bool {
        self.has_rival
    }

    /// Forgets which nodes and whether another master were heard.
    pub const fn forget(&mut self) {
        (self.nodes, self.has_rival) = (0, false);
    }
}
