//! The LSS slave's state machine (CiA 305): the effect of each request in LSS waiting and LSS configuration state.

use core::mem;

use Response::*;

use super::{Address, AddressPart, FastscanStep, IdentifyKey, Request, Response};
use crate::{BitRateSetting, BitRates, Frame, NodeId, Settings};

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
    /// A [`Slave`](crate::Slave) does it.
    ActivateBitTiming(u16),
    /// Make the pending node-ID and bit rate persistent, then answer.
    StoreConfiguration,
    /// Begin communication with the pending node-ID, since the slave had none until now.
    ResetCommunication,
}

/// The state machine of an LSS slave: its address, LSS state, progress of multi-step services, pending and active
/// node-ID, and pending bit rate.
#[derive(Clone, Debug)]
pub struct StateMachine {
    /// The LSS address, by [`AddressPart`].
    address: [u32; 4],
    bit_rates: BitRates,
    state: State,
    /// The LSS state stays waiting.
    is_locked: bool,
    /// The part that the next request of 40..43 must name. `None` in LSS configuration state.
    select: Option<AddressPart>,
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

impl StateMachine {
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
        let mut state_machine = Self {
            address: [vendor_id, product_code, revision_number, serial_number],
            bit_rates,
            state: State::Waiting,
            is_locked: false,
            select: None,
            identify: IdentifyKey::VendorId,
            fastscan: None,
            pending_node_id: node_id,
            active_node_id: node_id,
            pending_bit_rate: bit_rate,
            is_bit_rate_configured: false,
        };
        state_machine.switch_to(State::Waiting);
        state_machine
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

    /// The pending node-ID and bit rate, which store configuration stores.
    pub const fn pending(&self) -> Settings {
        Settings::new(self.pending_bit_rate).with_node_id(self.pending_node_id)
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
        use State::Configuration;
        let answer = match (Request::from_bytes(data)?, self.state) {
            (Request::SwitchToWaiting, _) => return self.switch_to_waiting(),
            (Request::SwitchToConfiguration, _) if !self.is_locked => {
                self.switch_to(Configuration);
                return None;
            }
            (Request::Identify(key, number), _) => self.identify(key, number)?,
            (Request::IdentifyNonConfigured, _) if self.is_unconfigured() => NonConfigured,
            (Request::Select(part, number), _) => self.select(part, number)?,
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
        self.select = match state {
            State::Waiting => Some(AddressPart::VendorId),
            State::Configuration => None,
        };
        self.identify = IdentifyKey::VendorId;
        self.fastscan = match state {
            State::Waiting if self.is_unconfigured() => Some(AddressPart::VendorId),
            _ => None,
        };
    }

    fn switch_to_waiting(&mut self) -> Option<Reaction> {
        // A node that had another node-ID keeps it until NMT reset communication.
        let was_configured_just_now = self.state == State::Configuration
            && self.active_node_id.is_none()
            && self.pending_node_id.is_some();
        self.switch_to(State::Waiting);
        was_configured_just_now.then_some(Reaction::ResetCommunication)
    }

    /// Enters LSS configuration state after a match, without affecting the progress of other services.
    const fn enter_configuration(&mut self) {
        self.state = State::Configuration;
        (self.select, self.fastscan) = (None, None);
    }

    fn select(&mut self, part: AddressPart, number: u32) -> Option<Response> {
        let awaited = self.select?;
        let in_order = part == AddressPart::VendorId || part == awaited;
        if !in_order || number != self.address_part(part) {
            self.select = Some(AddressPart::VendorId);
            return None;
        }
        self.select = Some(part.next());
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
        // The bits from BitCheck up to bit 31 must be equal. A shift by 32 or more, of a BitCheck that CiA 305 does not
        // define, has no result: no answer.
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
