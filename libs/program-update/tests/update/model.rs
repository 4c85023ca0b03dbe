//! Every run of an update with a few power cuts, on the code of the library.
//!
//! What a cut leaves uncertain is chosen at each start, in each way: a word of the journal reads blank, partly
//! programmed, set or void; an area whose erase or last word was interrupted reads as its program, or damaged.

mod flash;
mod session;

use std::{
    collections::{HashMap, VecDeque},
    env,
    rc::Rc,
};

pub use flash::{Area, Journal};
use session::run;

/// What a device is before a part of a run, and what the world knows of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct World {
    pub run: Area,
    pub backup: Area,
    pub journal: Journal,
    /// The program that was confirmed last.
    pub kept: u8,
    /// The program that may have been confirmed since.
    pub maybe: u8,
    /// The number of the newest program.
    pub newest: u8,
    pub cuts: u8,
    pub at: At,
}

/// Where a run goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum At {
    /// At a start. The mailbox may say "stop".
    Start { stop: bool },
    /// In the loader, with a restore to do or without.
    Loader { restores: bool },
    /// In the program.
    Program { trial: bool },
}

/// Explores every run of `updates` updates with `cuts` power cuts; returns the number of states.
fn explore(updates: u8, cuts: u8) -> usize {
    let new = World {
        run: Area::Firm(0),
        backup: Area::Blank,
        journal: Journal::blank(),
        kept: 0,
        maybe: 0,
        newest: 0,
        cuts,
        at: At::Start { stop: false },
    };
    let images = flash::images(updates + 1);
    let mut before: HashMap<World, Option<(World, Rc<str>)>> = HashMap::from([(new, None)]);
    let mut open = VecDeque::from([new]);
    while let Some(world) = open.pop_front() {
        let after = run(world, updates, &images).unwrap_or_else(|error| {
            let mut story = format!("{error}\n  in {world:?}");
            let mut last = world;
            while let Some((earlier, why)) = &before[&last] {
                story += &format!("\n  {why} in {earlier:?}");
                last = *earlier;
            }
            panic!("{story}")
        });
        for (next, why) in after {
            before.entry(next).or_insert_with(|| {
                open.push_back(next);
                Some((world, why))
            });
        }
    }
    for program in 0..=updates {
        let is_reached = |world: &World| world.kept == program && world.run == Area::Firm(program);
        assert!(before.keys().any(is_reached), "program {program} is never kept");
    }
    before.len()
}

/// The number in an environment variable.
fn from_environment(name: &str, default: u8) -> u8 {
    env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

#[test]
fn any_cuts_leave_the_old_or_the_new_program() {
    let (updates, cuts) = (from_environment("UPDATES", 1), from_environment("CUTS", 2));
    println!("UPDATES={updates} CUTS={cuts}: {} states", explore(updates, cuts));
}
