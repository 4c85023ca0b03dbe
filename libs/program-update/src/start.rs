//! What a device starts after a reset.

use crate::{
    Area, Command, Flash, Header, Mailbox, Started, crc,
    header::HEADER_LEN,
    journal::{self, Journal, SET, TRY},
};

/// The starts in a row, each ended by a watchdog or a fault within 60 s, after which the loader stays for 60 s.
pub const MOST_FAILURES: u8 = 5;

/// What has reset the chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// A watchdog or a fault.
    Failure,
    /// A debugger. It is no failure, and takes no start of a trial.
    Debugger,
    /// Anything else: the power, the reset pin, the program or the loader.
    Other,
}

/// What to start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// The program in RUN: its vectors are behind the header.
    Program,
    /// The loader.
    Loader(Why),
}

/// Why the loader is started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Why {
    /// The program handed over: the loader answers 1F51h = 0, after its boot-up.
    Stop,
    /// [`MOST_FAILURES`] starts have failed.
    Failures,
    /// RUN has to be restored.
    Restore,
    /// There is no valid program.
    NoProgram,
}

/// What the journal and the two areas ask for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Next {
    /// The program in RUN, on trial.
    Trial,
    /// The program in RUN.
    Program,
    Restore,
    Nothing,
}

/// Decides what to start, and programs what has to stand in the journal before. It reads both programs at most once,
/// and waits for at most 16 words.
///
/// `mailbox` is what the RAM holds, if it is one. The caller writes the mailbox that is returned, then starts.
pub fn decide<F: Flash>(flash: &mut F, mailbox: Option<Mailbox>, cause: Cause) -> (Start, Mailbox) {
    let mut mailbox = mailbox.unwrap_or_default();
    let failed = cause == Cause::Failure && mailbox.started != Started::Loader;
    mailbox.failures = if failed { mailbox.failures.saturating_add(1) } else { 0 };
    let command = core::mem::take(&mut mailbox.command);
    mailbox.started = Started::Loader;
    if command == Command::Stop {
        return (Start::Loader(Why::Stop), mailbox);
    }
    if mailbox.failures >= MOST_FAILURES {
        mailbox.failures = 0;
        return (Start::Loader(Why::Failures), mailbox);
    }

    let mut journal = Journal::open(flash);
    let mut next = next(journal, true, |area| program_in(flash, area).is_some());
    let takes_try = cause != Cause::Debugger;
    if next == Next::Trial && takes_try && !begin_trial(flash, &mut journal) {
        next = self::next(journal, false, |area| program_in(flash, area).is_some());
    }
    let start = match next {
        Next::Trial => {
            mailbox.started = Started::Trial;
            Start::Program
        }
        Next::Program => {
            mailbox.started = Started::Program;
            Start::Program
        }
        Next::Restore => Start::Loader(Why::Restore),
        Next::Nothing => Start::Loader(Why::NoProgram),
    };
    (start, mailbox)
}

/// What the journal asks for; `is_valid` says whether an area holds a valid program.
pub(crate) fn next(
    journal: Journal,
    may_try: bool,
    mut is_valid: impl FnMut(Area) -> bool,
) -> Next {
    let run = is_valid(Area::Run);
    let is_new = journal.is_loaded() && !journal.is_undone();
    let has_try = usize::from(journal.tries()) < TRY.len();
    if journal.is_pending() && is_new && has_try && may_try && run {
        Next::Trial
    } else if run && !journal.is_pending() {
        Next::Program
    } else if journal.is_saved() && is_valid(Area::Backup) {
        Next::Restore
    } else if run {
        Next::Program
    } else {
        Next::Nothing
    }
}

/// Marks a start on trial in the first word that takes it.
fn begin_trial<F: Flash>(flash: &mut F, journal: &mut Journal) -> bool {
    let before = *journal;
    TRY.into_iter()
        .filter(|word| !before.is_set(*word))
        .any(|word| journal.write(flash, word, SET).is_ok())
}

/// The header of the program in an area, if both are right: CRC of the header, length, CRC of the program.
pub fn program_in<F: Flash>(flash: &mut F, area: Area) -> Option<Header> {
    let mut bytes = [0xFF; HEADER_LEN];
    let (words, _) = bytes.as_chunks_mut();
    // What follows is FFh in a header, and the journal in BACKUP.
    let len = if area == Area::Backup { journal::OFFSET } else { HEADER_LEN as u32 };
    for (offset, word) in (0..len).step_by(4).zip(words) {
        *word = flash.read(area, offset).to_le_bytes();
    }
    let header = Header::parse(&bytes).ok()?;
    let run = flash.sectors(Area::Run).iter().fold(0u32, |sum, len| sum.saturating_add(*len));
    let capacity = run.saturating_sub(HEADER_LEN as u32);
    if !header.length.is_multiple_of(4) || header.length > capacity {
        return None;
    }
    let crc = flash.crc(area, HEADER_LEN as u32, header.length / 4, crc::BEGIN);
    (!crc == header.crc).then_some(header)
}
