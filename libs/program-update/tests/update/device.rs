//! A device with its loader and its programs, and a client that updates it.

use program_update::{
    Abort, Action, Area, Command, Mailbox, Object, Started, Unsigned, Updater,
    program::{Confirm, Program},
    start::{Cause, Start, Why, decide},
};

use crate::{flash::Chip, program::expected};

/// More steps than anything takes.
const MANY: usize = 20_000;
const SECOND: u32 = 1_000_000;

pub type Loader = Updater<Chip, Unsigned, 64>;

/// The power has failed.
#[derive(Debug)]
pub struct Cut;

/// What a device runs after a start.
pub enum Runs {
    Loader(Box<Loader>),
    /// Whether it is on trial.
    Program(bool),
}

#[derive(Clone)]
pub struct Device {
    pub chip: Chip,
    pub mailbox: Option<Mailbox>,
    pub files: Vec<Vec<u8>>,
    pub now: u32,
}

impl Device {
    pub fn new(chip: Chip, files: Vec<Vec<u8>>) -> Self {
        Self { chip, mailbox: None, files, now: 0 }
    }

    pub fn check_power(&self) -> Result<(), Cut> {
        if self.chip.has_power() { Ok(()) } else { Err(Cut) }
    }

    /// The power comes back.
    pub fn power_on(&mut self) {
        self.chip.start();
        self.mailbox = None;
    }

    pub fn start(&mut self) -> Result<Runs, Cut> {
        self.start_after(Cause::Other)
    }

    pub fn start_after(&mut self, cause: Cause) -> Result<Runs, Cut> {
        let (start, mailbox) = decide(&mut self.chip, self.mailbox, cause);
        self.check_power()?;
        self.mailbox = Some(mailbox);
        match start {
            Start::Program => {
                self.number();
                Ok(Runs::Program(mailbox.started == Started::Trial))
            }
            Start::Loader(why) => {
                let loader = self.loader(why);
                self.check_power()?;
                Ok(Runs::Loader(loader.into()))
            }
        }
    }

    pub fn loader(&self, why: Why) -> Loader {
        Loader::new(self.chip.clone(), Unsigned, expected(768), why, self.now)
    }

    /// The program in RUN, which must be certain.
    pub fn number(&self) -> usize {
        let is_there = |file: &Vec<u8>| self.chip.holds(Area::Run, file);
        self.files.iter().position(is_there).expect("the program that is started is certain")
    }

    /// The program hands over to the loader.
    pub fn stop(&mut self) -> Result<Box<Loader>, Cut> {
        self.mailbox = Some(Mailbox { command: Command::Stop, ..Mailbox::default() });
        match self.start()? {
            Runs::Loader(loader) => Ok(loader),
            Runs::Program(_) => panic!("the program is started in spite of the stop"),
        }
    }

    /// Polls until the loader is ready. It may ask for a reset instead.
    pub fn work(&mut self, loader: &mut Loader) -> Result<Option<Action>, Cut> {
        for _ in 0..MANY {
            let action = loader.poll(self.now);
            self.check_power()?;
            if action.is_some() || !loader.is_busy() {
                return Ok(action);
            }
        }
        panic!("the loader is busy for ever");
    }

    /// Downloads a file, in parts as the loader has room for them; `Err` inside has the abort code.
    pub fn download(
        &mut self,
        loader: &mut Loader,
        file: &[u8],
        part: usize,
    ) -> Result<Result<(), Abort>, Cut> {
        let mut offset = 0;
        while offset < file.len() {
            let len = part.min(loader.room()).min(file.len() - offset);
            if let Err(abort) = loader.write(offset as u32, &file[offset..offset + len]) {
                return Ok(Err(abort));
            }
            offset += len;
            loader.poll(self.now);
            self.check_power()?;
        }
        if let Err(abort) = loader.end(file.len() as u32) {
            return Ok(Err(abort));
        }
        match self.work(loader)? {
            Some(Action::Answer(outcome)) => Ok(outcome),
            other => panic!("no answer to the end of a download but {other:?}"),
        }
    }

    /// The client updates the device, and confirms if it shall; returns the abort code of a step that fails.
    pub fn update(&mut self, loader: &mut Loader, number: usize) -> Result<Result<(), Abort>, Cut> {
        if let Err(abort) = loader.write_control(3) {
            return Ok(Err(abort));
        }
        if let Some(action) = self.work(loader)? {
            panic!("a clear ends with {action:?}");
        }
        let status = loader.read(Object::FlashStatus);
        if status != 0 {
            return Ok(Err(Abort::Hardware));
        }
        let file = self.files[number].clone();
        if let Err(abort) = self.download(loader, &file, 100)? {
            return Ok(Err(abort));
        }
        if let Err(abort) = loader.write_control(1) {
            return Ok(Err(abort));
        }
        loader.answered(self.now);
        self.now = self.now.wrapping_add(SECOND);
        assert_eq!(loader.poll(self.now), Some(Action::Reset));
        Ok(Ok(()))
    }

    /// The client confirms the program.
    pub fn confirm(&mut self) -> Result<Result<(), Abort>, Cut> {
        let mut program = Program::new(&mut self.chip, self.mailbox, Confirm::ByMaster, self.now);
        let outcome = program.confirm(&mut self.chip);
        self.check_power()?;
        Ok(outcome)
    }

    /// Nobody speaks to the device, and each trial fails: the program that it runs in the end.
    pub fn alone(&mut self) -> Result<usize, Cut> {
        for _ in 0..10 {
            match self.start()? {
                Runs::Program(false) => return Ok(self.number()),
                Runs::Program(true) => {}
                Runs::Loader(mut loader) => {
                    if self.work(&mut loader)?.is_none() {
                        self.now = self.now.wrapping_add(60 * SECOND);
                        let action = loader.poll(self.now);
                        assert_eq!(action, Some(Action::Reset), "it stays in the loader");
                    }
                }
            }
        }
        panic!("it starts again and again");
    }
}
