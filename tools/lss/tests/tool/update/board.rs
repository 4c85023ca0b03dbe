//! A board whose program can be replaced: a node with the objects of program download, over `program_update` as loader
//! and as program, on a flash in the process.

mod chip;

use std::{cell::RefCell, rc::Rc};

use canopen_node::{
    Application, Count,
    application::Dictionary,
    nmt,
    sdo::{Abort, Answer},
};
use program_update::{
    Action, Command, Expected, Mailbox, Object, Unsigned, Updater, crc,
    header::{HEADER_LEN, text},
    program::{Confirm, Control, Program, Wanted},
    start::{self, Cause, Start, Why},
};
use testkit::node_rig::ADDRESS;

use super::program::{Kind, RUN};
use chip::{Chip, ChipFlash, SECTORS};

/// The time from the start of a program that hangs to the reset by its watchdog, in microseconds.
const WATCHDOG: u64 = 1_400_000;
/// More steps than the loader takes between two looks at it.
const STEPS: usize = 10_000;

/// What the loader of these boards takes.
fn expected(allows_downgrade: bool) -> Expected {
    Expected {
        vendor_id: ADDRESS.vendor_id,
        product_code: ADDRESS.product_code,
        hardware: crc::of(b"A"),
        chip: text("stm32f405"),
        controller: 1,
        address: RUN,
        capacity: SECTORS.iter().sum::<u32>() - HEADER_LEN as u32,
        ram: 0x2000_0000..0x2002_0000,
        allows_downgrade,
    }
}

/// What runs.
enum Side {
    Off,
    Loader(Box<Updater<ChipFlash, Unsigned>>),
    Program(Program),
}

/// What the board does with its node.
pub enum Deed {
    Answer(Result<(), Abort>),
    Reset(Cause),
}

/// The board beside its node.
pub struct State {
    pub chip: Rc<RefCell<Chip>>,
    pub allows_downgrade: bool,
    side: Side,
    mailbox: Option<Mailbox>,
    now: u64,
    is_asked: bool,
    reset: Option<(u64, Cause)>,
    /// The loader owes the answer to the stop of the program.
    pub owes_answer: bool,
    /// Nothing answers.
    pub hangs: bool,
}

/// A handle to the board, which is the application of its node.
#[derive(Clone)]
pub struct Board(pub Rc<RefCell<State>>);

impl Board {
    /// A board with the program in this file.
    pub fn new(file: &[u8]) -> Self {
        let mut state = State {
            chip: Rc::new(RefCell::new(Chip::new(file))),
            allows_downgrade: false,
            side: Side::Off,
            mailbox: None,
            now: 0,
            is_asked: false,
            reset: None,
            owes_answer: false,
            hangs: false,
        };
        state.boot(Cause::Other);
        Self(Rc::new(RefCell::new(state)))
    }
}

impl State {
    /// Takes the power away.
    pub fn power_off(&mut self) {
        (self.side, self.mailbox) = (Side::Off, None);
        self.chip.borrow_mut().power_off();
    }

    /// Starts the loader or the program.
    pub fn boot(&mut self, cause: Cause) {
        let mut flash = ChipFlash(Rc::clone(&self.chip));
        let (start, mailbox) = start::decide(&mut flash, self.mailbox, cause);
        self.mailbox = Some(mailbox);
        let now = self.now as u32;
        (self.is_asked, self.reset) = (false, None);
        self.hangs = false;
        self.owes_answer = start == Start::Loader(Why::Stop);
        self.side = match start {
            Start::Program => {
                self.hangs = self.kind() == Kind::Hangs as u32;
                if self.hangs {
                    self.reset = Some((self.now + WATCHDOG, Cause::Failure));
                }
                let program = Program::new(&mut flash, self.mailbox, Confirm::ByMaster, now);
                Side::Program(program)
            }
            Start::Loader(why) => Side::Loader(Box::new(Updater::new(
                flash,
                Unsigned,
                expected(self.allows_downgrade),
                why,
                now,
            ))),
        };
    }

    /// The CRC of the program that runs.
    pub fn runs(&self) -> Option<u32> {
        match &self.side {
            Side::Program(program) if !self.hangs => Some(program.read(Object::Software)),
            _ => None,
        }
    }

    /// Whether the program that runs may be taken back.
    pub fn is_on_trial(&self) -> bool {
        matches!(&self.side, Side::Program(program) if program.is_on_trial())
    }

    fn kind(&self) -> u32 {
        self.chip.borrow().word(HEADER_LEN + 8)
    }

    /// Does what is due.
    pub fn poll(&mut self, now: u64) -> Vec<Deed> {
        self.now = now;
        self.chip.borrow_mut().pass_until(now);
        let micros = now as u32;
        let mut deeds = Vec::new();
        match &mut self.side {
            Side::Off => return deeds,
            Side::Loader(updater) => {
                if std::mem::take(&mut self.is_asked) {
                    updater.requested(micros);
                    updater.answered(micros);
                }
                for _ in 0..STEPS {
                    match updater.poll(micros) {
                        Some(Action::Answer(outcome)) => {
                            deeds.push(Deed::Answer(outcome.map_err(abort)));
                        }
                        Some(Action::Reset) => {
                            deeds.push(Deed::Reset(Cause::Other));
                            break;
                        }
                        Some(Action::Verify | Action::Hash { .. }) => unreachable!("unsigned"),
                        None if !updater.is_busy() || self.chip.borrow().is_busy() => break,
                        None => {}
                    }
                }
            }
            Side::Program(program) => {
                if std::mem::take(&mut self.is_asked) {
                    program.answered(micros);
                }
                match program.poll(true, micros) {
                    Some(Wanted::Reset) => deeds.push(Deed::Reset(Cause::Other)),
                    Some(Wanted::Confirm | Wanted::HasRun) | None => {}
                }
            }
        }
        if let Some((_, cause)) = self.reset.take_if(|(at, _)| *at <= now) {
            deeds.push(Deed::Reset(cause));
        }
        deeds
    }

    fn control(
        &mut self,
        value: u8,
        is_pre_operational: bool,
    ) -> Result<Answer, program_update::Abort> {
        let kind = self.kind();
        match &mut self.side {
            Side::Off => {}
            Side::Loader(updater) => updater.write_control(value)?,
            Side::Program(program) => match program.write_control(value, is_pre_operational)? {
                Control::Answer => {}
                Control::Reset => self.reset = Some((self.now + 10_000, Cause::Other)),
                Control::Confirm if kind == Kind::RefusesConfirmation as u32 => {
                    return Err(program_update::Abort::Hardware);
                }
                Control::Confirm => program.confirm(&mut ChipFlash(Rc::clone(&self.chip)))?,
                Control::Stop => {
                    let mailbox = self.mailbox.unwrap_or_default();
                    self.mailbox = Some(Mailbox { command: Command::Stop, ..mailbox });
                    self.reset = Some((self.now, Cause::Other));
                    return Ok(Answer::Later);
                }
            },
        }
        Ok(Answer::Now)
    }
}

/// The abort code for the SDO server.
fn abort(abort: program_update::Abort) -> Abort {
    match abort {
        program_update::Abort::Memory => Abort::Memory,
        program_update::Abort::Hardware => Abort::Hardware,
        program_update::Abort::InvalidValue => Abort::InvalidValue,
        program_update::Abort::NotStored => Abort::NotStored,
        program_update::Abort::DeviceState => Abort::DeviceState,
    }
}

impl Dictionary for Board {
    type Value = ();
    type SdoBuffer = [u8; 8];
    type Numbers = Count<0, 0, 0>;
}

impl Application for Board {
    const PROGRAM_DOWNLOAD: bool = true;

    fn program(&mut self) -> Option<&mut dyn canopen_node::Program> {
        Some(self)
    }
}

impl canopen_node::Program for Board {
    fn read(&mut self, index: u16, sub_index: u8) -> u32 {
        let object = match (index, sub_index) {
            (0x1F51, _) => Object::Control,
            (0x1F56, _) => Object::Software,
            (0x1F57, _) => Object::FlashStatus,
            (_, 1) => Object::State,
            _ => Object::Starts,
        };
        match &self.0.borrow().side {
            Side::Off => 0,
            Side::Loader(updater) => updater.read(object),
            Side::Program(program) => program.read(object),
        }
    }

    fn control(&mut self, value: u8, nmt: nmt::State) -> Result<Answer, Abort> {
        let is_pre_operational = nmt == nmt::State::PreOperational;
        self.0.borrow_mut().control(value, is_pre_operational).map_err(abort)
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Abort> {
        match &mut self.0.borrow_mut().side {
            Side::Loader(updater) => updater.write(offset, bytes).map_err(abort),
            _ => Err(Abort::DeviceState),
        }
    }

    fn end(&mut self, len: u32) -> Result<Answer, Abort> {
        let Side::Loader(updater) = &mut self.0.borrow_mut().side else {
            return Err(Abort::DeviceState);
        };
        updater.end(len).map_err(abort)?;
        Ok(Answer::Later)
    }

    fn abort(&mut self) {
        if let Side::Loader(updater) = &mut self.0.borrow_mut().side {
            updater.abort();
        }
    }

    fn requested(&mut self) {
        self.0.borrow_mut().is_asked = true;
    }
}
