//! The settings log in flash of every program unit, in banks of several sectors: power cuts in any step, failing
//! operations, what is written.

use canopen_node::settings::{Error, Found, Log, parameters};
use testkit::{
    flash::{
        Flash,
        Operation::{Erase, Read, Write},
    },
    power_cut::{
        EachKind, Expected, MOST_CUT_FORMATS, cut_at_random, cut_twice, cut_while_moving, store,
        with_each_kind,
    },
    random::Random,
    settings::{
        Content, open, open_with_parameters, parameters as packed, record as handmade, sealed,
        settings,
    },
};

/// The longest parameters, which take two places.
const WITH_PARAMETERS: usize = 40;

/// The number of sectors of the smallest bank: in wide units, eight places are kept for starts.
const fn least(unit: usize) -> usize {
    if unit > 4 { 2 } else { 1 }
}

#[test]
fn two_cuts_in_any_steps_lose_nothing_with_any_unit() {
    struct Cuts;
    impl EachKind for Cuts {
        fn run<const W: usize, const E: usize>(&mut self) {
            let every = if W < 4 { 97 } else { 17 };
            cut_twice::<0, W, E>(&vec![0xFF; 2 * least(W) * E], 10, every);
            cut_twice::<0, W, E>(&vec![0xA5; 4 * E], 4, every);
            cut_twice::<WITH_PARAMETERS, W, E>(&vec![0xFF; 6 * E], 9, 3 * every);
        }
    }
    with_each_kind(&mut Cuts);
}

#[test]
fn random_histories_lose_nothing_with_any_unit() {
    struct Cuts;
    impl EachKind for Cuts {
        fn run<const W: usize, const E: usize>(&mut self) {
            cut_at_random::<0, W, E>(2, 100, 100, 20);
            cut_at_random::<WITH_PARAMETERS, W, E>(2, 80, 120, 16);
        }
    }
    with_each_kind(&mut Cuts);
}

/// The starts in a row that are cut: a bank in words has so many places for copies, and where units are wide, a start
/// takes at most two of the eight that are kept for it.
const fn most_cut_starts(unit: usize) -> u32 {
    if unit > 4 { 4 } else { 2 }
}

#[test]
fn many_cut_starts_in_a_row_lose_nothing_with_any_unit() {
    struct Cuts;
    impl EachKind for Cuts {
        fn run<const W: usize, const E: usize>(&mut self) {
            cut_starts_in_a_row::<0, W, E>(least(W), 500);
            cut_starts_in_a_row::<WITH_PARAMETERS, W, E>(least(W) + 1, 200);
        }
    }
    with_each_kind(&mut Cuts);
}

fn cut_starts_in_a_row<const P: usize, const W: usize, const E: usize>(
    sectors: usize,
    histories: usize,
) {
    let mut random = Random::from_environment();
    for _ in 0..histories {
        let flash = Flash::<W, E>::blank_with_sectors(sectors, random.u64());
        let mut expected = Expected::<P>::nothing();
        let mut cut_starts = 0;
        for life in 0..40 {
            let stores = if random.one_in(3) { random.within(0..4) } else { 0 };
            let may_cut = life < MOST_CUT_FORMATS || expected.is_formatted;
            if may_cut && cut_starts < most_cut_starts(W) {
                flash.cut_power_after(random.within(0..20 + 8 * stores) as usize);
            }
            let is_complete = expected.power_on(&flash, stores as usize);
            cut_starts = if is_complete { 0 } else { cut_starts + 1 };
            flash.power_on();
        }
    }
}

#[test]
fn erases_that_are_cut_any_number_of_times_lose_nothing_with_any_unit() {
    struct Cuts;
    impl EachKind for Cuts {
        fn run<const W: usize, const E: usize>(&mut self) {
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
        }
    }
    with_each_kind(&mut Cuts);
}

/// The number of steps of the next start before its first erase, if it erases.
fn first_erase<const W: usize, const E: usize>(flash: &Flash<W, E>) -> Option<usize> {
    let flash = flash.duplicate(0);
    flash.fail(Erase);
    open(&flash);
    (flash.erases() > 0).then(|| flash.writes())
}

#[test]
fn cuts_while_the_log_moves_in_sectors_of_2_kb_and_of_16_kb_lose_nothing() {
    let mut random = Random::from_environment();
    let random = &mut random;
    let cuts = cut_while_moving::<0, 4, 0x800>(2, random)
        + cut_while_moving::<WITH_PARAMETERS, 8, 0x800>(2, random)
        + cut_while_moving::<0, 8, 0x4000>(1, random)
        + cut_while_moving::<WITH_PARAMETERS, 16, 0x800>(3, random)
        + cut_while_moving::<0, 32, 0x4000>(1, random);
    assert!(cuts > 500, "{cuts}");
}

#[test]
fn parameters_up_to_the_capacity_can_be_stored_after_every_start_with_any_unit() {
    struct Stores;
    impl EachKind for Stores {
        fn run<const W: usize, const E: usize>(&mut self) {
            for sectors in 2..6 {
                let len = parameters::capacity(sectors * E, W) - 6;
                let flash = Flash::<W, E>::blank_with_sectors(sectors, 0);
                let mut last = (None, Vec::new());
                for n in 1..40 {
                    let (mut log, found, _) = open_with_parameters::<1024, W, E>(&flash);
                    assert_eq!(found, last);
                    last = (Some(settings(n)), packed(n, len));
                    assert!(store(&mut log, &last), "unit of {W}, {len} bytes, store {n}");
                }
            }
        }
    }
    with_each_kind(&mut Stores);
    assert_eq!(parameters::capacity(0x4000, 4), 6120);
    assert_eq!(parameters::capacity(0x4000, 8), 165 * 24);
}

#[test]
fn the_place_in_flash_with_wide_units_is_the_documented_one() {
    let flash = Flash::<16, 0x800>::blank(0);
    let (mut log, ..) = open_with_parameters::<WITH_PARAMETERS, 16, 0x800>(&flash);
    let other_is = |place: usize| flash.content()[place * 64 + 16 + 22];
    assert_eq!([0, 1, 2].map(other_is), [0, 1, 2], "used, doomed, erased");
    let parameters = packed(5, 18);
    log.store_with_parameters(settings(5), &parameters).unwrap();

    let content = flash.content();
    let (part, record) = (&content[3 * 64..4 * 64], &content[4 * 64..5 * 64]);
    assert_eq!([&part[..16], &record[..16]], [[0; 16]; 2], "they are begun");
    assert_eq!(part[16..20], 35_u32.to_le_bytes(), "the sequence begins with the places of a bank");
    assert_eq!(part[20..44], parameters);
    assert_eq!(part[44..48], *b"\0\0SP");
    assert_eq!(part[48..], [0xFF; 16]);
    let mut expected = handmade(36, 1, 5, settings(5).bit_rate.index(), 5);
    expected[10..22].copy_from_slice(&record[26..38]);
    expected[22] = 2;
    assert_eq!(record[16..48], sealed(expected));
    assert_eq!(record[48..56], record[40..48], "it is certain");
    assert_eq!(record[56..], [0xFF; 8]);
    assert_eq!(content[5 * 64..], [0xFF; 0x1000 - 5 * 64]);
}

#[test]
fn full_banks_refuse_a_store_and_the_next_start_makes_room_with_any_unit() {
    struct Stores;
    impl EachKind for Stores {
        fn run<const W: usize, const E: usize>(&mut self) {
            let flash = Flash::<W, E>::blank_with_sectors(4, 0);
            // Of 24 places eight are kept for starts.
            let room = if W > 4 { 24 - 8 } else { 16 - 1 };
            let mut n = 0;
            for _ in 0..5 {
                let (mut log, _) = Log::open(flash.clone());
                let erases = flash.erases();
                let mut stored = 0;
                let outcome = loop {
                    n += 1;
                    match log.store(settings(n)) {
                        Ok(()) => stored += 1,
                        Err(error) => break error,
                    }
                };
                assert_eq!(outcome, Error::Full);
                assert!(stored >= room, "unit of {W}: {stored} stores");
                assert_eq!((log.settings(), flash.erases()), (Some(settings(n - 1)), erases));
                assert_eq!(open(&flash.duplicate(0)).0, Some(settings(n - 1)));
            }
        }
    }
    with_each_kind(&mut Stores);
}

#[test]
fn a_start_after_a_store_writes_nothing_with_any_unit() {
    struct Stores;
    impl EachKind for Stores {
        fn run<const W: usize, const E: usize>(&mut self) {
            let flash = Flash::<W, E>::blank_with_sectors(4, 0);
            assert_eq!(open(&flash), (None, Found::Blank));
            for n in 1..5 {
                let (mut log, found) = Log::open(flash.clone());
                assert_eq!(found, Found::Complete);
                log.store(settings(n)).unwrap();
                let steps = (flash.writes(), flash.erases());
                assert_eq!(open(&flash), (Some(settings(n)), Found::Complete));
                assert_eq!((flash.writes(), flash.erases()), steps);
            }
        }
    }
    with_each_kind(&mut Stores);
}

/// A flash that holds content 1, and in whose bank `taken` more places are.
fn with_content_1<const W: usize, const E: usize>(taken: u16) -> Flash<W, E> {
    let flash = Flash::blank_with_sectors(4, 7);
    let (mut log, ..) = open_with_parameters::<WITH_PARAMETERS, W, E>(&flash);
    for n in 0..taken {
        log.store(settings(100 + n)).unwrap();
    }
    assert!(store(&mut log, &content(1)));
    flash
}

fn content(n: u16) -> Content {
    (Some(settings(n)), packed(n, 30))
}

fn found<const W: usize, const E: usize>(flash: &Flash<W, E>) -> Content {
    open_with_parameters::<WITH_PARAMETERS, W, E>(flash).1
}

#[test]
fn a_store_in_which_any_operation_fails_keeps_the_old_values_with_any_unit() {
    struct Faults;
    impl EachKind for Faults {
        fn run<const W: usize, const E: usize>(&mut self) {
            // A later store moves to the other bank.
            for (taken, operation) in (0..12).flat_map(|n| [(n, Read), (n, Write)]) {
                let beginning = with_content_1::<W, E>(taken);
                for others in 0.. {
                    let flash = beginning.duplicate(0);
                    let (mut log, ..) = open_with_parameters::<WITH_PARAMETERS, W, E>(&flash);
                    flash.fail_once(operation, others);
                    let is_stored = store(&mut log, &content(2));
                    if flash.is_faulty() {
                        assert!(others > 2, "it reads and writes");
                        break;
                    }
                    let left = content(if is_stored { 2 } else { 1 });
                    let case = format!("unit of {W}, {operation:?} {others}, stored: {is_stored}");
                    assert_eq!((log.settings(), log.parameters()), (left.0, &left.1[..]), "{case}");
                    assert_eq!(found(&flash.duplicate(others as u64)), left, "{case}");
                    assert!(store(&mut log, &content(3)), "{case}");
                    assert_eq!(found(&flash), content(3), "{case}");
                }
            }
        }
    }
    with_each_kind(&mut Faults);
}

#[test]
fn a_start_in_which_any_operation_fails_loses_nothing_with_any_unit() {
    struct Faults;
    impl EachKind for Faults {
        fn run<const W: usize, const E: usize>(&mut self) {
            // Behind the last one, the log has just moved.
            for (taken, operation) in (6..16).flat_map(|n| [Read, Write, Erase].map(|it| (n, it))) {
                let beginning = with_content_1::<W, E>(taken);
                for others in 0.. {
                    let flash = beginning.duplicate(0);
                    flash.fail_once(operation, others);
                    open_with_parameters::<WITH_PARAMETERS, W, E>(&flash);
                    if flash.is_faulty() {
                        break;
                    }
                    let case = format!("unit of {W}, {taken} places, {operation:?} {others}");
                    let (mut log, then, _) = open_with_parameters::<WITH_PARAMETERS, W, E>(&flash);
                    assert_eq!(then, content(1), "{case}");
                    assert!(store(&mut log, &content(2)), "{case}");
                    assert_eq!(found(&flash), content(2), "{case}");
                }
            }
        }
    }
    with_each_kind(&mut Faults);
}

#[test]
fn a_flash_of_any_unit_that_fails_is_reported_and_not_erased() {
    struct Faults;
    impl EachKind for Faults {
        fn run<const W: usize, const E: usize>(&mut self) {
            for operation in [Read, Write, Erase] {
                let flash = Flash::<W, E>::blank_with_sectors(2, 0);
                flash.fail(operation);
                let (mut log, found) = Log::open(flash.clone());
                assert!(matches!(found, Found::MediumFailed(_)), "unit of {W}, {operation:?}");
                assert_eq!(log.settings(), None);
                assert!(log.store(settings(1)).is_err());
            }
            let flash = with_content_1::<W, E>(0);
            let erases = flash.erases();
            for others in 0..40 {
                let flash = flash.duplicate(0);
                flash.fail_after(Read, others);
                Log::open(flash.clone());
                assert_eq!(flash.erases(), 0, "unit of {W}, {others}");
                flash.repair();
                assert_eq!(found(&flash), content(1), "unit of {W}, {others}");
            }
            assert_eq!(flash.erases(), erases);
        }
    }
    with_each_kind(&mut Faults);
}
