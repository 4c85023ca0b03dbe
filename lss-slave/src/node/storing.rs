//! Storing: one store at a time, for LSS or for a client of SDO, and who is answered when it has come to its end.

use crate::{BitRateSetting, NodeId, Settings, lss::StoreError};

/// The persistent settings, and the requests to change them.
#[derive(Clone, Debug)]
pub(super) struct Storing {
    persistent: Settings,
    store: Store,
    /// Store configuration requests of LSS that have not been answered.
    lss_requests: u8,
    /// A request by SDO whose store has not begun.
    sdo_request: Option<SdoRequest>,
}

#[derive(Clone, Copy, Debug)]
enum Store {
    Idle,
    Running(Settings, Requester),
    Done(Result<(), StoreError>, Requester),
}

/// Who waits for the outcome of a store.
#[derive(Clone, Copy, Debug)]
enum Requester {
    Lss,
    Sdo(Download),
    /// A client that was forgotten by a reset.
    Nobody,
}

/// The SDO download that a client waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Download {
    pub index: u16,
    pub sub_index: u8,
}

#[derive(Clone, Copy, Debug)]
struct SdoRequest {
    download: Download,
    /// What is to be stored: node-ID and bit rate belong to LSS and stay as they are.
    heartbeat_ms: u16,
}

/// A store by SDO waits already.
pub(super) struct Busy;

/// What the node does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Next {
    /// Makes these settings persistent.
    Store(Settings),
    AnswerLss(Result<(), StoreError>),
    AnswerSdo(Download, Result<(), StoreError>),
}

impl Storing {
    pub const fn new(persistent: Settings) -> Self {
        Self { persistent, store: Store::Idle, lss_requests: 0, sdo_request: None }
    }

    /// The settings that are persistent.
    pub const fn persistent(&self) -> &Settings {
        &self.persistent
    }

    /// LSS asks for a store of the pending node-ID and bit rate.
    pub const fn request_by_lss(&mut self) {
        self.lss_requests = self.lss_requests.saturating_add(1);
    }

    /// A client asks for a store of this heartbeat time.
    ///
    /// # Errors
    /// [`Busy`] while the store of an earlier request has not begun.
    pub fn request_by_sdo(&mut self, download: Download, heartbeat_ms: u16) -> Result<(), Busy> {
        if self.sdo_request.is_some() {
            return Err(Busy);
        }
        self.sdo_request = Some(SdoRequest { download, heartbeat_ms });
        Ok(())
    }

    /// Ends the waiting of whoever asked by SDO; a store that runs goes on.
    pub const fn forget_sdo(&mut self) {
        self.sdo_request = None;
        if let Store::Running(_, requester) | Store::Done(_, requester) = &mut self.store
            && let Requester::Sdo(..) = requester
        {
            *requester = Requester::Nobody;
        }
    }

    /// Takes the outcome of the store that runs; returns whether there is one.
    pub const fn handle_stored(&mut self, outcome: Result<(), StoreError>) -> bool {
        let Store::Running(settings, requester) = self.store else {
            return false;
        };
        if outcome.is_ok() {
            self.persistent = settings;
        }
        self.store = Store::Done(outcome, requester);
        true
    }

    /// Begins the next store, or answers the one that has come to its end.
    pub fn poll(&mut self, node_id: Option<NodeId>, bit_rate: BitRateSetting) -> Option<Next> {
        if let Store::Running(..) = self.store {
            return None;
        }
        if let Store::Done(outcome, requester) = self.store {
            self.store = Store::Idle;
            match requester {
                Requester::Lss => {
                    self.lss_requests = self.lss_requests.saturating_sub(1);
                    return Some(Next::AnswerLss(outcome));
                }
                Requester::Sdo(download) => return Some(Next::AnswerSdo(download, outcome)),
                Requester::Nobody => {}
            }
        }
        let (settings, requester) = if self.lss_requests > 0 {
            (Settings { node_id, bit_rate, ..self.persistent }, Requester::Lss)
        } else {
            let SdoRequest { download, heartbeat_ms } = self.sdo_request.take()?;
            (Settings { heartbeat_ms, ..self.persistent }, Requester::Sdo(download))
        };
        self.store = Store::Running(settings, requester);
        Some(Next::Store(settings))
    }
}
