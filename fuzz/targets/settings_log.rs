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
    for (stores, cut) in lives {
        if cut > 0 {
            flash.cut_power_after(usize::from(cut) - 1);
        }
        if is_own {
            expected.power_on(&flash, usize::from(stores % 8));
        } else {
            let (mut log, _) = Log::open(flash.clone());
            let stored = (0..u16::from(stores % 8)).take_while(|_| flash.is_powered());
            stored.for_each(|number| _ = log.store(settings(number)));
        }
        flash.power_on();
    }
});
