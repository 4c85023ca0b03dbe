//! The switch of the bit rate with its two delays, and what the supervision of the bit rate asks of the node.

use super::{Action, Due, Node};
use crate::{
    BitRateSetting, Instant,
    emergency::Fault,
    nmt,
    supervision::{BusEvent, Step},
};

/// An activation of bit timing under way (CiA 305, activate bit timing parameters).
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
    /// Takes what the controller has observed at `now`. The same event twice does no harm.
    pub fn handle_bus(&mut self, event: BusEvent, now: Instant) {
        if event == BusEvent::Acknowledged {
            self.is_boot_up_acknowledged = true;
            self.emergency.note_acknowledge();
        }
        if event == BusEvent::BusOff {
            self.handle_communication_error();
        }
        let is_proof = matches!(event, BusEvent::Received | BusEvent::Acknowledged);
        // Within the silent periods of a switch errors are to be expected.
        if is_proof || self.is_supervised() {
            self.supervision.handle(event, now);
        }
        self.due = Due::Now;
    }

    /// Whether the supervision may act: not within a switch, unless that has begun a detection.
    pub(super) const fn is_supervised(&self) -> bool {
        self.switch.is_none() || self.supervision.is_detecting()
    }

    /// Whether frames may leave, as far as the supervision is concerned.
    pub(super) const fn may_send(&self) -> bool {
        !self.supervision.is_listening() && !self.supervision.is_withholding()
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
                self.heartbeat_due = now;
                return None;
            }
        }
        let was_automatic = self.lss.active_bit_rate() == BitRateSetting::Automatic;
        self.lss.activate_bit_rate();
        match self.lss.active_bit_rate() {
            BitRateSetting::Fixed(rate) => self.supervision.command(rate, until),
            BitRateSetting::Automatic if was_automatic => return self.next_step(now),
            BitRateSetting::Automatic => self.supervision.detect(),
        }
        let rate = self.supervision.bit_rate();
        self.emergency.end(Fault::AwayFromHomeRate { in_use: rate, home: rate });
        self.next_step(now)
    }

    /// What the supervision of the bit rate asks for now.
    pub(super) fn supervise(&mut self, now: Instant) -> Option<Action> {
        // Within the switch that has begun it, a detection may come to its end.
        let is_step_due = self.is_supervised() || self.supervision.has_step();
        let action = if is_step_due { self.next_step(now) } else { None };
        // Also before a switch: the request for it may be the frame that has shown home to be right.
        if let Some(in_use) = self.supervision.take_change() {
            self.lss.adopt_bit_rate(in_use);
            match self.supervision.home() {
                Some(home) if home != in_use => {
                    self.emergency.report(Fault::AwayFromHomeRate { in_use, home });
                }
                _ => self.emergency.end(Fault::AwayFromHomeRate { in_use, home: in_use }),
            }
        }
        action
    }

    fn next_step(&mut self, now: Instant) -> Option<Action> {
        let step = self.supervision.poll(now)?;
        // Each step drops the frames that wait. Nobody has received a boot-up among them.
        self.emergency.note_dropped();
        if !self.is_boot_up_acknowledged && self.nmt == nmt::State::PreOperational {
            self.nmt = nmt::State::Initialisation;
        }
        self.is_resume_due = self.switch.is_none();
        Some(match step {
            Step::TakePart(rate) => Action::SetBitRate(rate),
            Step::Listen(rate) => Action::Listen(rate),
            Step::DropFrames => Action::StopTransmitting,
        })
    }
}
