//! Findings: actions of the firmware that the emulated chip does not model or that a real chip would not tolerate.

use core::fmt;

use super::{Access, Chip, Width};
use crate::Time;

/// A kind of problem at one place in the program; repetitions are counted, not listed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// The time of the first occurrence.
    pub time: Time,
    pub pc: u32,
    pub address: u32,
    pub width: Width,
    pub write: bool,
    /// The value written, or 0 for a read.
    pub value: u32,
    pub problem: Problem,
    pub count: u64,
}

/// A problem with an access.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Problem {
    /// The emulator has no such register: a read returned 0, or a write was lost.
    Unmodelled,
    /// The peripheral's clock is off in RCC: a real chip reads 0 and loses the write.
    ClockOff,
    /// The register does not support this access width.
    Width,
    /// A wrong key: the bus responds with an error.
    BusFault,
    /// Executed, but not allowed by the reference manual: the text is the reason.
    Misuse(&'static str),
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Unmodelled => "not modelled",
            Self::ClockOff => "peripheral clock is off",
            Self::Width => "access width not allowed",
            Self::BusFault => "bus error",
            Self::Misuse(why) => why,
        })
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { time, pc, address, width, write, value, problem, count } = self;
        let bits = 8 * width.bytes();
        write!(f, "{time} ms, pc {pc:08x}: ")?;
        if *write {
            write!(f, "{bits}-bit write of {value:#x} to {address:08x}: {problem}")?;
        } else {
            write!(f, "{bits}-bit read of {address:08x}: {problem}")?;
        }
        if *count > 1 {
            write!(f, " ({count} times)")?;
        }
        Ok(())
    }
}

impl Chip {
    /// Adds a finding of the chip or of the engine that runs its core; `written` is the value of a store.
    pub fn report(&mut self, access: Access, written: Option<u32>, problem: Problem) {
        let Access { address, width, now, pc } = access;
        let write = written.is_some();
        let same = |f: &&mut Finding| {
            (f.pc, f.address, f.write, f.problem) == (pc, address, write, problem)
        };
        if let Some(finding) = self.findings.iter_mut().find(same) {
            finding.count += 1;
            return;
        }
        let value = written.unwrap_or(0);
        let first = Finding { time: now, pc, address, width, write, value, problem, count: 1 };
        self.findings.push(first);
    }
}
