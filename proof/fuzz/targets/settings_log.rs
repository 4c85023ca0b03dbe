//! The settings log: any content of the flash, stores, power cuts in any step; acknowledged settings are found again.

#![no_main]

use canopen_node::settings::{Found, Log};
use libfuzzer_sys::fuzz_target;
use testkit::{
    flash::Flash,
    power_cut::Expected,
    settings::{open_with_parameters, settings},
};

/// A power-on: the number of stores, and the program or erase step in which the power fails; 0: none.
type Life = (u8, u8);

fuzz_target!(|input: (u8, Vec<Life>, Vec<u8>)| {
    let (seed, lives, content) = input;
    // In a bank of words, the mark and the record that is copied take two places. More cut starts may fill the others
    // with copies that are not certain, as `docs/settings.md` says, and so the eight places that wide units keep.
    match seed % 4 {
        0 => run::<8, { 12 * 48 }>(4, seed, lives, content),
        1 => run::<32, { 12 * 96 }>(4, seed, lives, content),
        _ => run::<4, 128>(2, seed, lives, content),
    }
});

/// Lives of a device with banks of `BANK` bytes. A power cut may interrupt as many starts in a row.
fn run<const UNIT: usize, const BANK: usize>(
    most_cut_starts: usize,
    seed: u8,
    lives: Vec<Life>,
    mut content: Vec<u8>,
) {
    content.resize(2 * BANK, 0xFF);
    let flash = Flash::<UNIT, BANK>::with_content(content, seed.into());

    let (_, known, found) = open_with_parameters::<0, UNIT, BANK>(&flash);
    let again = Log::open(flash.clone()).0.settings();
    assert_eq!(again, known.0, "two power-ons without a store between find the same");
    // Records in both banks that were not stored here may be in any order: then only panics count.
    let is_own = matches!(found, Found::Blank | Found::Damaged);
    let mut expected = Expected::<0>::of(known);
    let mut cut_starts = 0;
    for (stores, cut) in lives {
        if cut > 0 && cut_starts < most_cut_starts {
            flash.cut_power_after(usize::from(cut) - 1);
        }
        if is_own {
            let is_complete = expected.power_on(&flash, usize::from(stores % 8));
            cut_starts = if is_complete { 0 } else { cut_starts + 1 };
        } else {
            let (mut log, _) = Log::open(flash.clone());
            let stored = (0..u16::from(stores % 8)).take_while(|_| flash.is_powered());
            stored.for_each(|number| _ = log.store(settings(number)));
        }
        flash.power_on();
    }
}
