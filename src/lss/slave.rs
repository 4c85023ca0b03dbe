//! The LSS slave's state machine (CiA 305): what each request does in LSS waiting and LSS configuration state.

use super::{
    Address, AddressPart, FastscanStep, IdentifyKey, Request,
    Response::{self, *},
};
use crate::{BitRateSetting, BitRates, NodeId};

/// The LSS state, which is independent of the NMT state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// LSS waiting state: only the services that find or select a slave are served.
    Waiting,
    /// LSS configuration state: the slave can be configured and inquired.
    Configuration,
}

/// What a request asks of the node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Reaction {
    /// Send this answer.
    Answer(Response),
    /// Run at the pending bit rate after the switch delay in milliseconds, without a frame in between.
    ActivateBitTiming(u16),
    /// Make the pending node-ID and bit rate persistent, then answer.
    StoreConfiguration,
    /// Begin communication with the pending node-ID: until now the slave had none.
    ResetCommunication,
}

/// An LSS slave: its address, LSS state, progress of the services of several steps, and the node-ID and bit rate,
/// each pending and active.
#[derive(Clone, Debug)]
pub struct Slave {
    address: Address,
    bit_rates: BitRates,
    state: State,
    /// The part that the next 40..43 must name.
    select: AddressPart,
    /// The key that the next 46..4B must name.
    identify: IdentifyKey,
    /// LSSPos, the part that the next Fastscan step must name: 0..=3.
    fastscan: u8,
    pending_node_id: Option<NodeId>,
    active_node_id: Option<NodeId>,
    pending_bit_rate: BitRateSetting,
    active_bit_rate: BitRateSetting,
}

impl Slave {
    /// A slave after power-on: the stored node-ID and bit rate are pending and active, the LSS state is waiting.
    ///
    /// `bit_rates` are those that configure bit timing may ask for.
    pub const fn new(
        address: Address,
        bit_rates: BitRates,
        node_id: Option<NodeId>,
        bit_rate: BitRateSetting,
    ) -> Self {
        Self {
            address,
            bit_rates,
            state: State::Waiting,
            select: AddressPart::VendorId,
            identify: IdentifyKey::VendorId,
            fastscan: 0,
            pending_node_id: node_id,
            active_node_id: node_id,
            pending_bit_rate: bit_rate,
            active_bit_rate: bit_rate,
        }
    }

    /// The LSS address.
    pub const fn address(&self) -> &Address {
        &self.address
    }

    /// The LSS state.
    pub const fn state(&self) -> State {
        self.state
    }

    /// The node-ID in use.
    pub const fn active_node_id(&self) -> Option<NodeId> {
        self.active_node_id
    }

    /// The node-ID that the next reset communication brings into use and store configuration stores.
    pub const fn pending_node_id(&self) -> Option<NodeId> {
        self.pending_node_id
    }

    /// The bit rate in use.
    pub const fn active_bit_rate(&self) -> BitRateSetting {
        self.active_bit_rate
    }

    /// The bit rate that activate bit timing brings into use and store configuration stores.
    pub const fn pending_bit_rate(&self) -> BitRateSetting {
        self.pending_bit_rate
    }

    /// The pending bit rate is active from now on.
    pub const fn activate_bit_rate(&mut self) {
        self.active_bit_rate = self.pending_bit_rate;
    }

    /// NMT reset communication: the pending node-ID is active, the LSS state is waiting, all progress is lost.
    pub const fn reset_communication(&mut self) {
        self.active_node_id = self.pending_node_id;
        self.switch_to(State::Waiting);
    }

    /// Carries out the request in the data of a frame from the LSS master, as far as the LSS state allows it.
    pub fn handle(&mut self, data: &[u8; 8]) -> Option<Reaction> {
        let is_waiting = self.state == State::Waiting;
        let answer = match Request::from_bytes(data)? {
            Request::SwitchToWaiting => return self.switch_to_waiting(),
            Request::SwitchToConfiguration => {
                self.switch_to(State::Configuration);
                return None;
            }
            Request::Identify(key, number) => self.identify(key, number)?,
            Request::IdentifyNonConfigured if self.is_unconfigured() => NonConfigured,
            Request::Select(part, number) if is_waiting => self.select(part, number)?,
            Request::Fastscan(step) if is_waiting => self.fastscan(step)?,
            _ if is_waiting => return None,
            Request::ConfigureNodeId(byte) => {
                let id = NodeId::from_lss(byte);
                if let Ok(id) = id {
                    self.pending_node_id = id;
                }
                ConfigureNodeId { accepted: id.is_ok() }
            }
            Request::ConfigureBitTiming { table, index } => {
                let rate =
                    BitRateSetting::from_table(table, index).filter(|&r| self.bit_rates.offers(r));
                if let Some(rate) = rate {
                    self.pending_bit_rate = rate;
                }
                ConfigureBitTiming { accepted: rate.is_some() }
            }
            Request::Inquire(part) => Inquire(part, self.address.part(part)),
            Request::InquireNodeId => InquireNodeId(self.active_node_id),
            Request::ActivateBitTiming(delay_ms) => {
                return Some(Reaction::ActivateBitTiming(delay_ms));
            }
            Request::StoreConfiguration => return Some(Reaction::StoreConfiguration),
            _ => return None,
        };
        Some(Reaction::Answer(answer))
    }

    const fn is_unconfigured(&self) -> bool {
        self.active_node_id.is_none() && self.pending_node_id.is_none()
    }

    /// Every switch, even to the state that is already there, loses all progress.
    const fn switch_to(&mut self, state: State) {
        self.state = state;
        self.select = AddressPart::VendorId;
        self.identify = IdentifyKey::VendorId;
        self.fastscan = 0;
    }

    fn switch_to_waiting(&mut self) -> Option<Reaction> {
        let was_configured_just_now = self.state == State::Configuration
            && self.active_node_id.is_none()
            && self.pending_node_id.is_some();
        self.switch_to(State::Waiting);
        was_configured_just_now.then_some(Reaction::ResetCommunication)
    }

    fn select(&mut self, part: AddressPart, number: u32) -> Option<Response> {
        use AddressPart::*;
        let in_order = part == VendorId || part == self.select;
        let matches = in_order && number == self.address.part(part);
        self.select = match part {
            _ if !matches => VendorId,
            VendorId => ProductCode,
            ProductCode => RevisionNumber,
            RevisionNumber => SerialNumber,
            SerialNumber => {
                self.state = State::Configuration;
                self.select = VendorId;
                return Some(Selected);
            }
        };
        None
    }

    fn identify(&mut self, key: IdentifyKey, number: u32) -> Option<Response> {
        use IdentifyKey::*;
        let in_order = key == VendorId || key == self.identify;
        let own = &self.address;
        let matches = in_order
            && match key {
                VendorId => number == own.vendor_id,
                ProductCode => number == own.product_code,
                RevisionNumberLow => number <= own.revision_number,
                RevisionNumberHigh => number >= own.revision_number,
                SerialNumberLow => number <= own.serial_number,
                SerialNumberHigh => number >= own.serial_number,
            };
        self.identify = match key {
            _ if !matches => VendorId,
            VendorId => ProductCode,
            ProductCode => RevisionNumberLow,
            RevisionNumberLow => RevisionNumberHigh,
            RevisionNumberHigh => SerialNumberLow,
            SerialNumberLow => SerialNumberHigh,
            SerialNumberHigh => {
                self.identify = VendorId;
                return Some(Identified);
            }
        };
        None
    }

    fn fastscan(&mut self, step: FastscanStep) -> Option<Response> {
        const BEGIN: u8 = 0x80;
        if !self.is_unconfigured() {
            return None;
        }
        if step.bit_check == BEGIN {
            self.fastscan = 0;
            return Some(Identified);
        }
        let own = self.address.part(AddressPart::new(step.sub)?);
        let differs = (own ^ step.id_number).checked_shr(step.bit_check.into())? != 0;
        if differs || step.sub != self.fastscan || step.next > 3 {
            return None;
        }
        self.fastscan = step.next;
        // A master that knows some parts skips them: not the fourth part ends the scan, but the step back to an earlier.
        if step.bit_check == 0 && step.next < step.sub {
            self.state = State::Configuration;
        }
        Some(Identified)
    }
}
