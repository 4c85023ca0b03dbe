//! Storing: one store at a time, for LSS or an SDO client, the answer when it has ended, and its effect on the stored
//! parameters: the areas of the dictionary that 1010h and 1011h concern.

use crate::{
    BitRateSetting, NodeId, Settings,
    application::Dictionary,
    lss::StoreError,
    object_dictionary::{self, Entry, Object},
    sdo::Message,
    settings::parameters::{self, Packer, Parameter},
};

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
            (self.persistent.with_node_id(node_id).with_bit_rate(bit_rate), Requester::Lss)
        } else {
            let SdoRequest { download, mut heartbeat_ms } = self.sdo_request.take()?;
            if !Area::Communication.is_concerned(download.sub_index) {
                heartbeat_ms = self.persistent.heartbeat_ms;
            }
            (self.persistent.with_heartbeat_ms(heartbeat_ms), Requester::Sdo(download))
        };
        self.store = Store::Running(settings, requester);
        Some(Next::Store(settings))
    }
}

/// An area of the dictionary that is stored and restored apart from the other (CiA 301, objects 1010h and 1011h).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Area {
    /// The objects 1000h to 1FFFh.
    Communication,
    /// The objects 2000h to 9FFFh.
    Application,
}

/// The effect of a store on the stored values of an area.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    Keep,
    /// Replaces them by the current values.
    Renew,
    /// Removes them, so that the defaults apply from the next start on.
    Remove,
}

impl Area {
    pub const ALL: [Self; 2] = [Self::Communication, Self::Application];
    const RESTORE: u16 = 0x1011;

    /// The area of the object with this index.
    pub const fn of(index: u16) -> Self {
        if index < 0x2000 { Self::Communication } else { Self::Application }
    }

    /// Whether a write to this sub-index of 1010h or 1011h concerns the area.
    pub const fn is_concerned(self, sub_index: u8) -> bool {
        match sub_index {
            2 => matches!(self, Self::Communication),
            3 => matches!(self, Self::Application),
            _ => true,
        }
    }

    /// The effect on the area of a store for this client, or for LSS if there is none.
    pub fn change(self, client: Option<Download>) -> Change {
        match client {
            Some(Download { index, sub_index, .. }) if self.is_concerned(sub_index) => {
                if index == Self::RESTORE { Change::Remove } else { Change::Renew }
            }
            _ => Change::Keep,
        }
    }

    /// Packs the parameters of this area that are among the `persistent` ones.
    pub fn keep(self, persistent: &[u8], to: &mut Packer<'_>) {
        parameters::unpack(persistent)
            .filter(|parameter| Self::of(parameter.index) == self)
            .for_each(|parameter| to.put(&parameter));
    }
}

/// Packs the current values of the application that are stored.
pub(super) fn save<A: Dictionary>(application: &A, to: &mut Packer<'_>) {
    let stored = A::OBJECTS.iter().filter(|entry| entry.options.is_stored());
    for Entry { index, sub_index, data_type, object, .. } in stored {
        if let Object::Application(field) = *object {
            let place = to.reserve(*index, *sub_index, *data_type as u8, application.len(field));
            application.read(field, 0, place);
        }
    }
}

/// Takes a stored value, if the application has it with this data type and the value is legal; returns whether it has.
pub(super) fn restore<A: Dictionary>(application: &mut A, parameter: &Parameter<'_>) -> bool {
    let Parameter { index, sub_index, data_type, value } = *parameter;
    let Ok(entry) = object_dictionary::find(A::OBJECTS, index, sub_index) else {
        return false;
    };
    let Object::Application(field) = entry.object else {
        return false;
    };
    let is_stored = entry.options.is_stored() && entry.data_type as u8 == data_type;
    match A::parse(field, value) {
        Ok(value) if is_stored => {
            application.set(value);
            true
        }
        _ => false,
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
