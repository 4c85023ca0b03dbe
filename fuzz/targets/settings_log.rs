//! The settings log: any content of the flash, stores, power cuts in any step; acknowledged settings are found again.

#![no_main]

use libfuzzer_sys::fuzz_target;
use lss_slave::{
    BitRate, NodeId, Settings,
    settings::{Found, Log},
};
use testkit::flash::Flash;

/// Bytes of one of the two banks: four records.
const BANK: usize = 128;

/// A power-on: the number of stores, and the program or erase step in which the power fails; 0: none.
type Life = (u8, u8);

fn settings(number: u16) -> Settings {
    Settings::new(BitRate::ALL[usize::from(number % 8)].into())
        .with_node_id(NodeId::new((number % 128) as u8))
        .with_heartbeat_ms(number)
}

fuzz_target!(|input: (u8, Vec<Life>, Vec<u8>)| {
    let (seed, lives, mut content) = input;
    content.resize(2 * BANK, 0xFF);
    let flash = Flash::<4, BANK>::with_content(content, seed.into());

    let (log, found) = Log::open(flash.clone());
    let mut known = log.settings();
    let again = Log::open(flash.clone()).0.settings();
    assert_eq!(again, known, "two power-ons without a store between find the same");
    // Records in both banks that were not stored here may be in any order: then only panics count.
    let is_own = matches!(found, Found::Blank | Found::Damaged);

    let mut number = 0;
    let mut attempted = None;
    for (stores, cut) in lives {
        if cut > 0 {
            flash.cut_power_after(usize::from(cut) - 1);
        }
        let (mut log, _) = Log::open(flash.clone());
        if flash.is_powered() {
            let read = log.settings();
            let is_possible = read == known || read.is_some() && read == attempted;
            assert!(is_possible || !is_own, "{read:?}, not {known:?} or {attempted:?}");
            (known, attempted) = (read, None);
            for _ in 0..stores % 8 {
                number += 1;
                match log.store(settings(number)) {
                    Ok(()) => known = Some(settings(number)),
                    Err(_) if !flash.is_powered() => attempted = Some(settings(number)),
                    // The bank is full until the next power-on.
                    Err(_) => {}
                }
                if !flash.is_powered() {
                    break;
                }
            }
        }
        flash.power_on();
    }
});
