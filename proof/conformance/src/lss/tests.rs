//! The cases find what is wrong: a small slave in memory, right and with one fault each.

use std::{collections::VecDeque, time::Duration};

use canopen_node::{BitRate, Frame, lss::Address};

use super::{Feature, LSS, NO_NODE_ID, Target, padded, with};
use crate::{Bench, Broken, Line, Report, eds::Eds, ms};

const STORED: u8 = 9;
const ADDRESS: [u32; 4] = [0x1234, 0x5678, 0x0001_0001, 0x8000_1E00];

#[derive(Clone, Copy, PartialEq, Eq)]
enum Fault {
    None,
    /// 5E is answered in waiting too.
    AnswersInWaiting,
    /// The boot-up after a change of the node-ID has the next COB-ID.
    NextBootUp,
    /// Short frames are filled up with zeros.
    ShortFrames,
    /// Node-ID 0 is accepted.
    AcceptsZero,
    /// The parts of a select count in any order.
    AnyOrder,
    /// Answers repeat the reserved bytes of the request.
    Echo,
    /// NMT reset communication leaves the LSS state alone.
    KeepsState,
}

/// A slave with the services that every device must have, and its line.
struct Fake {
    fault: Fault,
    now: Duration,
    sent: VecDeque<(Duration, Frame)>,
    is_configuring: bool,
    /// The parts of a select so far, the lowest bit for the vendor-ID.
    parts: u8,
    active: u8,
    pending: u8,
}

impl Fake {
    fn transmit(&mut self, cob_id: u16, data: &[u8]) {
        let frame = Frame::new(cob_id, data).expect("at most eight bytes");
        self.sent.push_back((self.now + Duration::from_micros(300), frame));
    }

    fn start(&mut self) {
        let has_changed = self.active != self.pending;
        self.active = self.pending;
        self.parts = 0;
        if self.fault != Fault::KeepsState {
            self.is_configuring = false;
        }
        if self.active != NO_NODE_ID {
            let is_wrong = self.fault == Fault::NextBootUp && has_changed;
            self.transmit(0x700 + u16::from(self.active) + u16::from(is_wrong), &[0]);
        }
    }

    fn answer(&mut self, request: [u8; 8], answer: &[u8]) {
        let mut bytes = padded(answer);
        if self.fault == Fault::Echo {
            bytes[answer.len()..].copy_from_slice(&request[answer.len()..]);
        }
        self.transmit(0x7E4, &bytes);
    }

    fn select(&mut self, request: [u8; 8]) {
        let part = usize::from(request[0] - 0x40);
        let is_in_order = self.fault == Fault::AnyOrder || self.parts == (1 << part) - 1;
        let is_right = request[..5] == with(request[0], ADDRESS[part]);
        match is_right && (is_in_order || part == 0) {
            true if part == 0 && self.fault != Fault::AnyOrder => self.parts = 1,
            true => self.parts |= 1 << part,
            false => self.parts = 0,
        }
        if self.parts == 0b1111 {
            self.parts = 0;
            self.is_configuring = true;
            self.answer(request, &[0x44]);
        }
    }

    fn handle(&mut self, request: [u8; 8]) {
        match (request[0], self.is_configuring) {
            (0x04, _) if request[1] < 2 => {
                self.is_configuring = request[1] == 1;
                self.parts = 0;
                if !self.is_configuring && self.active == NO_NODE_ID && self.pending != NO_NODE_ID {
                    self.start();
                }
            }
            (0x40..=0x43, false) => self.select(request),
            (0x11, true) => {
                let id = request[1];
                let is_zero_good = self.fault == Fault::AcceptsZero && id == 0;
                let is_good = matches!(id, 1..=127 | NO_NODE_ID) || is_zero_good;
                if is_good {
                    self.pending = id;
                }
                self.answer(request, &[0x11, u8::from(!is_good)]);
            }
            (command @ 0x5A..=0x5D, true) => {
                self.answer(request, &with(command, ADDRESS[usize::from(command - 0x5A)]));
            }
            (0x5E, is_configuring) if is_configuring || self.fault == Fault::AnswersInWaiting => {
                self.answer(request, &[0x5E, self.active]);
            }
            _ => {}
        }
    }
}

impl Line for Fake {
    fn now(&self) -> Duration {
        self.now
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Broken> {
        match (frame.cob_id(), frame.data()) {
            (0x7E5, data) if data.len() == 8 || self.fault == Fault::ShortFrames => {
                self.handle(padded(data));
            }
            (0, [command @ (0x81 | 0x82), node]) if *node == 0 || *node == self.active => {
                if *command == 0x81 {
                    self.pending = STORED;
                }
                self.start();
            }
            _ => {}
        }
        Ok(())
    }

    fn receive(&mut self, until: Duration) -> Result<Option<(Duration, Frame)>, Broken> {
        let frame = self.sent.pop_front_if(|(time, _)| *time <= until);
        self.now = self.now.max(frame.map_or(until, |(time, _)| time));
        Ok(frame)
    }

    fn jitter(&self) -> Duration {
        ms(0)
    }
}

/// The numbers of the cases that fail.
fn failed(fault: Fault) -> Vec<String> {
    let mut line = Fake {
        fault,
        now: ms(0),
        sent: VecDeque::new(),
        is_configuring: false,
        parts: 0,
        active: STORED,
        pending: STORED,
    };
    let eds = Eds::default();
    let mut bench = Bench::new(&mut line, &eds, 5);
    let mut without = Feature::ALL.map(|(feature, _)| feature).to_vec();
    without.retain(|feature| *feature != Feature::Further);
    bench.lss = Target::new(vec![Address::from(ADDRESS)], BitRate::Kbit125, without);
    let mut report = Report::new("a slave in memory");
    crate::run(&mut bench, LSS, &[], &mut report, |_| {}).expect("the line does not break");
    assert!(report.passed() > 20, "{}", report.summary());
    let is_failed =
        |finding: &&crate::Finding| matches!(finding.outcome, crate::Outcome::Failed(_));
    report.findings.iter().filter(is_failed).map(|finding| finding.number.clone()).collect()
}

#[test]
fn a_right_slave_fails_no_case() {
    assert_eq!(failed(Fault::None), Vec::<String>::new());
}

#[test]
fn each_fault_fails_the_cases_about_it() {
    let find = |fault, numbers: &[&str]| assert_eq!(failed(fault), numbers);
    find(
        Fault::NextBootUp,
        &[
            "LSS unconfigured 05",
            "LSS node-ID 03",
            "LSS node-ID 05",
            "LSS node-ID 06",
            "LSS node-ID 07",
            "LSS further 13",
        ],
    );
    find(Fault::ShortFrames, &["LSS frames 01"]);
    find(Fault::AcceptsZero, &["LSS node-ID 02", "LSS node-ID 03"]);
    find(Fault::AnyOrder, &["LSS states 04", "LSS further 01"]);
    find(Fault::KeepsState, &["LSS states 12", "LSS states 13"]);
    let echo = failed(Fault::Echo);
    assert!(echo.contains(&"LSS frames 06".into()), "{echo:?}");
    let waiting = failed(Fault::AnswersInWaiting);
    assert!(waiting.contains(&"LSS states 01".into()), "{waiting:?}");
    assert!(waiting.contains(&"LSS states 09".into()), "{waiting:?}");
}
