//! The program's side: the objects while it runs, its trial, and the way back to the loader.

use crate::{
    Abort, Area, Flash, Mailbox, Object, Started,
    header::Field,
    journal::{Journal, KEPT, SET},
};

/// Who confirms a program on trial.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Confirm {
    /// A master by 1F51h = 80h, or the program itself: 10 s after an SDO answer that another node has acknowledged,
    /// all of that time well.
    #[default]
    ByItself,
    /// A master by 1F51h = 80h.
    ByMaster,
}

/// What follows on a write of 1F51h, in this order: the answer, if there is one, then this.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Control {
    /// Answer.
    Answer,
    /// Answer, then reset as soon as the answer is sent.
    Reset,
    /// Call [`Program::confirm`], and answer with its result.
    Confirm,
    /// Do not answer: put [`Command::Stop`](crate::Command::Stop) and what is in force into the mailbox, and reset.
    /// The loader answers.
    Stop,
}

/// What [`Program::poll`] asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// Call [`Program::confirm`].
    Confirm,
    /// Reset: the trial has failed.
    Reset,
    /// Write 0 to [`Mailbox::failures`]: the program has run for 60 s.
    HasRun,
}

const SECOND: u32 = 1_000_000;
/// The time within which a program on trial must be confirmed, in microseconds.
pub const TRIAL: u32 = 60 * SECOND;
/// The time from an SDO answer to the confirmation, in microseconds.
pub const WELL: u32 = 10 * SECOND;

/// The state of the program's side. Times are counts of microseconds that may wrap.
#[derive(Clone, Debug)]
pub struct Program {
    confirm: Confirm,
    journal: Journal,
    crc: u32,
    started: u32,
    on_trial: bool,
    /// Since when it has been well after an SDO answer.
    well_since: Option<u32>,
    has_run: bool,
}

impl Program {
    /// The program after its start. `mailbox` is the one that the start has left; `None` if there is no loader, as
    /// under a debugger.
    pub fn new<F: Flash>(
        flash: &mut F,
        mailbox: Option<Mailbox>,
        confirm: Confirm,
        now: u32,
    ) -> Self {
        Self {
            confirm,
            journal: Journal::read(flash),
            crc: flash.read(Area::Run, Field::Crc as u32),
            started: now,
            on_trial: mailbox.is_some_and(|mailbox| mailbox.started == Started::Trial),
            well_since: None,
            has_run: false,
        }
    }

    /// Whether the program is on trial.
    pub fn is_on_trial(&self) -> bool {
        self.on_trial
    }

    /// The value of an object.
    pub fn read(&self, object: Object) -> u32 {
        match object {
            Object::Control => 1,
            Object::Software => self.crc,
            Object::FlashStatus => 0,
            Object::State => self.journal.state() as u32,
            Object::Starts => self.journal.tries().into(),
        }
    }

    /// The answer to a write of 1F51h sub-index 1.
    ///
    /// # Errors
    /// [`Abort::DeviceState`]: stop outside of NMT pre-operational, or clear; [`Abort::InvalidValue`]. A write of 1F50h is
    /// always refused with [`Abort::DeviceState`].
    pub fn write_control(&self, value: u8, is_pre_operational: bool) -> Result<Control, Abort> {
        match value {
            0 if is_pre_operational => Ok(Control::Stop),
            0 | 3 => Err(Abort::DeviceState),
            1 => Ok(Control::Answer),
            2 => Ok(Control::Reset),
            0x80 => Ok(Control::Confirm),
            _ => Err(Abort::InvalidValue),
        }
    }

    /// Another node has acknowledged an SDO answer of this one.
    pub fn answered(&mut self, now: u32) {
        self.well_since.get_or_insert(now);
    }

    /// What is due. Call it at least once a second. The program `is_well` if all its tasks have checked in and the
    /// controller is not bus-off.
    pub fn poll(&mut self, is_well: bool, now: u32) -> Option<Wanted> {
        let has_passed = |since: u32, time| now.wrapping_sub(since) >= time;
        if !is_well && self.well_since.is_some() {
            self.well_since = Some(now);
        }
        if !self.has_run && has_passed(self.started, TRIAL) {
            self.has_run = true;
            return Some(if self.on_trial { Wanted::Reset } else { Wanted::HasRun });
        }
        let is_due = self.well_since.is_some_and(|since| has_passed(since, WELL));
        (self.on_trial && self.confirm == Confirm::ByItself && is_due).then_some(Wanted::Confirm)
    }

    /// Confirms the program: it programs two words, reads them back, and waits for that. Without an update it only
    /// answers. A confirmed program is confirmed again: what the start has read may have been uncertain.
    ///
    /// # Errors
    /// [`Abort::Hardware`]: the flash failed. The trial goes on.
    pub fn confirm<F: Flash>(&mut self, flash: &mut F) -> Result<(), Abort> {
        self.well_since = None;
        let mut journal = Journal::read(flash);
        // On trial, what the start has read counts: UNDO may read otherwise now.
        let is_new = journal.is_saved() && journal.is_loaded() && !journal.is_undone();
        if self.on_trial || is_new {
            for word in KEPT {
                journal.write(flash, word, SET).map_err(|_| Abort::Hardware)?;
            }
        }
        self.journal = journal;
        self.on_trial = false;
        Ok(())
    }
}
