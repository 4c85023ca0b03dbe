//! A node that takes programs (CiA 302-3): its objects 1F50h, 1F51h, 1F56h and 1F57h, and the state 2001h of an update.

mod status;

use std::time::{Duration, Instant};

use can_bus::sdo::{self, Error};
use canopen_node::NodeId;
use program_update::{State, header::HEADER_LEN};

use super::nodes;
use crate::{
    failure::{Failure, Result},
    session::Session,
};
pub use status::words;

/// An object.
type Object = (u16, u8);
const DATA: Object = (0x1F50, 1);
const CONTROL: Object = (0x1F51, 1);
const SOFTWARE: Object = (0x1F56, 1);
const STATUS: Object = (0x1F57, 1);
const STATE: Object = (0x2001, 1);

/// The values of program control 1F51h.
const STOP: u32 = 0;
const START: u32 = 1;
const RESET: u32 = 2;
const CLEAR: u32 = 3;
const CONFIRM: u32 = 0x80;
/// 1F51h reads so in a loader without a valid program.
const NO_PROGRAM: u32 = 3;

/// The NMT command enter pre-operational.
const ENTER_PRE_OPERATIONAL: u8 = 128;
/// How often a request without an answer is repeated.
const ATTEMPTS: usize = 3;
/// The time between two looks at the state of a node.
const GLANCE: Duration = Duration::from_millis(50);
/// The longest that a node may be silent: it may reset, and check its program.
const SILENCE: Duration = Duration::from_secs(5);
/// The longest time of a clear, or of a restore, of the greatest program in the slowest flash.
const BUSY: Duration = Duration::from_secs(90);
/// The wait for the answer to the beginning and to the end of a download.
const DOWNLOAD_WAIT: Duration = Duration::from_secs(10);
/// The wait for a program after its start: three starts that fail, and a restore.
const START_WAIT: Duration = Duration::from_secs(60);

/// What became of a program that was started.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fate {
    /// It runs, and is confirmed.
    Confirmed,
    /// It does not run, or cannot be confirmed: why, in words. The board goes back to the one before.
    Failed(String),
}

impl Fate {
    fn of(what: &str) -> Self {
        Self::Failed(what.to_owned())
    }
}

/// What a node runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Installed {
    /// The program runs, and not the loader.
    pub runs: bool,
    /// Its CRC; 0 without one.
    pub crc: u32,
    pub is_on_trial: bool,
}

/// A node, and what it is doing, for the person who waits.
pub struct Loader<'s> {
    session: &'s mut Session,
    id: u8,
    who: &'s str,
}

impl<'s> Loader<'s> {
    pub fn new(session: &'s mut Session, id: NodeId, who: &'s str) -> Self {
        Self { session, id: id.get(), who }
    }

    /// Why the node has no program download, if it has none, in words.
    pub fn misses(&mut self) -> Result<Option<String>> {
        match self.try_read(STATUS)? {
            Err(why @ Error::Abort(_)) => Ok(Some(format!(
                "it has no program download (1F57h: {why}). Its program was made without a loader: only a debug probe installs \
                 one, with factory.hex"
            ))),
            _ => Ok(None),
        }
    }

    /// What is installed, when nothing is under way any more.
    pub fn installed(&mut self) -> Result<Installed> {
        self.idle("waiting until it is ready")?;
        let runs = self.read(CONTROL)? == START;
        let crc = self.read(SOFTWARE)?;
        let is_on_trial = self.read(STATE)? == State::Trial as u32;
        Ok(Installed { runs, crc, is_on_trial })
    }

    /// Lets the node run its loader, NMT pre-operational.
    pub fn stop(&mut self) -> Result {
        self.say("stopping the program");
        let mut why = Error::NoAnswer;
        for _ in 0..ATTEMPTS {
            self.session.bus.nmt(ENTER_PRE_OPERATIONAL, self.id)?;
            match self.write(CONTROL, STOP)? {
                Ok(()) => return Ok(()),
                Err(error) => why = error,
            }
            // It may have lost only the answer.
            if self.read(CONTROL)? != START {
                return Ok(());
            }
        }
        Err(refused("it does not stop its program (1F51h)", &why))
    }

    /// Sends the header before anything is erased: the loader refuses one that is not for it.
    pub fn check(&mut self, header: &[u8]) -> Result {
        self.say("checking");
        let bus = &mut self.session.bus;
        match sdo::download(bus, self.id, DATA, header, DOWNLOAD_WAIT)? {
            Err(why @ Error::Abort(NOT_STORED)) => self.fail("it refuses the file", &why),
            // It is not cleared, as it says.
            _ => Ok(()),
        }
    }

    /// Lets the node clear, unless it has this program; returns whether it does. Does not wait for the end.
    pub fn begin(&mut self, crc: u32, header: &[u8]) -> Result<bool> {
        let installed = self.installed()?;
        if installed.crc == crc {
            return Ok(false);
        }
        if installed.runs {
            self.stop()?;
        }
        self.check(header)?;
        self.ask_to_clear()?;
        Ok(true)
    }

    /// Erases the program, and downloads another one whose header is checked: by blocks, and if that fails, by segments.
    pub fn install(&mut self, file: &[u8]) -> Result {
        for by_blocks in [true, false] {
            if !by_blocks {
                // A loader of signed programs clears once for a header.
                self.check(&file[..HEADER_LEN])?;
            }
            self.say("clearing");
            self.clear()?;
            let outcome = self.download(file, by_blocks);
            if let Err(Failure::Stop(_)) = &outcome {
                // It would wait for the rest for a second.
                self.session.bus.hold_interrupt(true);
                let _ = sdo::abort(&mut self.session.bus, self.id, DATA);
                self.session.bus.hold_interrupt(false);
            }
            match outcome? {
                Ok(()) => return self.check_status("the download has failed"),
                Err(why) if by_blocks && is_of_transfer(&why) => {}
                Err(why) => return self.fail("the download has failed", &why),
            }
        }
        Ok(())
    }

    /// Starts the program that is installed, and confirms it.
    pub fn start(&mut self, crc: u32) -> Result<Fate> {
        self.say("starting the program");
        self.session.bus.take_unasked();
        if let Err(why) = self.write(CONTROL, START)?
            && why != Error::NoAnswer
        {
            return self.fail("it does not start the program", &why);
        }
        let id = self.id;
        self.session.bus.wait_for(SILENCE, |frame| nodes::booted(frame) == Some(id))?;
        self.confirm(crc)
    }

    /// Confirms the program that runs.
    pub fn confirm(&mut self, crc: u32) -> Result<Fate> {
        self.say("confirming the program");
        let mut why = Error::NoAnswer;
        for _ in 0..ATTEMPTS {
            match self.running() {
                Ok(runs) if runs == crc => {}
                Ok(_) => {
                    return Ok(Fate::of("the program does not run; the one before runs again"));
                }
                Err(failure) => {
                    let why = failure.of_board()?;
                    return Ok(Fate::Failed(format!("the program does not run: {why}")));
                }
            }
            match self.write(CONTROL, CONFIRM)? {
                Ok(()) if self.read(STATE)? != State::Trial as u32 => return Ok(Fate::Confirmed),
                Ok(()) => {}
                Err(error) => why = error,
            }
        }
        Ok(Fate::Failed(format!(
            "the program runs, but cannot be confirmed ({why}): the board goes back to the one before"
        )))
    }

    /// Lets the node start the program that it has, or the one before; says what runs then.
    pub fn go_back(&mut self) -> Result<&'static str> {
        self.say("going back");
        let is_asked = self.write(CONTROL, RESET)?.is_ok();
        Ok(match is_asked.then(|| self.running()) {
            Some(Ok(_)) => "the program before runs",
            Some(Err(stop @ Failure::Stop(_))) => return Err(stop),
            _ => "it stays in its loader",
        })
    }

    /// The CRC of the program that runs, when one does.
    fn running(&mut self) -> Result<u32> {
        let begin = self.session.bus.time();
        let (mut heard, mut busy) = (begin, begin);
        loop {
            let now = self.session.bus.time();
            match self.try_read(CONTROL)? {
                Ok(START) => {
                    if let Ok(crc) = self.try_read(SOFTWARE)? {
                        return Ok(crc);
                    }
                }
                Ok(control) => {
                    heard = now;
                    let is_busy = !matches!(self.try_read(STATUS)?, Ok(status) if status & 1 == 0);
                    if control != NO_PROGRAM || is_busy {
                        busy = now;
                    }
                }
                Err(_) => busy = now,
            }
            if now.saturating_duration_since(busy) > SILENCE {
                return Err(Failure::Refused("it has no valid program, only the loader".into()));
            }
            if now.saturating_duration_since(begin) > START_WAIT {
                return Err(match now.saturating_duration_since(heard) > SILENCE {
                    true => Failure::NoAnswer("it does not answer any more".into()),
                    false => Failure::Refused("it stays in its loader".into()),
                });
            }
            self.glance()?;
        }
    }

    fn clear(&mut self) -> Result {
        self.ask_to_clear()?;
        self.idle("clearing")?;
        self.check_status("it does not clear")
    }

    fn ask_to_clear(&mut self) -> Result {
        let mut outcome = Ok(());
        for _ in 0..ATTEMPTS {
            outcome = self.write(CONTROL, CLEAR)?;
            if outcome != Err(Error::NoAnswer) {
                break;
            }
        }
        match outcome {
            Ok(()) => Ok(()),
            Err(why) => self.fail("it does not clear", &why),
        }
    }

    fn download(&mut self, file: &[u8], by_blocks: bool) -> Result<Result<(), Error>> {
        let Self { session, id, who } = self;
        let Session { bus, progress, .. } = session;
        let all = file.len().div_ceil(1024);
        let say = |done: usize| progress.say(|| format!("{who}: {} of {all} KB", done / 1024));
        Ok(match by_blocks {
            true => sdo::download_blocks(bus, *id, DATA, file, DOWNLOAD_WAIT, say)?,
            false => sdo::download_segments(bus, *id, DATA, file, DOWNLOAD_WAIT, say)?,
        })
    }

    /// Waits while the flash is busy.
    fn idle(&mut self, what: &str) -> Result {
        let begin = self.session.bus.time();
        let mut heard: Instant = begin;
        loop {
            self.say(what);
            let now = self.session.bus.time();
            match self.try_read(STATUS)? {
                Ok(status) if status & 1 == 0 => return Ok(()),
                Ok(_) => heard = now,
                Err(why) if now.saturating_duration_since(heard) > SILENCE => {
                    return Err(Failure::NoAnswer(format!("{what}: {why}")));
                }
                Err(_) => {}
            }
            if now.saturating_duration_since(begin) > BUSY {
                return Err(Failure::Refused(format!("{what}: its flash does not become ready")));
            }
            self.glance()?;
        }
    }

    fn check_status(&mut self, what: &str) -> Result {
        self.idle("checking")?;
        match self.read(STATUS)? {
            0 => Ok(()),
            status => Err(Failure::Refused(format!("{what}: {}", words(status)))),
        }
    }

    /// The failure after a request was refused: what the node says, or else the abort code.
    fn fail<T>(&mut self, what: &str, why: &Error) -> Result<T> {
        if *why == Error::NoAnswer {
            return Err(Failure::NoAnswer(format!("{what}: it does not answer any more")));
        }
        match self.try_read(STATUS)? {
            Ok(status) if status >> 1 != 0 => {
                Err(Failure::Refused(format!("{what}: {}", words(status))))
            }
            _ => Err(refused(what, why)),
        }
    }

    fn read(&mut self, object: Object) -> Result<u32> {
        let mut last = Error::NoAnswer;
        for _ in 0..ATTEMPTS {
            match self.try_read(object)? {
                Ok(value) => return Ok(value),
                Err(why) => last = why,
            }
        }
        Err(match last == Error::NoAnswer {
            true => Failure::NoAnswer("it does not answer any more".into()),
            false => refused(&format!("{:04X}h cannot be read", object.0), &last),
        })
    }

    fn try_read(&mut self, (index, sub_index): Object) -> Result<Result<u32, Error>> {
        Ok(sdo::read_number(&mut self.session.bus, self.id, index, sub_index)?)
    }

    fn write(&mut self, object: Object, value: u32) -> Result<Result<(), Error>> {
        Ok(sdo::write(&mut self.session.bus, self.id, object, value, 1)?)
    }

    fn glance(&mut self) -> Result {
        Ok(self.session.bus.pass(GLANCE)?)
    }

    fn say(&mut self, what: &str) {
        let who = self.who;
        self.session.progress.say(|| format!("{who}: {what}"));
    }
}

/// The abort code of data that is refused.
const NOT_STORED: u32 = 0x0800_0020;

/// Whether the transfer has failed, and not the data.
fn is_of_transfer(why: &Error) -> bool {
    !matches!(why, Error::Abort(code) if !matches!(code >> 16, 0x0503 | 0x0504))
}

fn refused(what: &str, why: &Error) -> Failure {
    Failure::Refused(format!("{what}: {why}"))
}
