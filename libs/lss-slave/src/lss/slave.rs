//! The LSS slave's state machine (CiA 305): the effect of each request in LSS waiting and LSS configuration state. Below
//! it are the messages: requests and answers as legal values, and the eight bytes of a frame.

use core::{error, fmt, mem};

use Response::*;

use super::{Address, AddressPart, REQUEST_COB_ID, RESPONSE_COB_ID};
use crate::{BitRateSetting, BitRates, Frame, NodeId, settings};

/// The LSS state, which is independent of the NMT state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum State {
    /// LSS waiting state: only the services that find or select a slave are available.
    Waiting,
    /// LSS configuration state: the slave can be configured and queried.
    Configuration,
}

/// The reaction to a request, for the node to carry out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[must_use]
pub enum Reaction {
    /// Send this answer.
    Answer(Frame),
    /// Switch to the pending bit rate after the switch delay in milliseconds, without sending a frame in between: 15h.
    /// [`Control::switch`](crate::bit_rate::Control::switch) does it.
    ActivateBitTiming(u16),
    /// Make the pending node-ID and bit rate persistent, then answer.
    StoreConfiguration,
    /// Begin communication with the pending node-ID, since the slave had none until now.
    ResetCommunication,
}

/// An LSS slave: its address, LSS state, progress of multi-step services, pending and active node-ID, and pending bit
/// rate.
#[derive(Clone, Debug)]
pub struct Slave {
    /// The LSS address, by [`AddressPart`].
    address: [u32; 4],
    bit_rates: BitRates,
    state: State,
    /// The LSS state stays waiting.
    is_locked: bool,
    /// The part that the next request of 40..43 must name.
    select: AddressPart,
    /// The key that the next request of 46..4B must name.
    identify: IdentifyKey,
    /// LSSPos, the part that the next Fastscan step must name. `None` while the slave takes no part in Fastscan, as in
    /// LSS configuration state and with a node-ID.
    fastscan: Option<AddressPart>,
    pending_node_id: Option<NodeId>,
    active_node_id: Option<NodeId>,
    pending_bit_rate: BitRateSetting,
    /// A master has configured the pending bit rate but has not activated it.
    is_bit_rate_configured: bool,
}

impl Slave {
    /// A slave after power-on: the stored node-ID is pending and active, the stored bit rate is pending, the LSS state
    /// is waiting.
    ///
    /// `bit_rates` are the rates that configure bit timing accepts.
    pub const fn new(
        address: Address,
        bit_rates: BitRates,
        node_id: Option<NodeId>,
        bit_rate: BitRateSetting,
    ) -> Self {
        let Address { vendor_id, product_code, revision_number, serial_number } = address;
        let mut slave = Self {
            address: [vendor_id, product_code, revision_number, serial_number],
            bit_rates,
            state: State::Waiting,
            is_locked: false,
            select: AddressPart::VendorId,
            identify: IdentifyKey::VendorId,
            fastscan: None,
            pending_node_id: node_id,
            active_node_id: node_id,
            pending_bit_rate: bit_rate,
            is_bit_rate_configured: false,
        };
        slave.switch_to(State::Waiting);
        slave
    }

    /// The LSS address.
    pub const fn address(&self) -> Address {
        let [vendor_id, product_code, revision_number, serial_number] = self.address;
        Address { vendor_id, product_code, revision_number, serial_number }
    }

    /// A part of the LSS address.
    pub const fn address_part(&self, part: AddressPart) -> u32 {
        // The mask proves to the compiler that the index is within the four parts.
        self.address[part as usize & 3]
    }

    /// The LSS state.
    pub const fn state(&self) -> State {
        self.state
    }

    /// The active node-ID.
    pub const fn active_node_id(&self) -> Option<NodeId> {
        self.active_node_id
    }

    /// The pending node-ID, which reset communication activates and store configuration stores.
    pub const fn pending_node_id(&self) -> Option<NodeId> {
        self.pending_node_id
    }

    /// The pending bit rate, which activate bit timing activates and store configuration stores.
    pub const fn pending_bit_rate(&self) -> BitRateSetting {
        self.pending_bit_rate
    }

    /// Makes this the pending node-ID, as configure node-ID does.
    pub const fn configure_node_id(&mut self, node_id: Option<NodeId>) {
        self.pending_node_id = node_id;
    }

    /// Makes this the pending bit rate, as configure bit timing does; returns whether the device offers it.
    pub const fn configure_bit_rate(&mut self, rate: BitRateSetting) -> bool {
        let is_offered = self.bit_rates.offers(rate);
        if is_offered {
            self.pending_bit_rate = rate;
            self.is_bit_rate_configured = true;
        }
        is_offered
    }

    /// Activates the pending bit rate and returns it. Unless a master has configured one since the latest activation,
    /// this is the `active` one.
    pub const fn activate_bit_rate(&mut self, active: BitRateSetting) -> BitRateSetting {
        if !self.is_bit_rate_configured {
            self.pending_bit_rate = active;
        }
        self.is_bit_rate_configured = false;
        self.pending_bit_rate
    }

    /// Locks the LSS state to waiting, or releases it.
    pub const fn set_locked(&mut self, is_locked: bool) {
        self.is_locked = is_locked;
        if is_locked {
            self.switch_to(State::Waiting);
        }
    }

    /// Enters LSS waiting state and discards all progress, for a node that may miss requests. Without an active node-ID
    /// the pending one is discarded too: the master may give it to another device meanwhile.
    pub const fn discard_session(&mut self) {
        if self.active_node_id.is_none() {
            self.pending_node_id = None;
        }
        self.switch_to(State::Waiting);
    }

    /// Performs NMT reset communication: activates the pending node-ID, unlocks, enters LSS waiting state and discards
    /// all progress.
    pub const fn reset_communication(&mut self) {
        self.is_locked = false;
        self.active_node_id = self.pending_node_id;
        self.switch_to(State::Waiting);
    }

    /// Executes a request in the data of a frame from the LSS master, if the LSS state allows it.
    #[must_use = "a reaction that is not carried out is lost"]
    pub fn handle(&mut self, data: &[u8; 8]) -> Option<Reaction> {
        use State::{Configuration, Waiting};
        let answer = match (Request::from_bytes(data)?, self.state) {
            (Request::SwitchToWaiting, _) => return self.switch_to_waiting(),
            (Request::SwitchToConfiguration, _) if !self.is_locked => {
                self.switch_to(Configuration);
                return None;
            }
            (Request::Identify(key, number), _) => self.identify(key, number)?,
            (Request::IdentifyNonConfigured, _) if self.is_unconfigured() => NonConfigured,
            (Request::Select(part, number), Waiting) => self.select(part, number)?,
            (Request::Fastscan(step), _) => self.fastscan(step)?,
            (Request::ConfigureNodeId(byte), Configuration) => {
                let id = NodeId::from_lss(byte);
                if let Ok(id) = id {
                    self.configure_node_id(id);
                }
                ConfigureNodeId { accepted: id.is_ok() }
            }
            (Request::ConfigureBitTiming { table, index }, Configuration) => {
                let rate = BitRateSetting::from_table(table, index);
                let accepted = rate.is_some_and(|rate| self.configure_bit_rate(rate));
                ConfigureBitTiming { accepted }
            }
            (Request::Inquire(part), Configuration) => Inquire(part, self.address_part(part)),
            (Request::InquireNodeId, Configuration) => InquireNodeId(self.active_node_id),
            (Request::ActivateBitTiming(delay_ms), Configuration) => {
                return Some(Reaction::ActivateBitTiming(delay_ms));
            }
            (Request::StoreConfiguration, Configuration) => {
                return Some(Reaction::StoreConfiguration);
            }
            _ => return None,
        };
        Some(Reaction::Answer(answer.to_frame()))
    }

    const fn is_unconfigured(&self) -> bool {
        self.active_node_id.is_none() && self.pending_node_id.is_none()
    }

    /// Enters an LSS state. Every switch discards all progress, even one to the current state.
    const fn switch_to(&mut self, state: State) {
        self.state = state;
        self.select = AddressPart::VendorId;
        self.identify = IdentifyKey::VendorId;
        self.fastscan = match state {
            State::Waiting if self.is_unconfigured() => Some(AddressPart::VendorId),
            _ => None,
        };
    }

    fn switch_to_waiting(&mut self) -> Option<Reaction> {
        let was_configured_just_now = self.state == State::Configuration
            && self.active_node_id.is_none()
            && self.pending_node_id.is_some();
        self.switch_to(State::Waiting);
        was_configured_just_now.then_some(Reaction::ResetCommunication)
    }

    /// Enters LSS configuration state after a match, without affecting the progress of other services.
    const fn enter_configuration(&mut self) {
        self.state = State::Configuration;
        self.fastscan = None;
    }

    fn select(&mut self, part: AddressPart, number: u32) -> Option<Response> {
        let in_order = part == AddressPart::VendorId || part == self.select;
        if !in_order || number != self.address_part(part) {
            self.select = AddressPart::VendorId;
            return None;
        }
        self.select = part.next();
        if part != AddressPart::SerialNumber || self.is_locked {
            return None;
        }
        self.enter_configuration();
        Some(Selected)
    }

    fn identify(&mut self, key: IdentifyKey, number: u32) -> Option<Response> {
        use IdentifyKey::*;
        // Unless this step succeeds, the next one must be the first.
        let awaited = mem::replace(&mut self.identify, VendorId);
        if key != VendorId && key != awaited {
            return None;
        }
        let own = self.address_part(key.part());
        let matches = number == own
            || match key {
                RevisionNumberLow | SerialNumberLow => number < own,
                RevisionNumberHigh | SerialNumberHigh => number > own,
                VendorId | ProductCode => false,
            };
        if !matches {
            return None;
        }
        self.identify = key.next();
        (key == SerialNumberHigh).then_some(Identified)
    }

    fn fastscan(&mut self, step: FastscanStep) -> Option<Response> {
        const BEGIN: u8 = 0x80;
        let part = self.fastscan?;
        if step.bit_check == BEGIN {
            self.fastscan = Some(AddressPart::VendorId);
            return Some(Identified);
        }
        let difference = self.address_part(part) ^ step.id_number;
        if step.sub != part as u8 || difference.checked_shr(step.bit_check.into())? != 0 {
            return None;
        }
        let next = AddressPart::new(step.next)?;
        self.fastscan = Some(next);
        // A master that knows some parts skips them, so the scan does not end with the fourth part but with the step
        // back to an earlier one.
        if step.bit_check == 0 && next < part {
            self.enter_configuration();
        }
        Some(Identified)
    }
}

/// A request of the LSS master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Request {
    /// 04, mode 0: switches all slaves to LSS waiting state.
    SwitchToWaiting,
    /// 04, mode 1: switches all slaves to LSS configuration state.
    SwitchToConfiguration,
    /// 11: sets the pending node-ID, given as any byte, valid or not.
    ConfigureNodeId(u8),
    /// 13: sets the pending bit rate.
    ConfigureBitTiming {
        /// Table selector; 0 is the table of CiA 301.
        table: u8,
        /// Index into the selected table.
        index: u8,
    },
    /// 15: activates the pending bit rate after the switch delay, 0..=65535 ms.
    ActivateBitTiming(u16),
    /// 17: makes the pending node-ID and bit rate persistent.
    StoreConfiguration,
    /// 40..43: one step of switch state selective.
    Select(AddressPart, u32),
    /// 46..4B: one step of identify remote slave.
    Identify(IdentifyKey, u32),
    /// 4C: asks for slaves without a node-ID.
    IdentifyNonConfigured,
    /// 51: one step of Fastscan.
    Fastscan(FastscanStep),
    /// 5A..5D: asks for one part of the LSS address.
    Inquire(AddressPart),
    /// 5E: asks for the active node-ID.
    InquireNodeId,
}

/// The comparison in one step of identify remote slave (CS 46..4B).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
#[expect(missing_docs, reason = "the names say it")]
pub enum IdentifyKey {
    VendorId = 0,
    ProductCode = 1,
    RevisionNumberLow = 2,
    RevisionNumberHigh = 3,
    SerialNumberLow = 4,
    SerialNumberHigh = 5,
}

impl IdentifyKey {
    /// The key with the number 0..=5.
    const fn new(number: u8) -> Option<Self> {
        match number {
            0 => Some(Self::VendorId),
            1 => Some(Self::ProductCode),
            2 => Some(Self::RevisionNumberLow),
            3 => Some(Self::RevisionNumberHigh),
            4 => Some(Self::SerialNumberLow),
            5 => Some(Self::SerialNumberHigh),
            _ => None,
        }
    }

    /// The part of the address to compare with.
    pub(super) const fn part(self) -> AddressPart {
        match self {
            Self::VendorId => AddressPart::VendorId,
            Self::ProductCode => AddressPart::ProductCode,
            Self::RevisionNumberLow | Self::RevisionNumberHigh => AddressPart::RevisionNumber,
            Self::SerialNumberLow | Self::SerialNumberHigh => AddressPart::SerialNumber,
        }
    }

    /// The key after this one; the vendor-ID after the last.
    pub(super) fn next(self) -> Self {
        Self::new(self as u8 + 1).unwrap_or(Self::VendorId)
    }
}

/// One step of Fastscan, as in the frame; all combinations are accepted here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FastscanStep {
    /// The number for the slaves to compare with theirs.
    pub id_number: u32,
    /// The lowest bit of the comparison, 0..=31; 80h begins a new scan.
    pub bit_check: u8,
    /// LSSSub: the part to compare, 0..=3.
    pub sub: u8,
    /// LSSNext: the part that a matching slave expects next, 0..=3.
    pub next: u8,
}

/// An answer of a slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Response {
    /// 44: this slave was selected.
    Selected,
    /// 4F: a slave matches identify remote slave or a Fastscan step.
    Identified,
    /// 50: a slave has no node-ID.
    NonConfigured,
    /// 11: error code 0 if accepted, else 1 (out of range).
    ConfigureNodeId {
        /// Whether the node-ID is now pending.
        accepted: bool,
    },
    /// 13: error code 0 if accepted, else 1 (not supported).
    ConfigureBitTiming {
        /// Whether the bit rate is now pending.
        accepted: bool,
    },
    /// 17: error code 0, or the [`StoreError`].
    StoreConfiguration(Result<(), StoreError>),
    /// 5A..5D: a part of the LSS address.
    Inquire(AddressPart, u32),
    /// 5E: the active node-ID.
    InquireNodeId(Option<NodeId>),
}

/// The reason why nothing was stored, with the error codes of store configuration (CiA 305).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum StoreError {
    /// 1: this device cannot store. An SDO client gets abort code 0606 0000h.
    NotSupported,
    /// 2: the medium failed; the previous content is still stored. An SDO client gets abort code 0606 0000h.
    MediumAccess,
    /// 2: the medium is full until the next start; the previous content is still stored. An SDO client gets abort code
    /// 0800 0022h.
    Full,
}

impl StoreError {
    const fn code(self) -> u32 {
        match self {
            Self::NotSupported => 1,
            Self::MediumAccess | Self::Full => 2,
        }
    }
}

impl fmt::Display for StoreError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NotSupported => "the device cannot store",
            Self::MediumAccess => "the storage medium failed",
            Self::Full => "the storage medium is full until the next start",
        })
    }
}

impl error::Error for StoreError {}

impl From<settings::Error> for StoreError {
    fn from(error: settings::Error) -> Self {
        match error {
            settings::Error::Full => Self::Full,
            _ => Self::MediumAccess,
        }
    }
}

const SWITCH_GLOBAL: u8 = 0x04;
const CONFIGURE_NODE_ID: u8 = 0x11;
const CONFIGURE_BIT_TIMING: u8 = 0x13;
const ACTIVATE_BIT_TIMING: u8 = 0x15;
const STORE_CONFIGURATION: u8 = 0x17;
const SELECT: u8 = 0x40;
const SELECTED: u8 = 0x44;
const IDENTIFY: u8 = 0x46;
const IDENTIFY_NON_CONFIGURED: u8 = 0x4C;
const IDENTIFIED: u8 = 0x4F;
const NON_CONFIGURED: u8 = 0x50;
const FASTSCAN: u8 = 0x51;
const INQUIRE: u8 = 0x5A;
const INQUIRE_NODE_ID: u8 = 0x5E;

impl Request {
    /// The request in the data of a frame; `None` if the command specifier is unknown or that of a response, or if the
    /// mode of a 04 is neither 0 nor 1. Reserved bytes are ignored.
    #[expect(clippy::manual_range_patterns, reason = "a range is not looked up in the jump table")]
    pub fn from_bytes(bytes: &[u8; 8]) -> Option<Self> {
        let [command, b1, b2, b3, b4, b5, b6, b7] = *bytes;
        let number = u32::from_le_bytes([b1, b2, b3, b4]);
        Some(match command {
            SWITCH_GLOBAL if b1 == 0 => Self::SwitchToWaiting,
            SWITCH_GLOBAL if b1 == 1 => Self::SwitchToConfiguration,
            CONFIGURE_NODE_ID => Self::ConfigureNodeId(b1),
            CONFIGURE_BIT_TIMING => Self::ConfigureBitTiming { table: b1, index: b2 },
            ACTIVATE_BIT_TIMING => Self::ActivateBitTiming(u16::from_le_bytes([b1, b2])),
            STORE_CONFIGURATION => Self::StoreConfiguration,
            0x40 | 0x41 | 0x42 | 0x43 => Self::Select(AddressPart::new(command - SELECT)?, number),
            0x46 | 0x47 | 0x48 | 0x49 | 0x4A | 0x4B => {
                Self::Identify(IdentifyKey::new(command - IDENTIFY)?, number)
            }
            IDENTIFY_NON_CONFIGURED => Self::IdentifyNonConfigured,
            FASTSCAN => {
                Self::Fastscan(FastscanStep { id_number: number, bit_check: b5, sub: b6, next: b7 })
            }
            0x5A | 0x5B | 0x5C | 0x5D => Self::Inquire(AddressPart::new(command - INQUIRE)?),
            INQUIRE_NODE_ID => Self::InquireNodeId,
            _ => return None,
        })
    }

    /// The data of the request's frame; reserved bytes are 0.
    pub const fn to_bytes(self) -> [u8; 8] {
        match self {
            Self::SwitchToWaiting => bytes(SWITCH_GLOBAL, 0),
            Self::SwitchToConfiguration => bytes(SWITCH_GLOBAL, 1),
            Self::ConfigureNodeId(id) => bytes(CONFIGURE_NODE_ID, id as u32),
            Self::ConfigureBitTiming { table, index } => {
                bytes(CONFIGURE_BIT_TIMING, u32::from_le_bytes([table, index, 0, 0]))
            }
            Self::ActivateBitTiming(delay_ms) => bytes(ACTIVATE_BIT_TIMING, delay_ms as u32),
            Self::StoreConfiguration => bytes(STORE_CONFIGURATION, 0),
            Self::Select(part, number) => bytes(SELECT + part as u8, number),
            Self::Identify(key, number) => bytes(IDENTIFY + key as u8, number),
            Self::IdentifyNonConfigured => bytes(IDENTIFY_NON_CONFIGURED, 0),
            Self::Fastscan(FastscanStep { id_number, bit_check, sub, next }) => {
                let [command, b1, b2, b3, b4, ..] = bytes(FASTSCAN, id_number);
                [command, b1, b2, b3, b4, bit_check, sub, next]
            }
            Self::Inquire(part) => bytes(INQUIRE + part as u8, 0),
            Self::InquireNodeId => bytes(INQUIRE_NODE_ID, 0),
        }
    }

    /// The request's frame.
    pub const fn to_frame(self) -> Frame {
        Frame::with_eight_bytes(REQUEST_COB_ID, self.to_bytes())
    }
}

impl Response {
    /// The data of the answer's frame. Reserved bytes are 0, so that slaves that answer simultaneously send identical
    /// frames.
    #[inline(always)] // A separate call would pass its answer through memory, byte by byte.
    pub const fn to_bytes(self) -> [u8; 8] {
        let (command, number) = match self {
            Self::Selected => (SELECTED, 0),
            Self::Identified => (IDENTIFIED, 0),
            Self::NonConfigured => (NON_CONFIGURED, 0),
            Self::ConfigureNodeId { accepted } => (CONFIGURE_NODE_ID, !accepted as u32),
            Self::ConfigureBitTiming { accepted } => (CONFIGURE_BIT_TIMING, !accepted as u32),
            Self::StoreConfiguration(Ok(())) => (STORE_CONFIGURATION, 0),
            Self::StoreConfiguration(Err(error)) => (STORE_CONFIGURATION, error.code()),
            Self::Inquire(part, number) => (INQUIRE + part as u8, number),
            Self::InquireNodeId(id) => (INQUIRE_NODE_ID, NodeId::to_lss(id) as u32),
        };
        bytes(command, number)
    }

    /// The answer's frame.
    #[inline(always)] // Apart it takes 196 bytes more.
    pub const fn to_frame(self) -> Frame {
        Frame::with_eight_bytes(RESPONSE_COB_ID, self.to_bytes())
    }
}

const fn bytes(command: u8, number: u32) -> [u8; 8] {
    let [b1, b2, b3, b4] = number.to_le_bytes();
    [command, b1, b2, b3, b4, 0, 0, 0]
}
