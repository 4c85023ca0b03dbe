//! A new program over CANopen (CiA 302-3), such that no power cut and no bad program leaves a device without one.
//!
//! The library reads no clock, knows no chip and no CANopen stack, allocates nothing and cannot panic. Its parts:
//!
//! - [`header`]: the update file. A tool builds and checks a file with the same code as the loader.
//! - [`start`]: what a device starts after a reset.
//! - [`Updater`]: the loader's objects 1F50h, 1F51h, 1F56h, 1F57h and 2001h. It clears, takes a download and restores
//!   the program before, one small step of the flash at a time.
//! - [`program`]: the program's side of the same objects: it hands over to the loader, and confirms its trial.
//! - `signature`, with the feature `signed`: Ed25519 and SHA-256, by which a loader takes only programs of one author.
//! - [`Mailbox`]: 32 bytes of RAM in which loader and program leave each other what is in force.
//!
//! # The two areas
//! A program runs at one address, in the area RUN. The area BACKUP takes a copy of it before RUN is erased. Both begin
//! with a header of 512 bytes; in that of BACKUP the last words are the [`journal`].
//!
//! # The promise
//! Whenever the power fails, a later start starts the program that was confirmed last or, if its confirmation was not
//! answered yet, perhaps the one that was on trial. It never starts a program of which a cell is uncertain. A word whose
//! programming was interrupted may read as before, as programmed or as anything, differently at each start, and so may
//! each word whose erase was interrupted.
//!
//! A test explores every run of an update with two power cuts, and with three if it is asked to. Only the very word that
//! ends a restore has a limit: it is there three times, and cuts in all three of them, each followed by one in the erase
//! of RUN, are too many.

#![no_std]
#![forbid(unsafe_code)]
#![deny(missing_docs)]

mod answers;
pub mod crc;
mod download;
mod flash;
pub mod header;
pub mod journal;
mod mailbox;
pub mod program;
#[cfg(feature = "signed")]
pub mod signature;
pub mod start;
mod updater;

pub use answers::{Abort, Object, State, Status};
pub use flash::{Area, Flash, FlashError, ROW};
pub use header::{Expected, Header, Release, Signed, Unsigned, Verify};
pub use mailbox::{Command, Mailbox, Started};
pub use updater::{Action, Updater};
