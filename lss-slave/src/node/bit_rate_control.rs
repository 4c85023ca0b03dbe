//! Control of the bit rate: the switch with its two delays, the supervision, and the permission to send frames.

use core::mem;

use crate::{
    BitRate, BitRateSetting, BitRates, BusEvent, Frame, Instant, nmt,
    supervision::{Step, Supervision},
};

/// The bit rates of the node (in use, active and home) and the switch to another.
#[derive(Clone, Debug)]
pub(super) struct BitRateControl {
    supervision: Supervision,
    /// The active setting is automatic detection.
    is_automatic: bool,
    switch: Option<Switch>,
    /// A frame was received at home, but the supervision has not been informed.
    is_proof_due: bool,
    /// Frames may be sent again, but the board has not been informed.
    is_resume_due: bool,
}

/// An activation of bit timing in progress (CiA 305, activate bit timing parameters).
#[derive(Clone, Copy, Debug)]
struct Switch {
    phase: Phase,
    /// The end of the phase.
    until: Instant,
    delay_micros: u32,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// The board has not been informed.
    Requested,
    OldRate,
    NewRate,
}

/// The node's next step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Next {
    /// A switch begins: no more frames are sent.
    StopTransmitting,
    /// The pending bit rate must be activated, see [`BitRateControl::activate`].
    Activate {
        /// The end of the switch.
        silent_until: Instant,
    },
    /// A switch has ended.
    EndSwitch,
    /// A step of the supervision, which drops the pending frames.
    Step(Step),
    /// Frames may be sent again.
    ResumeTransmitting,
    /// Nothing happens, in the silence of a switch.
    KeepSilent,
}

impl BitRateControl {
    /// The control of a node that was powered on with this setting.
    pub const fn new(setting: BitRateSetting, rates: BitRates, is_supervised: bool) -> Self {
        Self {
            supervision: Supervision::new(setting, rates, is_supervised),
            is_automatic: matches!(setting, BitRateSetting::Automatic),
            switch: None,
            is_proof_due: false,
            is_resume_due: false,
        }
    }

    /// The bit rate at which the controller runs or listens.
    pub const fn in_use(&self) -> BitRate {
        self.supervision.bit_rate()
    }

    /// The active setting (CiA 305).
    pub const fn active(&self) -> BitRateSetting {
        if self.is_automatic {
            BitRateSetting::Automatic
        } else {
            BitRateSetting::Fixed(self.supervision.active())
        }
    }

    /// The bit rate that was last commanded; `None` until it has been detected.
    pub const fn home(&self) -> Option<BitRate> {
        self.supervision.home()
    }

    /// The number of times that the node has joined the others at another bit rate.
    pub const fn rescues(&self) -> u16 {
        self.supervision.rescues()
    }

    /// Whether the controller listens silently.
    pub const fn is_listening(&self) -> bool {
        self.supervision.is_listening()
    }

    /// Whether automatic detection has not found a rate yet.
    pub const fn is_detecting(&self) -> bool {
        self.supervision.is_detecting()
    }

    /// Whether a switch is in progress.
    pub const fn is_switching(&self) -> bool {
        self.switch.is_some()
    }

    /// Whether the supervision allows frames to be sent.
    pub const fn may_send(&self) -> bool {
        !self.supervision.is_listening() && !self.supervision.is_withholding()
    }

    /// Whether another valid frame makes no difference.
    pub const fn is_at_ease(&self) -> bool {
        self.supervision.is_at_ease()
    }

    /// Handles a received frame and returns whether it may be served.
    pub fn handle_frame(&mut self, frame: &Frame, now: Instant) -> bool {
        if self.supervision.is_at_home() {
            // The answer is sent first.
            self.is_proof_due = true;
            return true;
        }
        self.handle_frame_away(frame, now)
    }

    #[inline(never)] // An answer at home does not call it; inlined it takes 220 bytes more.
    fn handle_frame_away(&mut self, frame: &Frame, now: Instant) -> bool {
        // The sender may be lost like this node and repeat its boot-up until someone acknowledges it.
        if self.supervision.is_elsewhere() && nmt::is_boot_up(frame) {
            return false;
        }
        // A sender repeats its frame until someone acknowledges it.
        let is_acknowledged = !self.is_listening();
        self.handle_bus(BusEvent::Received, now);
        is_acknowledged
    }

    /// The time until which a frame is repeated without an acknowledge.
    pub const fn repeats_until(&self) -> Option<Instant> {
        self.supervision.repeats_until()
    }

    /// Handles an acknowledge if it only ends the repetition of a frame; returns whether it does.
    pub const fn take_acknowledge(&mut self) -> bool {
        self.supervision.take_acknowledge()
    }

    /// Handles an event of the controller.
    pub fn handle_bus(&mut self, event: BusEvent, now: Instant) {
        let is_proof = matches!(event, BusEvent::Received | BusEvent::Acknowledged);
        // Errors are expected in the silent periods of a switch.
        if is_proof || self.is_supervised() {
            self.supervision.handle(event, now);
        }
    }

    /// Records that the node has sent a frame.
    pub fn note_sent(&mut self, now: Instant) {
        self.supervision.note_sent(now);
    }

    /// Begins the switch to the pending bit rate, with two delays of `delay_ms` milliseconds.
    pub fn switch(&mut self, delay_ms: u16, now: Instant) {
        let delay_micros = u32::from(delay_ms) * 1000;
        self.switch = Some(Switch { phase: Phase::Requested, until: now, delay_micros });
    }

    /// Activates `setting`, in the switch that ends at `silent_until`.
    pub fn activate(&mut self, setting: BitRateSetting, silent_until: Instant) {
        match setting {
            BitRateSetting::Fixed(rate) => self.supervision.command(rate, silent_until),
            BitRateSetting::Automatic => self.supervision.detect(),
        }
        self.is_automatic = setting == BitRateSetting::Automatic;
    }

    /// The new bit rate in use, once after a change: the node has become a guest or has returned home.
    pub fn take_change(&mut self) -> Option<BitRate> {
        self.supervision.take_change()
    }

    /// The next step at `now`; `None` if the bit rate requires none and the node may do other work.
    pub fn poll(&mut self, now: Instant) -> Option<Next> {
        if mem::take(&mut self.is_proof_due) {
            self.handle_bus(BusEvent::Received, now);
        }
        // A detection that the switch has begun may complete within it.
        if (self.is_supervised() || self.supervision.has_step())
            && let Some(step) = self.supervision.poll(now)
        {
            self.is_resume_due = self.switch.is_none();
            return Some(Next::Step(step));
        }
        match self.switch {
            Some(switch) if switch.until.has_come(now) => Some(self.advance(switch)),
            Some(_) => Some(Next::KeepSilent),
            None if !self.is_listening() && mem::take(&mut self.is_resume_due) => {
                Some(Next::ResumeTransmitting)
            }
            None => None,
        }
    }

    /// The latest time of the next [`poll`](Self::poll), if nothing else happens before.
    pub fn poll_at(&self) -> Option<Instant> {
        let supervision = self.supervision.poll_at().filter(|_| self.is_supervised());
        Instant::earliest(supervision, self.switch.map(|switch| switch.until))
    }

    /// Ends the phase of the switch that has expired.
    fn advance(&mut self, switch: Switch) -> Next {
        let until = switch.until.plus_micros(switch.delay_micros);
        match switch.phase {
            Phase::Requested => {
                self.switch = Some(Switch { phase: Phase::OldRate, until, ..switch });
                Next::StopTransmitting
            }
            Phase::OldRate => {
                self.switch = Some(Switch { phase: Phase::NewRate, until, ..switch });
                Next::Activate { silent_until: until }
            }
            Phase::NewRate => {
                self.switch = None;
                self.is_resume_due = true;
                Next::EndSwitch
            }
        }
    }

    /// Whether the supervision may act: not during a switch, unless the switch has begun a detection.
    const fn is_supervised(&self) -> bool {
        self.switch.is_none() || self.supervision.is_detecting()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOME: BitRateSetting = BitRateSetting::Fixed(BitRate::Kbit125);

    fn at(ms: u32) -> Instant {
        Instant::from_micros(ms * 1000)
    }

    fn control(is_supervised: bool) -> BitRateControl {
        BitRateControl::new(HOME, BitRates::possible(40_000_000), is_supervised)
    }

    #[test]
    fn a_switch_is_silent_for_both_delays_and_activates_between_them() {
        let mut control = control(false);
        control.switch(10, at(0));
        assert_eq!(control.poll(at(0)), Some(Next::StopTransmitting));
        assert_eq!(
            (control.poll(at(9)), control.poll_at()),
            (Some(Next::KeepSilent), Some(at(10)))
        );
        assert_eq!(control.poll(at(10)), Some(Next::Activate { silent_until: at(20) }));
        control.activate(BitRate::Kbit500.into(), at(20));
        assert_eq!(control.poll(at(10)), Some(Next::Step(Step::TakePart(BitRate::Kbit500))));
        assert_eq!(control.poll(at(19)), Some(Next::KeepSilent));
        assert_eq!(control.poll(at(20)), Some(Next::EndSwitch));
        assert_eq!(control.poll(at(20)), Some(Next::ResumeTransmitting));
        assert_eq!((control.poll(at(20)), control.is_switching()), (None, false));
        assert_eq!(
            (control.in_use(), control.active()),
            (BitRate::Kbit500, BitRate::Kbit500.into())
        );
    }

    #[test]
    fn errors_within_a_switch_do_not_count() {
        let mut control = control(true);
        control.switch(10, at(0));
        for _ in 0..100 {
            control.handle_bus(BusEvent::Error, at(1));
        }
        assert_eq!(control.poll(at(1)), Some(Next::StopTransmitting));
        assert_eq!(control.poll(at(9)), Some(Next::KeepSilent));
        assert!(!control.is_listening());
    }

    #[test]
    fn the_active_rate_follows_what_was_found_and_automatic_stays() {
        let mut control = control(true);
        control.handle_bus(BusEvent::Error, at(0));
        assert_eq!(control.poll(at(0)), Some(Next::Step(Step::Listen(BitRate::Kbit1000))));
        assert!(control.is_listening() && !control.may_send());
        control.handle_bus(BusEvent::Received, at(1));
        assert_eq!(control.take_change(), Some(BitRate::Kbit1000));
        assert_eq!(control.active(), BitRate::Kbit1000.into());
        assert_eq!(control.home(), Some(BitRate::Kbit125));
        control.activate(BitRateSetting::Automatic, at(2));
        control.handle_bus(BusEvent::Received, at(3));
        assert_eq!(control.active(), BitRateSetting::Automatic);
        assert_eq!(control.home(), Some(BitRate::Kbit1000));
    }

    #[test]
    fn a_frame_heard_in_silence_is_not_served_for_its_sender_repeats_it() {
        let frame = Frame::new(0x7E5, &[0; 8]).expect("a frame");
        assert!(control(true).handle_frame(&frame, at(0)));
        let mut listening =
            BitRateControl::new(BitRateSetting::Automatic, BitRates::possible(40_000_000), true);
        assert!(!listening.handle_frame(&frame, at(0)));
    }
}
