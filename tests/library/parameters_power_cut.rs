//! Parameters in the settings log with power cuts in any program or erase step, also two in a row: settings and
//! parameters of an acknowledged store are found together, and what was found once stays.

use lss_slave::settings::Log;
use testkit::{
    flash::Flash,
    random::Random,
    settings::{Content, open_with_parameters, parameters, settings},
};

/// The longest parameters, which take two places of 32 bytes.
const LEN: usize = 40;

/// What may be found at the next power-on.
#[derive(Clone)]
struct Expected {
    /// The content last stored or found.
    known: Content,
    /// The contents of later stores that the power cuts interrupted.
    attempted: Vec<Content>,
    /// The number of the next store.
    next: u16,
}

impl Expected {
    /// The expectation for a new device.
    fn nothing() -> Self {
        Self { known: (None, Vec::new()), attempted: Vec::new(), next: 1 }
    }

    /// The content after the next store: of settings, of parameters, of both, or one without parameters.
    fn next(&mut self) -> Content {
        let n = self.next;
        self.next += 1;
        let old = self.attempted.last().unwrap_or(&self.known);
        match n % 5 {
            0 => (Some(settings(n)), Vec::new()),
            1 | 3 => (Some(settings(n)), parameters(n, 4 + usize::from(n % 31))),
            2 => (Some(settings(n)), old.1.clone()),
            _ => (old.0.or(Some(settings(n))), parameters(n, 20)),
        }
    }
}

/// Makes a content persistent by the call that a board would use.
fn store<const W: usize, const E: usize>(log: &mut Log<Flash<W, E>, LEN>, new: &Content) -> bool {
    let settings = new.0.expect("settings");
    if new.1 == log.parameters() {
        return log.store(settings).is_ok();
    }
    log.store_with_parameters(settings, &new.1).is_ok()
}

/// The life of a device until its power fails: it is powered on, stores, and is powered on again, until it has made a
/// number of stores.
fn live<const W: usize, const E: usize>(
    flash: &Flash<W, E>,
    expected: &mut Expected,
    stores: usize,
) {
    const STORES_A_POWER_ON: usize = 2;
    let mut made = 0;
    loop {
        flash.cycle_power();
        let (mut log, read, found) = open_with_parameters(flash);
        if !flash.is_powered() {
            return;
        }
        assert!(
            read == expected.known || expected.attempted.contains(&read),
            "{found:?} {read:?}, but {:?} is known and {:?} were attempted",
            expected.known,
            expected.attempted
        );
        expected.known = read;
        expected.attempted.clear();
        if made >= stores {
            return;
        }
        for _ in 0..STORES_A_POWER_ON {
            let new = expected.next();
            made += 1;
            let erases = flash.erases();
            let is_stored = store(&mut log, &new);
            assert_eq!(flash.erases(), erases, "only open erases");
            if is_stored {
                expected.known = new;
                expected.attempted.clear();
            } else if !flash.is_powered() {
                expected.attempted.push(new);
                return;
            }
        }
    }
}

/// Program and erase steps of a life without a power cut.
fn steps<const W: usize, const E: usize>(
    flash: &Flash<W, E>,
    expected: &Expected,
    stores: usize,
) -> usize {
    let flash = flash.duplicate(0);
    live(&flash, &mut expected.clone(), stores);
    flash.writes() + flash.erases()
}

/// Cuts the power in each step of a life, and then in one of `every` steps of the next life; a third life checks.
fn cut_twice<const W: usize, const E: usize>(stores: usize, every: usize) {
    let mut random = Random::from_environment();
    let new = Flash::<W, E>::blank(0);
    for first in 0..steps(&new, &Expected::nothing(), stores) {
        let flash = new.duplicate(random.u64());
        let mut expected = Expected::nothing();
        flash.cut_power_after(first);
        live(&flash, &mut expected, stores);
        assert!(!flash.is_powered(), "step {first}");
        let from = random.within(0..every as u64) as usize;
        for second in (from..steps(&flash, &expected, 4)).step_by(every) {
            let flash = flash.duplicate(random.u64());
            let mut expected = expected.clone();
            flash.cut_power_after(second);
            live(&flash, &mut expected, 4);
            flash.power_on();
            live(&flash, &mut expected, 4);
        }
    }
}

#[test]
fn two_cuts_in_any_steps_lose_no_parameters_in_the_smallest_banks() {
    cut_twice::<4, 192>(8, 3);
}

#[test]
fn two_cuts_in_any_steps_lose_no_parameters_written_in_words() {
    cut_twice::<4, 512>(14, 7);
}

#[test]
fn two_cuts_in_any_steps_lose_no_parameters_written_in_bytes() {
    cut_twice::<1, 256>(6, 61);
}

#[test]
fn random_histories_of_parameters_with_any_number_of_cuts_lose_nothing() {
    let mut random = Random::from_environment();
    for _ in 0..400 {
        let flash = Flash::<4, 256>::blank(random.u64());
        let mut expected = Expected::nothing();
        for _ in 0..20 {
            flash.cut_power_after(random.within(0..150) as usize);
            live(&flash, &mut expected, random.within(0..16) as usize);
            flash.power_on();
        }
        live(&flash, &mut expected, 4);
    }
}

#[test]
fn a_cut_store_leaves_both_old_or_both_new_at_every_power_on() {
    let mut random = Random::from_environment();
    let (old, new) =
        ((Some(settings(1)), parameters(1, 30)), (Some(settings(2)), parameters(2, 34)));
    // Parameters of two places, and the record: 24 words.
    for cut in 0..=24 {
        let mut found_new = 0;
        for _ in 0..50 {
            let flash = Flash::<4, 512>::blank(random.u64());
            let (mut log, ..) = open_with_parameters::<LEN, 4, 512>(&flash);
            assert!(store(&mut log, &old));
            flash.cut_power_after(cut);
            assert_eq!(store(&mut log, &new), cut == 24);
            flash.power_on();
            let first = open_with_parameters::<LEN, 4, 512>(&flash).1;
            assert!(first == old || first == new, "step {cut}: {first:?}");
            found_new += u32::from(first == new);
            for _ in 0..5 {
                flash.cycle_power();
                assert_eq!(open_with_parameters::<LEN, 4, 512>(&flash).1, first, "step {cut}");
            }
        }
        match cut {
            0..23 => assert_eq!(found_new, 0, "there is no commit word"),
            23 => assert!((1..50).contains(&found_new), "it may read as written"),
            _ => assert_eq!(found_new, 50),
        }
    }
}
