//! The settings log: any content of the flash, stores, power cuts and failing operations in any step; acknowledged
//! settings are found again.

#![no_main]

use canopen_node::settings::{Found, Log};
use libfuzzer_sys::fuzz_target;
use testkit::{
    flash::{
        Flash,
        Operation::{Erase, Read, Write},
    },
    power_cut::{Expected, MOST_CUT_STARTS},
    settings::{open_with_parameters, settings},
};

/// A power-on: the number of stores, the program or erase step in which the power fails, and the operation that fails;
/// 0: none.
type Life = (u8, u8, u8);

fuzz_target!(|input: (u8, Vec<Life>, Vec<u8>)| {
    let (seed, lives, content) = input;
    match seed % 6 {
        0 => run::<1, { 12 * 40 }>(seed, lives, content),
        1 => run::<2, { 12 * 40 }>(seed, lives, content),
        2 => run::<8, { 12 * 48 }>(seed, lives, content),
        3 => run::<16, { 12 * 64 }>(seed, lives, content),
        4 => run::<32, { 12 * 96 }>(seed, lives, content),
        _ => run::<4, { 12 * 40 }>(seed, lives, content),
    }
});

/// Lives of a device with banks of `BANK` bytes.
fn run<const UNIT: usize, const BANK: usize>(seed: u8, lives: Vec<Life>, mut content: Vec<u8>) {
    content.resize(2 * BANK, 0xFF);
    let flash = Flash::<UNIT, BANK>::with_content(content, seed.into());

    let (_, known, found) = open_with_parameters::<0, UNIT, BANK>(&flash);
    let again = Log::open(flash.clone()).0.settings();
    assert_eq!(again, known.0, "two power-ons without a store between find the same");
    // Records in both banks that were not stored here may be in any order: then only panics count.
    let is_own = matches!(found, Found::Blank | Found::OtherData | Found::Damaged);
    let mut expected = Expected::<0>::of(known);
    let mut disturbed_starts = 0;
    for (stores, cut, fault) in lives {
        if disturbed_starts < MOST_CUT_STARTS {
            if cut > 0 {
                flash.cut_power_after(usize::from(cut) - 1);
            }
            if fault > 0 {
                let kinds = [Read, Write, Write, Erase];
                flash.fail_once(kinds[usize::from(fault % 4)], usize::from(fault / 4));
            }
        }
        if is_own {
            let is_complete = expected.power_on(&flash, usize::from(stores % 8));
            disturbed_starts = if is_complete { 0 } else { disturbed_starts + 1 };
        } else {
            let (mut log, _) = Log::open(flash.clone());
            let stored = (0..u16::from(stores % 8)).take_while(|_| flash.is_powered());
            stored.for_each(|number| _ = log.store(settings(number)));
        }
        flash.power_on();
        flash.repair();
    }
}
