//! The settings log with power cuts in any program or erase step, also several in a row and together with operations
//! that fail, in flash of every program unit: nothing acknowledged is lost, settings and parameters are found together,
//! and what was found once stays, although a torn unit reads differently at each read.

use canopen_node::settings::{Found, Log};
use testkit::{
    flash::{
        Flash, Left,
        Operation::{Erase, Read, Write},
    },
    power_cut::{Expected, MOST_CUT_FORMATS, MOST_CUT_STARTS, cut_at_random, cut_twice, store},
    random::{Random, every},
    settings::{open, open_with_parameters, parameters, settings},
    with_each_kind,
};

/// Room for parameters of three places, as in `settings_faults.rs`; those here take one or two.
const WITH_PARAMETERS: usize = 66;

#[test]
fn two_cuts_in_any_steps_lose_nothing_with_any_unit() {
    with_each_kind!(|W, E| {
        let every = every(5) * if W < 4 { 197 } else { 17 };
        cut_twice::<0, W, E>(&vec![0xFF; 4 * E], 10, every);
        // Garbage is formatted first.
        cut_twice::<0, W, E>(&vec![0xA5; 4 * E], 4, every);
        cut_twice::<WITH_PARAMETERS, W, E>(&vec![0xFF; 6 * E], 9, 3 * every);
    });
}

#[test]
fn random_histories_with_any_number_of_cuts_lose_nothing() {
    with_each_kind!(|W, E| {
        cut_at_random::<0, W, E>(2, 100, 100, 20);
        cut_at_random::<WITH_PARAMETERS, W, E>(2, 80, 120, 16);
    });
}

/// Lives in which at most so many starts in a row are cut, or have a failing operation.
fn disturb<const P: usize, const W: usize, const E: usize>(
    sectors: usize,
    histories: usize,
    fails: bool,
) {
    let mut random = Random::from_environment();
    for _ in 0..histories {
        let flash = Flash::<W, E>::blank_with_sectors(sectors, random.u64());
        let mut expected = Expected::<P>::nothing();
        let mut disturbed_starts = 0;
        for life in 0..40 {
            let stores = if random.one_in(3) { random.within(0..4) } else { 0 };
            let may_disturb = life < MOST_CUT_FORMATS || expected.is_formatted;
            if may_disturb && disturbed_starts < MOST_CUT_STARTS {
                let steps = 20 + stores * if W < 4 { 40 } else { 12 };
                let is_cut = !fails || random.one_in(2);
                if is_cut {
                    flash.cut_power_after(random.within(0..steps) as usize);
                }
                if fails && (!is_cut || expected.is_formatted) {
                    let operation = random.pick(&[Write, Write, Erase, Read]);
                    let others = random.within(0..if operation == Erase { 6 } else { steps });
                    if operation != Read && random.one_in(4) {
                        let left = random.pick(&[Left::Nothing, Left::SomeBits, Left::All]);
                        flash.die_after(operation, others as usize, left);
                    } else {
                        flash.fail_once(operation, others as usize);
                    }
                }
            }
            let is_complete = expected.power_on(&flash, stores as usize);
            disturbed_starts = if is_complete { 0 } else { disturbed_starts + 1 };
            flash.power_on();
            flash.repair();
        }
    }
}

#[test]
fn many_cut_starts_in_a_row_lose_nothing_with_any_unit() {
    with_each_kind!(|W, E| {
        disturb::<0, W, E>(2, 500 / every(5), false);
        disturb::<WITH_PARAMETERS, W, E>(3, 200 / every(5), false);
    });
}

#[test]
fn cuts_and_operations_that_fail_lose_nothing_together_with_any_unit() {
    with_each_kind!(|W, E| {
        disturb::<0, W, E>(2, 500 / every(5), true);
        disturb::<WITH_PARAMETERS, W, E>(3, 200 / every(5), true);
    });
}

#[test]
fn a_start_erases_only_what_a_certain_record_replaces() {
    with_each_kind!(|W, E| {
        let mut random = Random::from_environment();
        // Up to a store that moves to the other bank, each cut in its last steps.
        for stores in 3..8 {
            let beginning = Flash::<W, E>::blank_with_sectors(2, random.u64());
            let mut expected = Expected::<0>::nothing();
            expected.power_on(&beginning, stores);
            let uncut = beginning.duplicate(0);
            expected.clone().power_on(&uncut, 1);
            let steps = uncut.writes() + uncut.erases();
            let faults = (0..90).map(|number| (1 + number % 3, number % 20));
            for (back, fault) in faults {
                let flash = beginning.duplicate(random.u64());
                let mut expected = expected.clone();
                flash.cut_power_after(steps - back);
                expected.power_on(&flash, 1);
                flash.power_on();
                // An operation of the start fails, the power is cut later.
                flash.fail_once(random.pick(&[Write, Erase]), fault);
                flash.cut_power_after(fault + random.within(0..20) as usize);
                expected.power_on(&flash, 0);
                flash.repair();
                for _ in 0..3 {
                    flash.power_on();
                    expected.power_on(&flash, 0);
                }
            }
        }
    });
}

#[test]
fn a_start_that_cannot_write_erases_nothing_with_any_unit() {
    with_each_kind!(|W, E| {
        let flash = Flash::<W, E>::blank_with_sectors(2, 0);
        // One of these stores moves to the other bank.
        let erases = |n| {
            Log::open(flash.clone()).0.store(settings(n)).unwrap();
            let flash = flash.duplicate(n.into());
            flash.fail(Write);
            let found = open(&flash);
            assert_eq!(found.0, Some(settings(n)), "unit of {W}: {:?}", found.1);
            assert_eq!(flash.erases(), 0, "unit of {W}, {n} stores");
            flash.repair();
            open(&flash);
            flash.erases()
        };
        assert!((1..12).map(erases).sum::<usize>() > 0, "a start that can write erases");
    });
}

#[test]
fn erases_that_are_cut_any_number_of_times_lose_nothing_with_any_unit() {
    with_each_kind!(|W, E| {
        let mut random = Random::from_environment();
        let flash = Flash::<W, E>::blank_with_sectors(2, 0);
        let mut expected = Expected::<0>::nothing();
        expected.power_on(&flash, 0);
        let formatted = flash.erases();
        for _ in 0..400 {
            // Each start up to the erase, if there is one, writes at most two records.
            let stores = random.within(0..4) as usize;
            let mut cut_starts = 0;
            while random.one_in(2) || cut_starts < 20 {
                cut_starts += 1;
                let Some(step) = first_erase(&flash) else {
                    break;
                };
                flash.cut_power_after(step + random.within(0..2) as usize);
                expected.power_on(&flash, 0);
                flash.power_on();
            }
            expected.power_on(&flash, stores);
            flash.power_on();
        }
        assert!(flash.erases() > 20 * formatted, "it has moved often");
    });
}

/// The number of steps of the next start before its first erase, if it erases.
fn first_erase<const W: usize, const E: usize>(flash: &Flash<W, E>) -> Option<usize> {
    let flash = flash.duplicate(0);
    flash.fail(Erase);
    open(&flash);
    (flash.erases() > 0).then(|| flash.writes())
}

#[test]
fn every_start_that_is_not_cut_leaves_the_places_that_cut_starts_need() {
    with_each_kind!(|W, E| {
        let flash = Flash::<W, E>::blank_with_sectors(3, 0);
        for n in 0..300 {
            let (mut log, found) = Log::open(flash.clone());
            assert!(matches!(found, Found::Blank | Found::Complete | Found::Interrupted));
            let places = (W.max(4) * 2 + 32, 3 * E);
            let content = flash.content();
            let is_used = |bank: usize, place: usize| {
                let at = bank * places.1 + place * places.0;
                content[at..at + places.0].iter().any(|byte| *byte != 0xFF)
            };
            let count = places.1 / places.0;
            let used = [0, 1].map(|bank| (0..count).rev().find(|it| is_used(bank, *it)));
            let used = used.into_iter().flatten().max().expect("a record");
            assert!(used < count - 8, "unit of {W}: place {used} of {count} is used");
            // In the last bytes of the second store, so that a start copies it.
            log.store(settings(2 * n + 1)).ok();
            flash.cut_power_after((32 + 2 * W.max(4)) / W - 1);
            log.store(settings(2 * n + 2)).ok();
            flash.power_on();
        }
    });
}

/// Cuts the power in each step of a store of a record, behind parameters of these lengths if there is room for them.
fn cut_in_each_step<const LEN: usize>(old_len: usize, new_len: usize, steps: usize) {
    let mut random = Random::from_environment();
    let old = (Some(settings(1)), parameters(1, old_len));
    let new = (Some(settings(2)), parameters(2, new_len));
    for cut in 0..=steps {
        let mut found_new = 0;
        for _ in 0..100 {
            let flash = Flash::<4, 1024>::blank(random.u64());
            let (mut log, ..) = open_with_parameters::<LEN, 4, 1024>(&flash);
            assert!(store(&mut log, &old));
            flash.cut_power_after(cut);
            // It is stored as soon as it is valid.
            assert_eq!(store(&mut log, &new), cut + 1 >= steps);
            flash.power_on();
            let first = open_with_parameters::<LEN, 4, 1024>(&flash).1;
            assert!(first == old || first == new, "step {cut}: {first:?}");
            found_new += usize::from(first == new);
            for _ in 0..5 {
                flash.cycle_power();
                assert_eq!(open_with_parameters::<LEN, 4, 1024>(&flash).1, first, "step {cut}");
            }
        }
        // The commit word comes last, before what makes the record certain. If it is cut, it may read as written.
        let expected = if cut + 2 < steps {
            0..1
        } else if cut + 1 < steps {
            10..90
        } else {
            100..101
        };
        assert!(expected.contains(&found_new), "step {cut}: new in {found_new} of 100 cases");
    }
}

#[test]
fn a_cut_store_leaves_both_old_or_both_new_at_every_power_on() {
    cut_in_each_step::<0>(0, 0, 10);
    cut_in_each_step::<WITH_PARAMETERS>(30, 34, 28);
}

#[test]
fn a_start_formats_two_banks_whose_erases_were_cut() {
    fn format<const W: usize, const E: usize>() {
        for seed in 0..500 {
            let flash = Flash::<W, E>::blank(seed);
            for _ in 0..2 {
                flash.cut_power_after(0);
                open(&flash);
                flash.power_on();
            }
            let (_, found) = open(&flash);
            assert!(!matches!(found, Found::MediumFailed(_)), "seed {seed}: {found:?}");
        }
    }
    format::<1, { 12 * 40 }>();
    format::<2, { 12 * 40 }>();
    format::<4, { 12 * 40 }>();
    format::<8, { 12 * 48 }>();
    format::<32, { 12 * 96 }>();
}
