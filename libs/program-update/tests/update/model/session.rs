//! A part of a run in the model: what the loader, the program and the client do.

use std::rc::Rc;

use program_update::{
    Action, Command, Mailbox, Started, Unsigned, Updater,
    program::{Confirm, Program},
    start::{Cause, Start, Why, decide},
};

use super::{
    Area, At, World,
    flash::{Chip, Choices, PROGRAM},
};
use crate::program::{expected, file};

/// More steps than any procedure takes.
const MANY: usize = 3000;

/// The states to which every run from a start on leads, with what has happened.
pub fn run(
    world: World,
    updates: u8,
    images: &Rc<Vec<Vec<u32>>>,
) -> Result<Vec<(World, Rc<str>)>, String> {
    let mut choices = Choices::default();
    let mut after = Vec::new();
    loop {
        let chip = Chip::new(world, choices, images.clone());
        let why = session(&chip, updates);
        let end = chip.world();
        let mut inner = chip.0.borrow_mut();
        if let Some(violation) = inner.violation.take() {
            return Err(format!("{violation} ({why})"));
        }
        after.extend(
            inner.cut.drain(..).map(|(world, cut)| (world, format!("{why}: {cut}").into())),
        );
        after.push((end, why.into()));
        choices = std::mem::take(&mut inner.choices);
        if !choices.advance() {
            return Ok(after);
        }
    }
}

/// One run up to where others may join it; returns what has happened.
fn session(chip: &Chip, updates: u8) -> &'static str {
    match chip.world().at {
        At::Start { stop } => start(chip, stop),
        At::Program { trial } => program(chip, trial),
        At::Loader { restores } => {
            let why = loader(chip, restores, updates);
            chip.change(|world| world.at = At::Start { stop: false });
            why
        }
    }
}

fn start(chip: &Chip, stop: bool) -> &'static str {
    let command = if stop { Command::Stop } else { Command::Start };
    let mailbox = Mailbox { command, ..Mailbox::default() };
    let (start, mailbox) = decide(&mut chip.clone(), Some(mailbox), Cause::Other);
    let at = match start {
        Start::Program => At::Program { trial: mailbox.started == Started::Trial },
        Start::Loader(why) => {
            chip.check(why != Why::NoProgram, "the loader finds no program");
            At::Loader { restores: why == Why::Restore }
        }
    };
    chip.change(|world| world.at = at);
    "a start"
}

fn program(chip: &Chip, trial: bool) -> &'static str {
    let world = chip.world();
    let Area::Firm(number) = world.run else {
        chip.check(false, "a program is started that is not certain");
        return "";
    };
    if !trial {
        let is_right = number == world.kept || number == world.maybe;
        chip.check(is_right, "another program is started than the one confirmed");
    }
    let (is_confirmed, stop) = (chip.choose(2) == 1, chip.choose(2) == 1);
    if is_confirmed {
        chip.change(|world| world.maybe = number);
        let started = if trial { Started::Trial } else { Started::Program };
        let mailbox = Mailbox { started, ..Mailbox::default() };
        let mut program = Program::new(&mut chip.clone(), Some(mailbox), Confirm::ByMaster, 0);
        if program.confirm(&mut chip.clone()).is_ok() {
            chip.change(|world| world.kept = number);
        }
    }
    chip.change(|world| world.at = At::Start { stop });
    match (is_confirmed, stop) {
        (false, false) => "a reset",
        (false, true) => "a stop",
        (true, false) => "a confirmation and a reset",
        (true, true) => "a confirmation and a stop",
    }
}

type Loader = Updater<Chip, Unsigned, 64>;

fn loader(chip: &Chip, restores: bool, updates: u8) -> &'static str {
    let world = chip.world();
    let why = if restores { Why::Restore } else { Why::Stop };
    let mut loader = Loader::new(chip.clone(), Unsigned, expected(768), why, 0);
    let may_clear = world.newest < updates;
    if !may_clear || chip.choose(2) == 0 {
        return leave(&mut loader, chip);
    }
    clear(&mut loader, chip);
    match chip.choose(4) {
        0 => "a clear",
        1 => {
            download(&mut loader, chip, world.newest + 1, false);
            "a broken download"
        }
        2 => {
            download(&mut loader, chip, world.newest + 1, false);
            clear(&mut loader, chip);
            "a broken download and another clear"
        }
        _ => {
            download(&mut loader, chip, world.newest + 1, true);
            match chip.choose(2) {
                0 => "a download",
                _ => {
                    clear(&mut loader, chip);
                    "a download and a clear"
                }
            }
        }
    }
}

/// The client stays away.
fn leave(loader: &mut Loader, chip: &Chip) -> &'static str {
    for _ in 0..MANY {
        match loader.poll(0) {
            Some(Action::Reset) => return "the loader resets by itself",
            Some(_) => chip.check(false, "it asks for what nobody waits for"),
            None if !loader.is_busy() => {
                let resets = loader.poll(60_000_000) == Some(Action::Reset);
                chip.check(resets, "the loader stays though there is a program");
                return "60 s in the loader";
            }
            None => {}
        }
    }
    chip.check(false, "the loader is busy for ever");
    ""
}

fn clear(loader: &mut Loader, chip: &Chip) {
    chip.check(loader.write_control(3).is_ok(), "clear is refused");
    for _ in 0..MANY {
        if !loader.is_busy() {
            let status = loader.read(program_update::Object::FlashStatus);
            chip.check(status == 0, "clear fails");
            return;
        }
        loader.poll(0);
    }
    chip.check(false, "clear takes for ever");
}

fn download(loader: &mut Loader, chip: &Chip, number: u8, is_complete: bool) {
    let file = file(number, PROGRAM);
    chip.check(loader.write(0, &file[..560]) == Ok(()), "the header is refused");
    while loader.is_busy() {
        loader.poll(0);
    }
    if !is_complete {
        loader.abort();
        return;
    }
    let outcome = loader.write(560, &file[560..]).and_then(|()| loader.end(file.len() as u32));
    chip.check(outcome == Ok(()), "the download fails");
    for _ in 0..MANY {
        if let Some(action) = loader.poll(0) {
            chip.check(action == Action::Answer(Ok(())), "the download is not right");
            return;
        }
    }
    chip.check(false, "a download is never answered");
}
