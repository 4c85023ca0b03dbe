//! The loader's objects: clear, download and restore, one small step of the flash at a time.

mod steps;
mod written;

use core::marker::PhantomData;

use crate::{
    Abort, Area, Flash, FlashError, Header, Object, ROW, State, Status, Verify,
    download::{Download, Phase, Proof},
    header::{Expected, Field, HEADER_LEN},
    journal::{Journal, PAIRS, Word},
    start::{self, Next, Why, program_in},
};
use steps::{Procedure, Step};

/// The time without an SDO request after which the loader starts the device, in microseconds.
pub const SILENCE: u32 = 60_000_000;
/// The time from the acknowledgement of an answer to the reset that it announces, in microseconds.
pub const RESET_DELAY: u32 = 100_000;

/// What the loader has to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Answer the end of the download of 1F50h.
    Answer(Result<(), Abort>),
    /// Put what is in force into the mailbox, and reset.
    Reset,
    /// Check the signature of a copy of [`header_bytes`](Updater::header_bytes), then call
    /// [`verified`](Updater::verified).
    Verify,
    /// Calculate the SHA-256 of the first words in RUN behind the header, then call [`hashed`](Updater::hashed).
    Hash {
        /// Their number.
        words: u32,
    },
}

/// What the flash is doing.
#[derive(Clone, Copy, Debug)]
enum Operation {
    Erase,
    /// The first words of the row.
    Program {
        area: Area,
        offset: u32,
        len: u32,
    },
    Mark {
        word: Word,
        is_needed: bool,
    },
}

/// Whether RUN is ready for a download.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cleared {
    No,
    /// It is about to be.
    Soon,
    Yes,
    /// A word of a program has been written.
    Used,
}

#[derive(Clone, Copy, Debug)]
enum Reset {
    No,
    /// Some time after the answer.
    Asked,
    At(u32),
}

/// The state of the loader. Times are counts of microseconds that may wrap.
///
/// `WORDS` is the room for data that the flash has not taken yet, in words of four bytes.
pub struct Updater<F, V, const WORDS: usize = 4096> {
    flash: F,
    verify: PhantomData<V>,
    expected: Expected,
    journal: Journal,
    /// The valid programs.
    run: Option<Header>,
    backup: Option<Header>,
    status: Status,
    operation: Option<Operation>,
    /// The words that are being programmed.
    row: [u32; ROW],
    procedure: Procedure,
    step: Step,
    /// The BACK of the restore under way.
    back: Word,
    /// The end of the program that RUN held before its erase.
    run_end: Option<u32>,
    /// A clear follows the restore.
    clears_then: bool,
    cleared: Cleared,
    /// A header has been proven, and no clear has used it.
    has_proof: bool,
    download: Download<WORDS>,
    requested: u32,
    reset: Reset,
}

impl<F: Flash, V: Verify, const WORDS: usize> Updater<F, V, WORDS> {
    /// The loader after its start, for the reason that [`decide`](crate::start::decide) gave. It reads both programs once,
    /// and waits for that. A restore begins with the first [`poll`](Self::poll).
    pub fn new(mut flash: F, _: V, expected: Expected, why: Why, now: u32) -> Self {
        let journal = Journal::open(&mut flash);
        let run = program_in(&mut flash, Area::Run);
        let backup = program_in(&mut flash, Area::Backup);
        let mut updater = Self {
            flash,
            verify: PhantomData,
            expected,
            journal,
            run,
            backup,
            status: if why == Why::Failures { Status::Failing } else { Status::Ok },
            operation: None,
            row: [0; ROW],
            procedure: Procedure::Restore,
            step: Step::Idle,
            back: PAIRS[0].1,
            run_end: None,
            clears_then: false,
            cleared: Cleared::No,
            has_proof: false,
            download: Download::new(),
            requested: now,
            reset: Reset::No,
        };
        if matches!(why, Why::Restore | Why::NoProgram) {
            let is_valid = |area| match area {
                Area::Run => run.is_some(),
                Area::Backup => backup.is_some(),
            };
            match start::next(journal, false, is_valid) {
                Next::Restore => updater.step = Step::Saved { second: false },
                // The journal reads otherwise now.
                Next::Program | Next::Trial => updater.reset = Reset::At(now),
                Next::Nothing => {}
            }
        }
        updater
    }

    /// Does the next step, if the flash is ready for it, and says what the loader has to do. Call it as often as
    /// possible while [`is_busy`](Self::is_busy), and at least every 10 ms otherwise. A step reads some 70 words at
    /// most, or starts one operation of the flash; it never waits for the flash.
    ///
    /// What [`Action::Verify`] and [`Action::Hash`] ask for may take long, while the objects answer. No other `poll` may
    /// come before its result.
    pub fn poll(&mut self, now: u32) -> Option<Action> {
        if V::IS_SIGNED && self.download.proof == Proof::Wanted {
            self.download.proof = Proof::UnderWay;
            return Some(Action::Verify);
        }
        let outcome = self.finish_operation()?;
        if outcome.is_ok() && self.is_reset_due(now) {
            return Some(Action::Reset);
        }
        match outcome.and_then(|()| self.step()) {
            Ok(action) => action,
            Err(error) => self.fail(error.into()),
        }
    }

    /// The header of the download, as it has come.
    pub fn header_bytes(&self) -> &[u8; HEADER_LEN] {
        self.download.bytes()
    }

    /// Takes the result of [`Action::Verify`], unless the download has ended since; returns what follows.
    pub fn verified(&mut self, is_signed: bool) -> Option<Action> {
        if self.download.proof != Proof::UnderWay {
            return None;
        }
        let is_waiting = self.download.phase == Phase::Ended;
        let (status, abort) = if !is_signed {
            (Status::Refused(Field::Signature), Abort::NotStored)
        } else if self.may_download() {
            self.download.proof = Proof::Given;
            return None;
        } else {
            self.has_proof = true;
            (Status::NotCleared, Abort::DeviceState)
        };
        self.refuse(status);
        is_waiting.then_some(Action::Answer(Err(abort)))
    }

    /// Takes the result of [`Action::Hash`], unless the download has ended since; returns what follows.
    pub fn hashed(&mut self, sha256: &[u8; 32]) -> Option<Action> {
        let header = self.download.header.filter(|_| matches!(self.step, Step::Hashing))?;
        if header.sha256 == *sha256 {
            self.step = Step::Copy(0);
            return None;
        }
        Some(self.refuse_program(Status::Damaged(Field::Hash)))
    }

    /// Whether the flash is being written or erased, or is about to be: then leave it alone, and refuse LSS store
    /// configuration and 1010h.
    pub fn is_busy(&self) -> bool {
        self.operation.is_some()
            || !matches!(self.step, Step::Idle)
            || self.clears_then
            || !self.download.is_empty()
            || self.download.phase == Phase::Ended
    }

    /// Whether neither RUN nor BACKUP holds a program that can be started: emergency 6200h.
    pub fn is_without_program(&self) -> bool {
        self.run.is_none() && !(self.journal.is_saved() && self.backup.is_some())
    }

    /// The header of the program in RUN, else of that in BACKUP: for 1018h sub-index 3 and 100Ah.
    pub fn header(&self) -> Option<&Header> {
        self.run.as_ref().or(self.backup.as_ref())
    }

    /// The value of an object.
    pub fn read(&self, object: Object) -> u32 {
        match object {
            Object::Control if self.run.is_some() => 0,
            Object::Control => 3,
            Object::Software => self.run.map_or(0, |header| header.crc),
            Object::FlashStatus => {
                let is_empty = self.run.is_none() && self.cleared == Cleared::No;
                let status = match self.status {
                    Status::Ok if is_empty && !self.is_busy() => Status::NoProgram,
                    status => status,
                };
                status.value(self.is_busy())
            }
            Object::State if self.cleared != Cleared::No => State::UnderWay as u32,
            Object::State => self.journal.state() as u32,
            Object::Starts => self.journal.tries().into(),
        }
    }

    /// An SDO request has come, of whatever kind: the loader goes on for 60 s.
    pub fn requested(&mut self, now: u32) {
        self.requested = now;
    }

    /// The answer to a write of 1F51h sub-index 1, to be sent at once. After start and reset [`poll`](Self::poll) asks
    /// for [`Action::Reset`], 100 ms after [`answered`](Self::answered), unless a stop, a clear or a download comes before.
    ///
    /// # Errors
    /// [`Abort::DeviceState`]: start without a valid program, confirm, or with [`Signed`](crate::Signed) a clear before
    /// a download has brought a header with the signature; [`Abort::InvalidValue`].
    pub fn write_control(&mut self, value: u8) -> Result<(), Abort> {
        match value {
            0 => self.reset = Reset::No,
            1 if self.run.is_none() || self.is_busy() => return Err(Abort::DeviceState),
            1 | 2 => self.reset = Reset::Asked,
            3 => return self.clear(),
            0x80 => return Err(Abort::DeviceState),
            _ => return Err(Abort::InvalidValue),
        }
        Ok(())
    }

    /// Another node has acknowledged the last SDO answer.
    pub fn answered(&mut self, now: u32) {
        if matches!(self.reset, Reset::Asked) {
            self.reset = Reset::At(now.wrapping_add(RESET_DELAY));
        }
    }

    /// The bytes that [`write`](Self::write) takes now. Ask for no more: make the next block this long, or answer the
    /// next segment when there is room.
    pub fn room(&self) -> usize {
        self.download.room()
    }

    /// The next bytes of a download to 1F50h, any number of them; a new download begins with `offset` 0.
    ///
    /// # Errors
    /// [`Abort::NotStored`]: the header does not fit, nothing was written. [`Abort::DeviceState`]: it fits, but RUN is not
    /// cleared: so a client can ask before. With [`Signed`](crate::Signed) a proof decides between the two, before the
    /// answer to the end of a download that is the header alone.
    /// [`Abort::Hardware`]: the flash failed, or there are more bytes than the header says. [`Abort::Memory`]: more than
    /// [`room`](Self::room). In each case 1F57h says why, and the download has ended.
    pub fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Abort> {
        if offset == 0 {
            self.abort();
            (self.status, self.reset) = (Status::Ok, Reset::No);
            self.download.begin(Phase::Receiving);
        }
        if self.download.phase != Phase::Receiving || offset != self.download.received() {
            let has_failed = self.status.is_of_flash();
            return Err(match () {
                () if has_failed => Abort::Hardware,
                () if self.is_unsigned() => Abort::NotStored,
                () => Abort::DeviceState,
            });
        }
        if bytes.len() > self.room() {
            self.abort();
            return Err(Abort::Memory);
        }
        let header_left = self.download.header_left();
        let (header, program) = bytes.split_at_checked(header_left).unwrap_or((bytes, &[]));
        self.download.take(header);
        if header_left > 0 && self.download.header_left() == 0 {
            self.download.header = Some(self.accept().map_err(|status| {
                self.refuse(status);
                Abort::NotStored
            })?);
            if V::IS_SIGNED {
                self.download.proof = Proof::Wanted;
            } else if !self.may_download() {
                self.refuse(Status::NotCleared);
                return Err(Abort::DeviceState);
            }
        }
        let left = self.download.expected_len().wrapping_sub(self.download.received());
        if program.len() > left as usize {
            self.refuse(Status::Damaged(Field::Length));
            return Err(Abort::Hardware);
        }
        self.download.take(program);
        Ok(())
    }

    /// The end of a download of `len` bytes. The answer follows as [`Action::Answer`].
    ///
    /// # Errors
    /// As [`write`](Self::write); [`Abort::Hardware`] also for a wrong length.
    pub fn end(&mut self, len: u32) -> Result<(), Abort> {
        if self.download.phase != Phase::Receiving {
            return Err(if self.is_unsigned() { Abort::NotStored } else { Abort::DeviceState });
        }
        let is_complete = self.download.header.is_some() && len == self.download.expected_len();
        // Without a clear, the proof of the header is the answer.
        let is_in_proof = matches!(self.download.proof, Proof::Wanted | Proof::UnderWay);
        if !(is_complete || is_in_proof && !self.may_download()) || len != self.download.received()
        {
            self.refuse(Status::Damaged(Field::Length));
            return Err(Abort::Hardware);
        }
        self.download.phase = Phase::Ended;
        Ok(())
    }

    /// The client or the SDO server has ended the download, also while its answer is due. After the first word of the
    /// program, another download needs another clear.
    pub fn abort(&mut self) {
        if matches!(self.step, Step::Done) {
            self.download.phase = Phase::None;
        } else if self.download.phase != Phase::None {
            let is_used = self.cleared == Cleared::Used;
            self.refuse(if is_used { Status::NotCleared } else { Status::Ok });
            let is_of_download = matches!(self.procedure, Procedure::Clear);
            if is_of_download
                && matches!(self.step, Step::Check { .. } | Step::Hashing | Step::Copy(_))
            {
                self.step = Step::Idle;
            }
        }
    }

    /// Checks the header that has come.
    fn accept(&mut self) -> Result<Header, Status> {
        let bytes = self.download.bytes();
        let header = Header::parse(bytes).map_err(Status::Refused)?;
        // BACKUP holds the program that was confirmed last while another one is on trial, and will do so once RUN is about
        // to be cleared.
        let installed = match self.cleared {
            Cleared::No if !self.journal.is_pending() => self.run.or(self.backup),
            _ => self.backup.or(self.run),
        };
        let installed = installed.map(|header| header.release);
        header.check(&self.expected, installed)?;
        Ok(header)
    }

    /// Whether RUN is cleared, or about to be.
    fn may_download(&self) -> bool {
        matches!(self.cleared, Cleared::Soon | Cleared::Yes)
    }

    /// Ends a download. What was cleared stays so if nothing was written.
    fn refuse(&mut self, status: Status) {
        self.status = status;
        self.download.begin(Phase::None);
    }

    /// Ends a download whose program is not the one in the header.
    fn refuse_program(&mut self, status: Status) -> Action {
        self.step = Step::Idle;
        self.refuse(status);
        Action::Answer(Err(Abort::Hardware))
    }

    /// Whether the last download was refused for its signature, while the client went on.
    fn is_unsigned(&self) -> bool {
        V::IS_SIGNED && self.status == Status::Refused(Field::Signature)
    }

    fn is_reset_due(&self, now: u32) -> bool {
        let is_silent = now.wrapping_sub(self.requested) >= SILENCE;
        match self.reset {
            Reset::At(at) => now.wrapping_sub(at) < u32::MAX / 2,
            _ => is_silent && !self.is_busy() && !self.is_without_program(),
        }
    }

    /// Ends all that is under way after an error; the loader stays on the bus.
    fn fail(&mut self, status: Status) -> Option<Action> {
        let is_waiting = self.download.phase == Phase::Ended;
        self.step = Step::Idle;
        self.clears_then = false;
        self.cleared = Cleared::No;
        self.refuse(status);
        is_waiting.then_some(Action::Answer(Err(Abort::Hardware)))
    }

    /// The end of the operation under way: `None` while it goes on.
    fn finish_operation(&mut self) -> Option<Result<(), FlashError>> {
        let Some(operation) = self.operation else { return Some(Ok(())) };
        let mut outcome = self.flash.poll()?;
        self.operation = None;
        let (area, offset, len) = match operation {
            Operation::Erase => (Area::Run, 0, 0),
            Operation::Program { area, offset, len } => (area, offset, len),
            Operation::Mark { word, .. } => (Area::Backup, word.offset(), 1),
        };
        let mut written = self.row.iter().zip(0..len);
        if outcome.is_ok()
            && written.any(|(word, i)| self.flash.read(area, offset.wrapping_add(4 * i)) != *word)
        {
            outcome = Err(FlashError::Failed);
        }
        if let Operation::Mark { word, is_needed } = operation {
            self.journal.note(word, self.flash.read(Area::Backup, word.offset()));
            if !is_needed {
                return Some(Ok(()));
            }
        }
        Some(outcome)
    }
}
