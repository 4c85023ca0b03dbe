//! How the node comes to its bit rate: the switch with its two delays, listening, and the rescue.

use super::{Action, Due, Node};
use crate::{
    BitRate, BitRateSetting, Instant,
    bus::{Bus, BusEvent, ERRORS_ON_TRIAL, Listening, Step},
    nmt,
};

/// An activation of bit timing on its way (CiA 305, activate bit timing parameters).
#[derive(Clone, Copy, Debug)]
pub(super) struct Switch {
    pub(super) phase: Phase,
    /// The end of the phase.
    pub(super) until: Instant,
    pub(super) delay_micros: u32,
}

#[derive(Clone, Copy, Debug)]
pub(super) enum Phase {
    /// The board has not been told.
    Requested,
    OldRate,
    NewRate,
}

impl Node {
    /// Takes what the controller has seen of the bus. Telling it again does no harm.
    pub fn handle_bus(&mut self, event: BusEvent) {
        self.is_boot_up_acknowledged |= event == BusEvent::Acknowledged;
        self.due = Due::Now;
        if event == BusEvent::BusOff {
            self.handle_communication_error();
        }
        let is_to_listen = self.device.rescue && self.switch.is_none();
        match (&mut self.bus, event) {
            (Bus::OnTrial { .. }, BusEvent::Received | BusEvent::Acknowledged) => {
                self.bus = Bus::Proven
            }
            (Bus::Proven, BusEvent::BusOff) => self.bus = Bus::ON_TRIAL,
            (Bus::OnTrial { errors }, event) if is_to_listen => {
                *errors += u8::from(event == BusEvent::Error);
                if event != BusEvent::Error || *errors >= ERRORS_ON_TRIAL {
                    let fastest = self.device.bit_rates.fastest();
                    let first = self.previous_rate.take().unwrap_or(fastest);
                    self.bus = Bus::Listening(Listening::begin(first, Some(self.rate)));
                    // Nobody has heard the boot-up that is dropped now.
                    if !self.is_boot_up_acknowledged && self.nmt == nmt::State::PreOperational {
                        self.nmt = nmt::State::Initialisation;
                    }
                }
            }
            (Bus::Listening(listening), BusEvent::Received) => {
                self.bus = Bus::Found(listening.rate())
            }
            (Bus::Listening(listening), BusEvent::Error) => {
                listening.handle_error(self.device.bit_rates);
            }
            _ => {}
        }
    }

    /// Ends the phase of the switch that is over.
    pub(super) fn advance(&mut self, switch: Switch, now: Instant) -> Option<Action> {
        let until = switch.until.plus_micros(switch.delay_micros);
        match switch.phase {
            Phase::Requested => {
                self.switch = Some(Switch { phase: Phase::OldRate, until, ..switch });
                return Some(Action::StopTransmitting);
            }
            Phase::OldRate => self.switch = Some(Switch { phase: Phase::NewRate, until, ..switch }),
            Phase::NewRate => {
                self.switch = None;
                self.is_resume_due = true;
                return None;
            }
        }
        let was_automatic = self.lss.active_bit_rate() == BitRateSetting::Automatic;
        self.lss.activate_bit_rate();
        match self.lss.active_bit_rate() {
            BitRateSetting::Fixed(rate) if rate != self.rate => {
                self.previous_rate = Some(self.rate);
                self.bus = Bus::ON_TRIAL;
                self.run_at(rate)
            }
            BitRateSetting::Automatic if !was_automatic => {
                let first = self.device.bit_rates.fastest();
                self.bus = Bus::Listening(Listening::begin(first, None));
                self.listen(now)
            }
            _ => None,
        }
    }

    pub(super) fn listen(&mut self, now: Instant) -> Option<Action> {
        match &mut self.bus {
            Bus::OnTrial { .. } | Bus::Proven => None,
            Bus::Found(rate) => {
                let rate = *rate;
                self.bus = Bus::Proven;
                self.is_resume_due = self.switch.is_none();
                self.run_at(rate)
            }
            Bus::Listening(listening) => match listening.step(self.device.bit_rates, now)? {
                Step::Listen(rate) => {
                    self.rate = rate;
                    Some(Action::Listen(rate))
                }
                Step::TryAgain(rate) => {
                    self.bus = Bus::ON_TRIAL;
                    self.is_resume_due = self.switch.is_none();
                    self.run_at(rate)
                }
            },
        }
    }

    fn run_at(&mut self, rate: BitRate) -> Option<Action> {
        self.rate = rate;
        Some(Action::SetBitRate(rate))
    }
}
