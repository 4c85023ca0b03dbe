//! The calls of program updates, over a flash with any content, whose operations fail arbitrarily.

use core::hint::black_box;

use program_update::{
    Area, Expected, Flash, FlashError, Header, Mailbox, Object, Status, Unsigned, Updater,
    header::{check_file, text, text_of},
    journal::Journal,
    program::{Confirm, Program},
    start::{self, Cause, Why},
};

use super::{any, any_number};

struct Chip;

impl Flash for Chip {
    fn sectors(&self, _: Area) -> &'static [u32] {
        any(&[])
    }

    fn read(&mut self, _: Area, _: u32) -> u32 {
        any_number()
    }

    fn program(&mut self, _: Area, _: u32, _: &[u32]) -> Result<(), FlashError> {
        any(Ok(()))
    }

    fn erase(&mut self, _: Area, _: usize) -> Result<(), FlashError> {
        any(Ok(()))
    }

    fn poll(&mut self) -> Option<Result<(), FlashError>> {
        any(None)
    }
}

fn any_expected() -> Expected {
    Expected {
        vendor_id: any_number(),
        product_code: any_number(),
        hardware: any_number(),
        chip: any([0; 16]),
        controller: any_number(),
        address: any_number(),
        capacity: any_number(),
        ram: any_number()..any_number(),
        allows_downgrade: any(true),
    }
}

fn any_object() -> Object {
    any(Object::Control)
}

pub fn install() {
    let mailbox = Mailbox::from_words(&any([0; 8]));
    black_box(start::decide(&mut Chip, mailbox, any(Cause::Other)));
    black_box(any(Mailbox::default()).to_words());
    load();
    run(mailbox);
    check();
}

fn load() {
    let why = any(Why::Stop);
    let mut updater: Updater<_, _, 64> =
        Updater::new(Chip, Unsigned, any_expected(), why, any_number());
    // After any calls, with the loader in any state.
    black_box(&mut updater);
    black_box(updater.poll(any_number()));
    black_box(&mut updater);
    black_box(updater.write_control(any(0))).ok();
    black_box(&mut updater);
    black_box(updater.write(any_number(), any(&[][..]))).ok();
    black_box(&mut updater);
    black_box(updater.end(any_number())).ok();
    black_box(&mut updater);
    updater.abort();
    updater.requested(any_number());
    updater.answered(any_number());
    black_box(&mut updater);
    black_box((updater.read(any_object()), updater.room(), updater.is_busy()));
    black_box((updater.is_without_program(), updater.header()));
}

fn run(mailbox: Option<Mailbox>) {
    let mut program = Program::new(&mut Chip, mailbox, any(Confirm::ByItself), any_number());
    black_box(&mut program);
    black_box(program.write_control(any(0), any(true))).ok();
    program.answered(any_number());
    black_box(program.poll(any(true), any_number()));
    black_box(program.confirm(&mut Chip)).ok();
    black_box((program.read(any_object()), program.is_on_trial()));
}

fn check() {
    let header = check_file(any(&[][..]), &any_expected(), any(None));
    black_box(header.map(|header: Header| header.to_bytes())).ok();
    black_box(text_of(any(&[][..])).len());
    black_box(text::<16>(any("")));
    black_box(any(Status::Ok).value(any(true)));
    black_box(Journal::open(&mut Chip).state());
}
