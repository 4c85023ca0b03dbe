//! The bus, the person, and the place of the results, as a command has them.

use std::{
    io::{self, Write},
    sync::{Arc, atomic::AtomicBool},
    time::Duration,
};

use can_bus::{
    adapter::Adapter,
    bus::Bus,
    person::{PATIENCE, Person},
};
use canopen_node::{
    BitRate, NodeId,
    lss::{Address, Request},
};
use lss_master::{InquireNodeId, Procedure, SelectAlone};
use serde::Serialize;

use crate::{
    arguments::Arguments,
    failure::Result,
    progress::{Progress, Shows},
    recorder::{self, Record},
};

/// The bit rate of new boards.
pub const DEFAULT_RATE: BitRate = BitRate::Kbit125;

/// The answer time from which on a slave is slow.
const SLOW: Duration = Duration::from_millis(50);

/// The time between two looks at what the person writes.
pub const GLANCE: Duration = Duration::from_millis(50);

/// The width and the height of the terminal in characters.
pub type Screen = fn() -> (u16, u16);

/// The bus, and where the results go.
pub struct Session {
    pub bus: Bus,
    pub out: Box<dyn Write>,
    pub progress: Progress,
    pub person: Person,
    /// The terminal that the results go to; `None` if they go elsewhere.
    pub screen: Option<Screen>,
    /// All boards are in LSS waiting state, and no request follows.
    pub all_wait: bool,
    /// The answer time of a slow slave that the person was told of.
    pub slow_answer: Option<Duration>,
    /// The serial numbers that the person was told to be there twice.
    pub twice: Vec<u32>,
    /// What a command has found or done, as JSON.
    pub result: String,
    /// What the person was told of the adapter.
    pub remarks: Vec<String>,
    /// What the adapter did, for a picture.
    pub record: Option<Record>,
}

impl Session {
    /// A session on this adapter, whose results go to `out`.
    pub fn new(
        adapter: Box<dyn Adapter>,
        arguments: &Arguments,
        is_interrupted: Arc<AtomicBool>,
        out: Box<dyn Write>,
        shows: Shows,
    ) -> Result<Self> {
        let latency = Duration::from_millis(arguments.latency.into());
        let mut bus = Bus::new(adapter, latency, is_interrupted);
        Ok(Self {
            record: recorder::record(&mut bus, arguments)?,
            bus,
            out,
            progress: Progress::new(shows),
            person: Person::absent(),
            screen: None,
            all_wait: false,
            slow_answer: None,
            twice: Vec::new(),
            result: String::new(),
            remarks: Vec::new(),
        })
    }

    /// Asks the person on the standard error, with all boards in LSS waiting state; `None` if nobody answers.
    pub fn ask(&mut self, question: &str) -> Result<Option<String>> {
        if !self.person.is_present() {
            return Ok(None);
        }
        self.bus.request(Request::SwitchToWaiting)?;
        self.progress.clear();
        eprintln!("{question}");
        let Self { bus, person, .. } = self;
        let until = bus.time() + PATIENCE;
        person.answer(|| -> Result<bool> {
            bus.pass(GLANCE)?;
            Ok(bus.time() < until)
        })
    }

    /// Notes what a command has found or done, which `--json` prints in place of all words.
    pub fn found(&mut self, result: &impl Serialize) -> Result {
        self.result = serde_json::to_string_pretty(result).map_err(io::Error::from)?;
        Ok(())
    }

    /// Tells the person what must be known of the adapter.
    pub fn remark(&mut self) {
        for remark in self.bus.remarks() {
            if !self.remarks.contains(&remark) {
                self.progress.note(&format!("note: {remark}"));
                self.remarks.push(remark);
            }
        }
    }

    /// Lets a Ctrl-C wait until the work is done.
    pub fn uninterrupted<T>(&mut self, work: impl FnOnce(&mut Self) -> Result<T>) -> Result<T> {
        self.bus.check_interrupt()?;
        self.bus.hold_interrupt(true);
        let outcome = work(self);
        self.bus.hold_interrupt(false);
        outcome
    }

    /// Brings all boards to LSS waiting state, also after Ctrl-C, as far as the adapter still works.
    pub fn end(&mut self) {
        self.bus.insist();
        let _ = self.bus.request(Request::SwitchToWaiting).and_then(|()| self.bus.flush());
    }

    /// Brings a board to LSS configuration state, and all others to LSS waiting state; returns its node-ID.
    pub fn select(&mut self, address: Address) -> Result<Option<NodeId>> {
        self.carry_out(SelectAlone::new(address))?;
        self.carry_out(InquireNodeId)
    }

    /// Carries out a procedure of the LSS master.
    pub fn carry_out<P: Procedure>(&mut self, procedure: P) -> Result<P::Output> {
        let outcome = self.bus.carry_out(procedure)?;
        if let Some(number) = self.bus.serial_number_twice()
            && !self.twice.contains(&number)
        {
            self.twice.push(number);
            self.progress.note(&format!(
                "serial number {number:08X}: a second answer to one question. Two boards have this LSS address, or \
                 the board or the adapter repeats it"
            ));
        }
        let slowest = self.bus.slowest_answer().unwrap_or_default();
        if slowest > SLOW.max(2 * self.slow_answer.unwrap_or_default()) {
            self.slow_answer = Some(slowest);
            let ms = slowest.as_millis();
            self.progress.note(&format!(
                "a slave takes {ms} ms to answer: each question waits as long for it"
            ));
        }
        Ok(outcome?)
    }
}
