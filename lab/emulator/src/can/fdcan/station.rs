//! The peripheral's reaction to events of the bus.

use super::{Fdcan, Peripheral, registers::*};
use crate::{
    Time,
    can::{Controller, ErrorKind, Event, Frame, Id, Note, Station},
};

impl Fdcan {
    /// Offers the next buffer's frame to the controller.
    pub(super) fn offer(&mut self) {
        if self.controller.is_starting() {
            return;
        }
        // What waited for a start of transmission that did not happen.
        let waiting = super::bits(self.cancelling);
        let sending = self.requests.spared(false);
        for buffer in waiting.filter(|&buffer| sending != Some(buffer)).collect::<Vec<_>>() {
            self.withdraw(buffer, self.controller.now());
        }
        match self.requests.schedule(self.is_fifo_mode()) {
            Some((frame, since)) => self.controller.offer(Some(frame), since),
            None => self.controller.offer(None, Time::ZERO),
        }
    }

    fn sent(&mut self) {
        self.lec = 0;
        if let Some(buffer) = self.requests.ended() {
            let in_spite = self.cancelling >> buffer & 1 == 1;
            if self.memory.buffer(buffer).wants_event {
                self.add_event(buffer, in_spite);
            }
            self.complete(buffer, true);
        }
    }

    fn add_event(&mut self, buffer: usize, in_spite: bool) {
        let Some(element) = self.events.push(false) else { return self.raise(IR_TEFL) };
        let stamp = self.stamp(self.controller.start_of_frame_sample());
        self.memory.store_event(element, buffer, in_spite, stamp);
        self.raise(IR_TEFN | if self.events.is_full() { IR_TEFF } else { 0 });
    }

    fn failed(&mut self) {
        let Some(buffer) = self.requests.ended() else { return };
        if self.has(CCCR_DAR) || self.cancelling >> buffer & 1 == 1 {
            self.complete(buffer, false);
        }
    }

    fn received(&mut self, frame: &Frame) {
        self.lec = 0;
        let accepted = self.accept(frame);
        let Some(fifo) = accepted.fifo else {
            return self.raise(if accepted.has_priority { IR_HPM } else { 0 });
        };
        let shift = IR_FIFO_1 * fifo;
        let overwrites = self.reg(RXGFC) & RXGFC_F0OM >> fifo != 0;
        let was_full = self.received[fifo].is_full();
        let Some(element) = self.received[fifo].push(overwrites) else {
            return self.raise(RFL << shift);
        };
        let stamp = self.stamp(self.controller.start_of_frame_sample());
        self.memory.store(fifo, element, frame, accepted.filter, stamp);
        let is_full = self.received[fifo].is_full() && !was_full;
        self.raise((RFN | if is_full { RFF } else { 0 }) << shift);
        if accepted.has_priority {
            *self.reg_mut(HPMS) = high_priority(frame, fifo, element, accepted.filter);
            self.raise(IR_HPM);
        }
    }

    fn log_error(&mut self, kind: ErrorKind) {
        self.lec = kind.code();
        self.raise(IR_PEA);
        if self.errors_logged == 0xFF {
            self.raise(IR_ELO);
        }
        self.errors_logged = (self.errors_logged + 1).min(0xFF);
    }

    /// Raises the interrupts for changes of EP, EW and BO.
    fn latch_status(&mut self) {
        let status = self.flags();
        let changed = status ^ std::mem::replace(&mut self.status, status);
        for (flag, interrupt) in [(PSR_EP, IR_EP), (PSR_EW, IR_EW), (PSR_BO, IR_BO)] {
            self.raise(if changed & flag == 0 { 0 } else { interrupt });
        }
    }
}

/// HPMS.
fn high_priority(frame: &Frame, fifo: usize, element: usize, filter: Option<u32>) -> u32 {
    let is_extended = matches!(frame.id, Id::Extended(_));
    element as u32
        | (2 + fifo as u32) << 6
        | filter.unwrap_or(0) << 8
        | u32::from(is_extended) << 15
}

impl Station for Fdcan {
    fn controller(&mut self) -> &mut Controller {
        &mut self.controller
    }

    fn handle(&mut self, event: &Event, now: Time) -> bool {
        match *event {
            Event::Started => self.requests.started(),
            Event::Transmitted { .. } => self.sent(),
            Event::ArbitrationLost => self.failed(),
            Event::Received(frame) => self.received(&frame),
            Event::Error { kind, transmitting } => {
                self.log_error(kind);
                if transmitting {
                    self.failed();
                }
            }
            // Only the program lets the recovery begin (RM0440 44.4.7).
            Event::BusOff => {
                *self.reg_mut(CCCR) |= CCCR_INIT;
                self.notes.push((now, Note::InitializationEntered));
            }
            Event::BusIdle => self.lec = ErrorKind::BitDominant.code(),
            Event::Recovered
            | Event::CounterRaised
            | Event::Joined
            | Event::Stopped
            | Event::Activity => {}
        }
        let frees_the_bus = matches!(
            event,
            Event::Transmitted { .. }
                | Event::ArbitrationLost
                | Event::Received(_)
                | Event::Error { .. }
        );
        if frees_the_bus {
            self.offer();
        }
        self.latch_status();
        self.irq_changes()
    }
}
