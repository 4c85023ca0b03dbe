//! Control of the bit rate: the switch with its two delays, the supervision, and the permission to send frames.

use core::mem;

use super::{
    BitRate, BitRateSetting, BitRates, BusEvent,
    supervision::{Step, Supervision},
};
use crate::{Frame, Instant, cob_id, lss};

/// The bit rates of the node (in use, active and home) and the switch to another.
#[derive(Clone, Debug)]
pub struct Control {
    supervision: Supervision,
    /// The active setting is automatic detection.
    is_automatic: bool,
    switch: Option<Switch>,
    /// See [`is_settled`](Self::is_settled).
    is_settled: bool,
    /// See [`needs_all_frames`](Self::needs_all_frames).
    needs_all_frames: bool,
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

/// The slave's next step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub(crate) enum Next {
    /// The pending bit rate must be activated, see [`Control::activate`].
    Activate {
        /// The end of the switch.
        silent_until: Instant,
    },
    /// A step, which drops the pending frames.
    Step(Step),
    /// The home rate is proven: only the frames for the node matter from now on.
    Settled,
}

impl Control {
    /// The control of a node that offers these rates and was powered on with this setting.
    pub(crate) const fn new(setting: BitRateSetting, rates: BitRates) -> Self {
        Self {
            supervision: Supervision::new(setting, rates),
            is_automatic: matches!(setting, BitRateSetting::Automatic),
            switch: None,
            is_settled: false,
            needs_all_frames: matches!(setting, BitRateSetting::Automatic),
        }
    }

    /// Adds the search from an unproven home rate. The serial number keeps several nodes from acting at the same time.
    #[cfg(feature = "rescue")]
    #[must_use]
    pub(crate) const fn with_rescue(self, serial_number: u32) -> Self {
        let supervision = self.supervision.with_rescue(serial_number);
        Self { supervision, needs_all_frames: true, ..self }
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

    /// Whether the rate was commanded so recently that no other is used.
    pub const fn is_trusted(&self) -> bool {
        self.supervision.is_trusted()
    }

    /// Whether a switch is in progress.
    pub const fn is_switching(&self) -> bool {
        self.switch.is_some()
    }

    /// Whether the supervision allows frames to be sent.
    pub const fn may_send(&self) -> bool {
        self.supervision.may_send()
    }

    /// Whether the node may report itself by a boot-up or an emergency message. A guest does so once it was asked.
    pub const fn may_report(&self) -> bool {
        self.supervision.may_report()
    }

    /// Whether the node is a guest at a rate that it has found. It only answers requests there, and sends no heartbeat.
    pub const fn is_guest(&self) -> bool {
        self.supervision.is_guest()
    }

    /// Whether the home rate is proven and no switch runs. Until the next switch no frame, event or
    /// time makes a difference.
    pub const fn is_settled(&self) -> bool {
        self.is_settled
    }

    /// Whether frames for others make a difference too, since the home rate is not proven.
    pub const fn needs_all_frames(&self) -> bool {
        self.needs_all_frames
    }

    /// Handles a received frame and returns whether it may be served.
    pub(crate) fn handle_frame(&mut self, frame: &Frame, now: Instant) -> bool {
        // The sender may be lost like this node and repeat its boot-up until someone acknowledges it.
        if self.supervision.is_elsewhere() && is_boot_up(frame) {
            return false;
        }
        // A sender repeats its frame until someone acknowledges it.
        let is_acknowledged = !self.is_listening();
        self.handle_bus(BusEvent::Received, now);
        is_acknowledged
    }

    /// Handles an event of the controller.
    pub(crate) fn handle_bus(&mut self, event: BusEvent, now: Instant) {
        let is_proof = matches!(event, BusEvent::Received | BusEvent::Acknowledged);
        // Errors are expected in the silent periods of a switch.
        if is_proof || self.is_supervised() {
            self.supervision.handle(event, now);
        }
    }

    /// Records that the node has sent a frame.
    #[inline(never)] // A settled slave does not call it.
    pub(crate) fn note_sent(&mut self, now: Instant) {
        self.supervision.note_sent(now);
    }

    /// Records a request that the node will answer: as a guest it may report itself before.
    pub(crate) const fn note_asked(&mut self) {
        self.supervision.note_asked();
    }

    /// Begins the switch to the pending bit rate, with two delays of `delay_ms` milliseconds.
    pub(crate) fn switch(&mut self, delay_ms: u16, now: Instant) {
        let delay_micros = u32::from(delay_ms) * 1000;
        self.is_settled = false;
        self.switch = Some(Switch { phase: Phase::Requested, until: now, delay_micros });
    }

    /// Activates `setting`, in the switch that ends at `silent_until`. A detection that continues keeps its result.
    pub(crate) fn activate(&mut self, setting: BitRateSetting, silent_until: Instant) {
        match setting {
            BitRateSetting::Fixed(rate) => self.supervision.command(rate, silent_until),
            BitRateSetting::Automatic if self.is_automatic => {}
            BitRateSetting::Automatic => self.supervision.detect(),
        }
        self.is_automatic = setting == BitRateSetting::Automatic;
    }

    /// The new bit rate in use, once after a change: the node has become a guest or has returned home.
    pub(crate) fn take_change(&mut self) -> Option<BitRate> {
        self.supervision.take_change()
    }

    /// The next step at `now` in this LSS state; `None` if there is none, as in the silence of a switch.
    pub(crate) fn poll(&mut self, state: lss::State, now: Instant) -> Option<Next> {
        self.supervision.note_session(state == lss::State::Configuration);
        let expired = self.switch.filter(|switch| switch.until.has_come(now));
        if expired.is_some_and(|switch| matches!(switch.phase, Phase::NewRate)) {
            self.switch = None;
        }
        // A detection that the switch has begun may complete within it.
        if (self.is_supervised() || self.supervision.has_step())
            && let Some(step) = self.supervision.poll(now)
        {
            self.needs_all_frames = !self.supervision.is_settled();
            return Some(Next::Step(step));
        }
        if self.switch.is_some() {
            return self.advance(expired?);
        }
        self.is_settled = self.supervision.is_settled();
        let has_settled = self.is_settled && mem::take(&mut self.needs_all_frames);
        has_settled.then_some(Next::Settled)
    }

    /// The latest time of the next [`poll`](Self::poll), if nothing else happens before.
    pub(crate) fn poll_at(&self) -> Option<Instant> {
        let supervision = self.supervision.poll_at().filter(|_| self.is_supervised());
        Instant::earliest(supervision, self.switch.map(|switch| switch.until))
    }

    /// Begins the next phase of a switch.
    fn advance(&mut self, switch: Switch) -> Option<Next> {
        let until = switch.until.plus_micros(switch.delay_micros);
        let (phase, next) = match switch.phase {
            Phase::Requested => (Phase::OldRate, Next::Step(Step::DropFrames)),
            Phase::OldRate => (Phase::NewRate, Next::Activate { silent_until: until }),
            Phase::NewRate => return None,
        };
        self.switch = Some(Switch { phase, until, ..switch });
        Some(next)
    }

    /// Whether the supervision may act: not during a switch, unless the switch has begun a detection.
    const fn is_supervised(&self) -> bool {
        self.switch.is_none() || self.supervision.is_detecting()
    }
}

/// Whether the frame is the boot-up of a node.
fn is_boot_up(frame: &Frame) -> bool {
    frame.cob_id() & !0x7F == cob_id::ERROR_CONTROL && matches!(frame.data(), [0])
}
