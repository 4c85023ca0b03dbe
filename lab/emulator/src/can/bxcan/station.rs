//! The peripheral's reaction to events of the bus.

use super::{
    Bxcan, Controller, Event, Frame, Peripheral, Station,
    mailbox::{ALST, TERR},
    registers::*,
};
use crate::Time;

impl Bxcan {
    /// Whether a mailbox was chosen on an idle bus. It is sent next, whatever is requested before its SOF (RM0090,
    /// 32.7.1 and figure 342, as read with confidence 0.85).
    pub(super) fn has_chosen(&self) -> bool {
        self.controller.is_starting() && !self.behaviour.variant.late_choice
    }

    /// Offers the next mailbox's frame to the controller.
    pub(super) fn offer(&mut self) {
        if self.has_chosen() {
            return;
        }
        let aborted = self.mailboxes.finish_aborts();
        self.note_aborted(aborted, self.controller.now());
        match self.mailboxes.schedule(self.mcr & MCR_TXFP != 0) {
            Some((frame, since)) => self.controller.offer(Some(frame), since),
            None => self.controller.offer(None, Time::ZERO),
        }
    }

    fn transmission_failed(&mut self, reason: u32) {
        self.mailboxes.failed(reason, self.mcr & MCR_NART != 0);
        self.offer();
    }

    fn received(&mut self, frame: &Frame) {
        let indices = self.filters.accept(frame, self.behaviour.variant.both_fifos);
        let stamp = self.stamp().unwrap_or(0);
        for (fifo, index) in self.fifos.iter_mut().zip(indices) {
            if let Some(index) = index {
                fifo.push(frame, index, stamp, self.mcr & MCR_RFLM != 0);
            }
        }
    }

    /// With TTCM: bit times from the start of normal mode to the sample point of the current SOF (RM0090, 32.7.2).
    fn stamp(&self) -> Option<u16> {
        let passed = self.controller.start_of_frame_sample().saturating_sub(self.counts_from);
        let bit = self.controller.bit_time().as_ps();
        (self.mcr & MCR_TTCM != 0).then(|| (passed.as_ps() / bit) as u16)
    }

    /// Raises ERRI for rising flags of ESR and, if an error was detected, for its code.
    pub(super) fn latch_errors(&mut self, error: bool) {
        let variant = self.behaviour.variant;
        let flags = self.flags();
        let risen = flags & !std::mem::replace(&mut self.error_flags, flags);
        let stands = |flag, enable| flags & flag != 0 && self.ier & enable != 0;
        let asks = |flag, enable| risen & flag != 0 && self.ier & enable != 0;
        if asks(ESR_EWGF, IER_EWGIE)
            || asks(ESR_EPVF, IER_EPVIE)
            || asks(ESR_BOFF, IER_BOFIE)
            || (error && self.ier & IER_LECIE != 0)
            || (error && variant.passive_errors_interrupt && stands(ESR_EPVF, IER_EPVIE))
            || (variant.bus_off_holds_interrupt && stands(ESR_BOFF, IER_BOFIE))
        {
            self.latched |= MSR_ERRI;
        }
    }
}

impl Station for Bxcan {
    fn controller(&mut self) -> &mut Controller {
        &mut self.controller
    }

    fn handle(&mut self, event: &Event, now: Time) -> bool {
        match *event {
            Event::Started => self.mailboxes.started(),
            Event::Transmitted { .. } => {
                self.lec = 0;
                self.mailboxes.transmitted(self.stamp());
                self.offer();
            }
            Event::ArbitrationLost => self.transmission_failed(ALST),
            Event::Received(frame) => {
                self.lec = 0;
                self.received(&frame);
                self.offer();
            }
            Event::Error { kind, transmitting } => {
                self.lec = kind.code() << 4;
                if transmitting {
                    self.transmission_failed(TERR);
                } else {
                    self.offer();
                }
            }
            Event::BusOff if self.mcr & MCR_ABOM != 0 => self.controller.recover(now),
            Event::Joined | Event::Stopped => self.follow_request(now),
            Event::Activity => {
                self.latched |= MSR_WKUI;
                if self.mcr & MCR_AWUM != 0 {
                    self.mcr &= !MCR_SLEEP;
                    self.follow_request(now);
                }
            }
            Event::BusOff | Event::BusIdle | Event::Recovered | Event::CounterRaised => {}
        }
        let is_frame = matches!(event, Event::Received(_) | Event::Error { .. });
        if is_frame && self.controller.mode().silent && self.behaviour.locks() {
            self.controller.lock_transmit_pin(now);
        }
        self.latch_errors(matches!(event, Event::Error { .. }));
        self.irq_changes()
    }
}
