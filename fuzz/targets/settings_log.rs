//! The settings log: any content of the flash, stores, power cuts in any step; acknowledged settings are found again.

#![no_main]

use canopen_node::settings::{Found, Log};
use libfuzzer_sys::fuzz_target;
use testkit::{
    flash::Flash,
    power_cut::Expected,
    settings::{open_with_parameters, settings},
};

/// Bytes of one of the two banks: four records.
const BANK: usize = 128;

/// The starts in a row that a power cut may interrupt. More of them may fill a bank with copies that are not certain, as
/// `docs/settings.md` says.
const MOST_CUT_STARTS: usize = BANK / 32 - 2;

/// A power-on: the number of stores, and the program or erase step in which the power fails; 0: none.
type Life = (u8, u8);

fuzz_target!(|input: (u8, Vec<Life>, Vec<u8>)| {
    let (seed, lives, mut content) = input;
    content.resize(2 * BANK, 0xFF);
    let flash = Flash::<4, BANK>::with_content(content, seed.into());

    let (_, known, found) = open_with_parameters::<0, 4, BANK>(&flash);
    let again = Log::open(flash.clone()).0.settings();
    assert_eq!(again, known.0, "two power-ons without a store between find the same");
    // Records in both banks that were not stored here may be in any order: then only panics count.
    let is_own = matches!(found, Found::Blank | Found::Damaged);
    let mut expected = Expected::<0>::of(known);
    let mut cut_starts = 0;
    for (stores, cut) in lives {
        if cut > 0 && cut_starts < MOST_CUT_STARTS {
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
});
