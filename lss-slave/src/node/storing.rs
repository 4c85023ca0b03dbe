//! How the node stores: one store at a time, for LSS or for a client of SDO, and the answer when it has come to its end.

use super::{Action, Due, Node};
use crate::{
    Settings,
    emergency::Fault,
    lss::{Response, StoreError},
    object_dictionary::Entry,
    sdo::{self, Abort, Written},
};

#[derive(Clone, Copy, Debug)]
pub(super) enum Store {
    Idle,
    Running(Settings, Requester),
    Done(Result<(), StoreError>, Requester),
}

/// Who waits for the outcome of a store.
#[derive(Clone, Copy, Debug)]
pub(super) enum Requester {
    Lss,
    /// A client that wrote to this index and sub-index.
    Sdo(u16, u8),
    /// A client that was forgotten by a reset.
    Nobody,
}

impl Node {
    /// Takes the outcome of the last [`Action::Store`].
    pub fn handle_stored(&mut self, outcome: Result<(), StoreError>) {
        if let Store::Running(settings, requester) = self.store {
            if outcome.is_ok() {
                self.persistent = settings;
                self.emergency.end(Fault::SettingsLost);
            }
            self.store = Store::Done(outcome, requester);
            self.due = Due::Now;
        }
    }

    /// Whoever waits for a store by SDO waits no longer; a store that runs goes on.
    pub(super) fn forget_sdo_store(&mut self) {
        self.sdo_store = None;
        if let Store::Running(_, requester) | Store::Done(_, requester) = &mut self.store
            && let Requester::Sdo(..) = requester
        {
            *requester = Requester::Nobody;
        }
    }

    /// One store at a time: begins the next, or answers the one that has come to its end.
    pub(super) fn store_or_answer(&mut self) -> Option<Action> {
        match self.store {
            Store::Running(..) => None,
            Store::Done(outcome, requester) => {
                self.store = Store::Idle;
                match requester {
                    Requester::Lss => {
                        self.lss_stores = self.lss_stores.saturating_sub(1);
                        Some(Action::Transmit(Response::StoreConfiguration(outcome).to_frame()))
                    }
                    Requester::Sdo(index, sub_index) if self.serves_sdo() => {
                        let answer = match outcome {
                            Ok(()) => sdo::confirm(index, sub_index),
                            Err(_) => sdo::abort(index, sub_index, sdo::Abort::Hardware),
                        };
                        self.answer_sdo(answer)
                    }
                    Requester::Sdo(..) | Requester::Nobody => self.store_or_answer(),
                }
            }
            Store::Idle => {
                let (settings, requester) = if self.lss_stores > 0 {
                    let settings = Settings {
                        node_id: self.lss.pending_node_id(),
                        bit_rate: self.lss.pending_bit_rate(),
                        ..self.persistent
                    };
                    (settings, Requester::Lss)
                } else {
                    let (index, sub_index, heartbeat_ms) = self.sdo_store.take()?;
                    let settings = Settings { heartbeat_ms, ..self.persistent };
                    (settings, Requester::Sdo(index, sub_index))
                };
                self.store = Store::Running(settings, requester);
                Some(Action::Store(settings))
            }
        }
    }

    /// What is stored by SDO is the heartbeat time; node-ID and bit rate belong to LSS and stay as they are.
    pub(super) fn request_store(
        &mut self,
        entry: &Entry,
        heartbeat_ms: u16,
    ) -> Result<Written, Abort> {
        if self.sdo_store.is_some() {
            return Err(Abort::Busy);
        }
        self.sdo_store = Some((entry.index, entry.sub_index, heartbeat_ms));
        Ok(Written::Later)
    }
}
