//! Storing: one store at a time, for LSS or an SDO client, and the answer when it has ended.

use super::parameters::Part;
use crate::{BitRateSetting, NodeId, Settings, lss::StoreError, sdo::Message};

/// The persistent settings, and the requests to change them.
#[derive(Clone, Debug)]
pub(super) struct Storing {
    persistent: Settings,
    store: Store,
    /// LSS store configuration requests that have not been answered.
    lss_requests: u8,
    /// An SDO request whose store has not begun.
    sdo_request: Option<SdoRequest>,
}

#[derive(Clone, Copy, Debug)]
enum Store {
    Idle,
    Running(Settings, Requester),
    Done(Result<(), StoreError>, Requester),
}

/// The requester that waits for the outcome of a store.
#[derive(Clone, Copy, Debug)]
enum Requester {
    Lss,
    Sdo(Download),
    /// An SDO client that a reset or its abort has cancelled.
    Nobody(Download),
}

/// The SDO download that a client waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Download {
    pub index: u16,
    pub sub_index: u8,
    /// The answer to the client when the values are stored.
    pub confirmation: Message,
}

#[derive(Clone, Copy, Debug)]
struct SdoRequest {
    download: Download,
    /// The heartbeat time to store, if the download concerns it. Node-ID and bit rate belong to LSS and stay unchanged.
    heartbeat_ms: u16,
}

/// Another SDO store is already waiting.
pub(super) struct Busy;

/// The node's next step.
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

    /// The persistent settings.
    pub const fn persistent(&self) -> &Settings {
        &self.persistent
    }

    /// Requests a store of the pending node-ID and bit rate, for LSS.
    pub const fn request_by_lss(&mut self) {
        self.lss_requests = self.lss_requests.saturating_add(1);
    }

    /// Requests a store of this heartbeat time, for an SDO client.
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

    /// Cancels the SDO client's request; a store in progress continues.
    pub const fn forget_sdo(&mut self) {
        self.sdo_request = None;
        if let Store::Running(_, requester) | Store::Done(_, requester) = &mut self.store
            && let Requester::Sdo(download) = *requester
        {
            *requester = Requester::Nobody(download);
        }
    }

    /// The SDO download that the store in progress carries out; `None` for one for LSS.
    pub const fn download(&self) -> Option<Download> {
        match self.store {
            Store::Running(_, Requester::Sdo(download) | Requester::Nobody(download)) => {
                Some(download)
            }
            _ => None,
        }
    }

    /// Records the outcome of the store in progress; returns whether there was one.
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

    /// Begins the next store, or answers the one that has ended.
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
                Requester::Nobody(_) => {}
            }
        }
        let (settings, requester) = if self.lss_requests > 0 {
            (Settings { node_id, bit_rate, ..self.persistent }, Requester::Lss)
        } else {
            let SdoRequest { download, mut heartbeat_ms } = self.sdo_request.take()?;
            if !Part::Communication.is_concerned(download.sub_index) {
                heartbeat_ms = self.persistent.heartbeat_ms;
            }
            (Settings { heartbeat_ms, ..self.persistent }, Requester::Sdo(download))
        };
        self.store = Store::Running(settings, requester);
        Some(Next::Store(settings))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::BitRate;

    const SETTINGS: Settings = Settings::new(BitRateSetting::Automatic);
    const SAVE: Download = Download {
        index: 0x1010,
        sub_index: 1,
        confirmation: Message::from_bytes([0x60, 0x10, 0x10, 1, 0, 0, 0, 0]),
    };
    const PENDING: BitRateSetting = BitRateSetting::Fixed(BitRate::Kbit500);

    fn poll(storing: &mut Storing) -> Option<Next> {
        storing.poll(NodeId::new(5), PENDING)
    }

    #[test]
    fn stores_of_lss_and_sdo_run_one_after_another() {
        let mut storing = Storing::new(SETTINGS);
        assert!(storing.request_by_sdo(SAVE, 1000).is_ok());
        storing.request_by_lss();
        let of_lss = SETTINGS.with_node_id(NodeId::new(5)).with_bit_rate(PENDING);
        assert_eq!(poll(&mut storing), Some(Next::Store(of_lss)));
        assert_eq!(poll(&mut storing), None, "it runs");
        assert!(storing.handle_stored(Ok(())));
        assert_eq!(poll(&mut storing), Some(Next::AnswerLss(Ok(()))));
        let both = of_lss.with_heartbeat_ms(1000);
        assert_eq!(poll(&mut storing), Some(Next::Store(both)));
        assert!(storing.handle_stored(Ok(())));
        assert_eq!(poll(&mut storing), Some(Next::AnswerSdo(SAVE, Ok(()))));
        assert_eq!((poll(&mut storing), *storing.persistent()), (None, both));
    }

    #[test]
    fn a_store_that_fails_leaves_the_persistent_settings() {
        let mut storing = Storing::new(SETTINGS);
        storing.request_by_lss();
        let _ = poll(&mut storing);
        assert!(storing.handle_stored(Err(StoreError::MediumAccess)));
        let answer = Next::AnswerLss(Err(StoreError::MediumAccess));
        assert_eq!((poll(&mut storing), *storing.persistent()), (Some(answer), SETTINGS));
    }

    #[test]
    fn a_client_that_was_forgotten_is_not_answered() {
        let mut storing = Storing::new(SETTINGS);
        assert!(storing.request_by_sdo(SAVE, 1000).is_ok());
        let _ = poll(&mut storing);
        storing.forget_sdo();
        assert!(storing.handle_stored(Ok(())));
        assert_eq!(poll(&mut storing), None);
        assert_eq!(storing.persistent().heartbeat_ms, 1000);
    }

    #[test]
    fn an_outcome_without_a_store_is_ignored() {
        assert!(!Storing::new(SETTINGS).handle_stored(Ok(())));
    }
}
