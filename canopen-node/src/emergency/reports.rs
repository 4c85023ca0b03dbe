//! The errors with codes of their own: those of the application and of process data.

use core::fmt;

use super::{COB_ID, Faults, GENERIC};
use crate::{Frame, NodeId};

/// The errors that are present or whose message has not been sent.
#[derive(Clone, Debug)]
pub(crate) struct Reports<L> {
    reports: L,
    /// All places are free. It saves the search at each poll, and becomes true with an acknowledge.
    is_empty: bool,
}

/// The places for the errors of an application: eight, or none.
pub trait Places: Clone + fmt::Debug {
    /// The number of places.
    const NUMBER: usize;
    /// Free places.
    const FREE: Self;
    /// All places.
    fn all(&self) -> &[Report];
    /// All places, to be changed.
    fn all_mut(&mut self) -> &mut [Report];
}

impl<const N: usize> Places for [Report; N] {
    const NUMBER: usize = N;
    const FREE: Self = [Report::FREE; N];

    fn all(&self) -> &[Report] {
        self
    }

    fn all_mut(&mut self) -> &mut [Report] {
        self
    }
}

/// A place for an error of an application.
#[derive(Clone, Copy, Debug)]
pub struct Report {
    code: u16,
    register: u8,
    information: [u8; 5],
    is_present: bool,
    message: Message,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Message {
    Sent,
    Unsent,
    /// It was sent after the latest acknowledge.
    InFlight,
}

impl Report {
    const FREE: Self = Self {
        code: 0,
        register: 0,
        information: [0; 5],
        is_present: false,
        message: Message::Sent,
    };

    const fn is_free(&self) -> bool {
        !self.is_present && matches!(self.message, Message::Sent)
    }
}

impl<L: Places> Reports<L> {
    pub const fn new() -> Self {
        Self { reports: L::FREE, is_empty: true }
    }

    /// Whether there is neither an error nor a message.
    pub const fn is_empty(&self) -> bool {
        L::NUMBER == 0 || self.is_empty
    }

    /// The error register 1001h for the errors that are present.
    pub fn error_register(&self) -> u8 {
        if self.is_empty() {
            return 0;
        }
        let present = self.reports.all().iter().filter(|report| report.is_present);
        present.fold(0, |register, report| register | report.register)
    }

    /// The errors, to be reported and ended.
    pub fn reporter<'a>(&'a mut self, faults: &'a mut Faults) -> Reporter<'a> {
        Reporter { faults, reports: self.reports.all_mut(), is_empty: &mut self.is_empty }
    }

    /// Records that a frame of the node was acknowledged.
    pub fn note_acknowledge(&mut self) {
        if !self.is_empty() {
            self.replace(Message::InFlight, Message::Sent);
            self.is_empty = self.reports.all().iter().all(Report::is_free);
        }
    }

    /// Records that the pending frames were dropped: messages that were not acknowledged are sent again.
    pub fn note_dropped(&mut self) {
        self.replace(Message::InFlight, Message::Unsent);
    }

    fn replace(&mut self, from: Message, to: Message) {
        for report in self.reports.all_mut() {
            if report.message == from {
                report.message = to;
            }
        }
    }

    /// The next message, if there is one to send; `others` is the error register for the other errors.
    pub fn next(&mut self, node: NodeId, others: u8) -> Option<Frame> {
        if self.is_empty() {
            return None;
        }
        let present = self.error_register();
        let report =
            self.reports.all_mut().iter_mut().find(|report| report.message == Message::Unsent)?;
        report.message = Message::InFlight;
        let [c0, c1] = report.code.to_le_bytes();
        let [i0, i1, i2, i3, i4] = report.information;
        let register = report.register | present | others;
        let data = [c0, c1, register, i0, i1, i2, i3, i4];
        Some(Frame::with_eight_bytes(COB_ID + u16::from(node.get()), data))
    }
}

/// The emergency messages of a node, to report errors with codes of their own.
pub(crate) struct Reporter<'a> {
    faults: &'a mut Faults,
    reports: &'a mut [Report],
    is_empty: &'a mut bool,
}

impl Reporter<'_> {
    /// Reports an error, with bits of the error register and the manufacturer's bytes. The history has one entry per
    /// message; without a free place the error is only kept there.
    pub fn report(&mut self, code: u16, register: u8, information: [u8; 5]) {
        let [i0, i1, ..] = information;
        let is_same = |report: &&mut Report| report.code == code && !report.is_free();
        let place = match self.reports.iter_mut().find(is_same) {
            None => self.reports.iter_mut().find(|report| report.is_free()),
            same => same,
        };
        let is_waiting = place.as_ref().is_some_and(|place| place.message == Message::Unsent);
        if let Some(place) = place {
            *self.is_empty = false;
            let register = register | GENERIC;
            *place =
                Report { code, register, information, is_present: true, message: Message::Unsent };
        }
        if !is_waiting {
            self.faults.enter(u32::from(code) | u32::from(i0) << 16 | u32::from(i1) << 24);
        }
    }

    /// Whether no error is present.
    pub const fn is_empty(&self) -> bool {
        *self.is_empty
    }

    /// Ends an error; does nothing if it is not present.
    pub fn end(&mut self, code: u16) {
        let is_it = |report: &&mut Report| report.code == code && report.is_present;
        if let Some(report) = self.reports.iter_mut().find(is_it) {
            report.is_present = false;
            self.faults.note_end();
        }
    }
}
