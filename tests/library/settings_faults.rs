//! The settings log in a failing flash, with and without parameters: reads, writes and erases with errors, a flash that
//! dies, stuck bits.

use canopen_node::{
    Settings,
    settings::{Error, Found, Log},
};
use testkit::{
    flash::{
        BoardFlash, Flash, Left,
        Operation::{Any, Erase, Read, Write},
    },
    node_rig::{ADDRESS, NodeRig, device},
    power_cut::store as stores,
    random::{Random, every},
    settings::{Content, open, open_with_parameters, parameters, settings},
    with_each_kind,
};

/// The longest parameters, which take three places.
const LEN: usize = 66;
/// A flash with 25 places a bank, of which eight are kept for starts.
type Chip = Flash<4, 1024>;
type ChipLog = Log<Chip, LEN>;
/// The length of a place.
const PLACE: usize = 40;

/// The lengths of the parameter that is stored with the settings; 0: none.
const LENS: [usize; 2] = [0, 60];

fn start(flash: &Chip) -> (ChipLog, Content, Found) {
    open_with_parameters(flash)
}

fn found<const W: usize, const E: usize>(flash: &Flash<W, E>) -> Content {
    open_with_parameters::<LEN, W, E>(flash).1
}

fn content(n: u16, len: usize) -> Content {
    (Some(settings(n)), parameters(n, len))
}

fn held<const W: usize, const E: usize>(log: &Log<Flash<W, E>, LEN>) -> Content {
    (log.settings(), log.parameters().to_vec())
}

fn store(log: &mut ChipLog, (settings, parameters): &Content) -> Result<(), Error> {
    log.store_with_parameters(settings.unwrap(), parameters)
}

/// A log that holds content 1, in place 2, or in the places 2 to 5.
fn with_content_1(len: usize) -> (ChipLog, Chip) {
    let flash = Flash::blank(7);
    let (mut log, ..) = start(&flash);
    store(&mut log, &content(1, len)).unwrap();
    (log, flash)
}

/// A flash that holds content 1 with parameters, and in which `taken` more places are.
fn with_places_taken<const W: usize, const E: usize>(taken: u16) -> Flash<W, E> {
    let flash = Flash::blank_with_sectors(4, 7);
    let (mut log, ..) = open_with_parameters::<LEN, W, E>(&flash);
    for n in 0..taken {
        log.store(settings(100 + n)).unwrap();
    }
    assert!(stores(&mut log, &content(1, 30)));
    flash
}

#[test]
fn a_flash_that_fails_refuses_stores_and_the_old_values_stay() {
    for (len, operation) in LENS.into_iter().flat_map(|len| [(len, Write), (len, Read)]) {
        let (mut log, flash) = with_content_1(len);
        flash.fail(operation);
        for n in 2..5 {
            assert_eq!(store(&mut log, &content(n, len)), Err(Error::Refused), "{operation:?}");
            assert_eq!(held(&log), content(1, len));
        }
        flash.repair();
        assert_eq!(found(&flash.duplicate(0)), content(1, len), "{operation:?}");
        assert_eq!(store(&mut log, &content(5, len)), Ok(()), "the flash works again");
        assert_eq!(found(&flash), content(5, len));
    }
}

#[test]
fn values_that_are_stored_again_after_a_failure_are_found() {
    let faults: [fn(&Chip, _, _); 2] = [Chip::fail_once, Chip::fail_after];
    for (len, fault) in LENS.into_iter().flat_map(|len| faults.map(|fault| (len, fault))) {
        for operation in [Write, Read] {
            for others in 0..40 {
                let (mut log, flash) = with_content_1(len);
                fault(&flash, operation, others);
                let is_stored = store(&mut log, &content(2, len)).is_ok();
                flash.repair();
                for again in [content(if is_stored { 2 } else { 1 }, len), content(1, len)] {
                    assert_eq!(store(&mut log, &again), Ok(()));
                    assert_eq!(found(&flash.duplicate(0)), again, "{operation:?} {others}");
                }
            }
        }
    }
}

/// Stores in a flash that dies for good at any operation. What is acknowledged is what the next start finds.
fn die_in_a_store<const W: usize, const E: usize>(taken: u16, new: &Content) {
    let beginning = with_places_taken::<W, E>(taken);
    // What cannot be read is as the flash says.
    for (operation, left) in
        [(Write, Left::Nothing), (Write, Left::SomeBits), (Write, Left::All), (Any, Left::Nothing)]
    {
        let mut outcomes = [false; 2];
        for others in 0.. {
            let flash = beginning.duplicate(others as u64);
            let (mut log, ..) = open_with_parameters::<LEN, W, E>(&flash);
            let old = held(&log);
            let steps = flash.writes();
            flash.die_after(operation, others, left);
            let is_stored = stores(&mut log, new);
            outcomes[usize::from(is_stored)] = true;
            let case = format!("unit of {W}, {taken} places, {operation:?} {others}, {left:?}");
            let next = if is_stored { new } else { &old };
            assert_eq!(held(&log), *next, "{case}");
            if operation == Write {
                assert_eq!(found(&flash), *next, "{case}: it is still dead");
            }
            let has_died = flash.has_died();
            flash.repair();
            assert_eq!(found(&flash), *next, "{case}: it works again");
            if !has_died {
                assert!(flash.writes() > steps + 8 / W);
                break;
            }
        }
        assert_eq!(outcomes, [true; 2]);
    }
}

#[test]
fn a_flash_that_dies_acknowledges_what_the_next_start_finds_with_any_unit() {
    with_each_kind!(|W, E| {
        // Some of the later stores move to the other bank.
        for taken in (6..14).step_by(every(3)) {
            die_in_a_store::<W, E>(taken, &content(2, 30));
            die_in_a_store::<W, E>(taken, &(Some(settings(2)), parameters(1, 30)));
        }
    });
}

#[test]
fn lss_answers_17_00_if_the_next_start_has_the_node_id_and_else_17_02() {
    for (full, left) in [0, 390, 391, 392, 393, 394, 395, 396, 397, 398, 399]
        .into_iter()
        .flat_map(|full| [Left::Nothing, Left::SomeBits, Left::All].map(|left| (full, left)))
    {
        let beginning = BoardFlash::blank(0);
        let (mut log, _) = Log::open(beginning.clone());
        for n in 0..=full {
            log.store(settings(if n == full { 1 } else { n + 2 })).unwrap();
        }
        for others in 0..24 {
            let flash = beginning.duplicate(others as u64);
            let mut rig = NodeRig::with_device(device(ADDRESS), flash.clone(), 0);
            rig.lss("04 01");
            rig.lss("11 05");
            flash.die_after(Write, others, left);
            let answer = rig.lss("17");
            flash.repair();
            let node_id = open(&flash).0.and_then(|found| found.node_id).map(|it| it.get());
            let case = format!("{full} places, write {others}, {left:?}");
            assert_eq!(answer == ["17 00"], node_id == Some(5), "{case}: {answer:?}");
            assert_eq!(answer == ["17 02"], node_id == Some(1), "{case}: {answer:?}");
        }
    }
}

#[test]
fn a_blank_flash_that_fails_is_reported_and_refuses() {
    for operation in [Read, Write, Erase] {
        let flash = BoardFlash::blank(0);
        flash.fail(operation);
        let (mut log, found) = Log::open(flash.clone());
        let failed = Found::MediumFailed(Error::Refused);
        assert_eq!((log.settings(), found), (None, failed), "{operation:?}");
        assert!(log.store(settings(1)).is_err(), "{operation:?}");
    }
}

#[test]
fn a_store_that_fails_gives_the_reason() {
    let why = |fault: fn(&Chip)| {
        let (mut log, flash) = with_content_1(0);
        fault(&flash);
        let outcome = (2..60).map(|n| log.store(settings(n))).find(Result::is_err);
        flash.repair();
        let (mut log, ..) = start(&flash);
        assert_eq!(log.store(settings(50)), Ok(()));
        outcome.expect("a failure").unwrap_err()
    };
    assert_eq!(why(|flash| flash.fail(Write)), Error::Refused);
    assert_eq!(why(|flash| flash.fail_once(Write, 1)), Error::Refused);
    assert_eq!(why(|flash| flash.stick(3 * PLACE + 8, 4, true)), Error::NotAsWritten);
    assert_eq!(
        why(|flash| (0..9).for_each(|place| flash.stick((place + 3) * PLACE, 1, false))),
        Error::NotBlank
    );
    assert_eq!(why(|_| ()), Error::Full);
}

#[test]
fn a_store_in_which_any_operation_fails_keeps_the_old_values_with_any_unit() {
    with_each_kind!(|W, E| {
        // A later store moves to the other bank.
        for (taken, operation) in (0..12).flat_map(|n| [(n, Read), (n, Write)]) {
            let beginning = with_places_taken::<W, E>(taken);
            for others in 0.. {
                let flash = beginning.duplicate(0);
                let (mut log, ..) = open_with_parameters::<LEN, W, E>(&flash);
                flash.fail_once(operation, others);
                let is_stored = stores(&mut log, &content(2, 30));
                if flash.is_faulty() {
                    assert!(others > 2, "it reads and writes");
                    break;
                }
                let left = content(if is_stored { 2 } else { 1 }, 30);
                let case = format!("unit of {W}, {operation:?} {others}, stored: {is_stored}");
                assert_eq!(held(&log), left, "{case}");
                assert_eq!(found(&flash.duplicate(others as u64)), left, "{case}");
                assert!(stores(&mut log, &content(3, 30)), "{case}");
                assert_eq!(found(&flash), content(3, 30), "{case}");
            }
        }
    });
}

#[test]
fn a_start_in_which_any_operation_fails_loses_nothing_with_any_unit() {
    with_each_kind!(|W, E| {
        // Behind the last one, the log has just moved.
        for (taken, operation) in (6..16).flat_map(|n| [Read, Write, Erase].map(|it| (n, it))) {
            let beginning = with_places_taken::<W, E>(taken);
            for others in 0.. {
                let flash = beginning.duplicate(0);
                flash.fail_once(operation, others);
                let (mut log, ..) = open_with_parameters::<LEN, W, E>(&flash);
                if flash.is_faulty() {
                    break;
                }
                let case = format!("unit of {W}, {taken} places, {operation:?} {others}");
                // A store by LSS keeps the parameters in flash.
                let is_stored = log.store(settings(8)).is_ok();
                let left = Some(settings(if is_stored { 8 } else { 1 }));
                let (mut log, then, _) = open_with_parameters::<LEN, W, E>(&flash);
                assert_eq!(then, (left, content(1, 30).1), "{case}");
                assert!(stores(&mut log, &content(2, 30)), "{case}");
                assert_eq!(found(&flash), content(2, 30), "{case}");
            }
        }
    });
}

/// Stores that are acknowledged after a start that failed, which came after a cut store: every start after them agrees.
fn store_after_a_failed_start<const W: usize, const E: usize>(stores: u16, random: &mut Random) {
    let beginning = Flash::<W, E>::blank_with_sectors(2, random.u64());
    (1..=stores).for_each(|n| Log::open(beginning.clone()).0.store(settings(n)).unwrap());
    let unfailing = beginning.duplicate(0);
    let mut log = Log::open(unfailing.clone()).0;
    let before = unfailing.writes();
    log.store(settings(90)).unwrap();
    let steps = unfailing.writes() - before;
    for (back, again) in (1..4).flat_map(|back| [(back, false), (back, true)]) {
        for _ in 0..40 {
            let others = random.within(0..2 * steps as u64) as usize;
            let flash = beginning.duplicate(random.u64());
            let mut log = Log::open(flash.clone()).0;
            flash.cut_power_after(steps - back);
            log.store(settings(90)).ok();
            flash.power_on();
            flash.fail_after(Write, others);
            let mut log = Log::open(flash.clone()).0;
            flash.repair();
            let new = log.settings().filter(|_| again).unwrap_or(settings(91));
            flash.fail_once(Write, random.within(0..2 * steps as u64) as usize);
            if log.store(new).is_ok() {
                flash.repair();
                for _ in 0..8 {
                    let next = open(&flash.duplicate(random.u64())).0;
                    assert_eq!(next, Some(new), "unit of {W}, {stores}, {back}, {others}, {again}");
                }
            }
        }
    }
}

#[test]
fn what_is_acknowledged_after_a_start_that_failed_stays_with_any_unit() {
    with_each_kind!(|W, E| {
        let mut random = Random::from_environment();
        // Some of the cut stores move to the other bank.
        for stores in 0..6 {
            store_after_a_failed_start::<W, E>(stores, &mut random);
        }
    });
}

#[test]
fn what_is_acknowledged_after_a_format_that_failed_stays_with_any_unit() {
    with_each_kind!(|W, E| {
        let formatted = Flash::<W, E>::blank_with_sectors(2, 0);
        Log::open(formatted.clone());
        let before = formatted.writes();
        Log::open(formatted.clone()).0.store(settings(1)).unwrap();
        let writes = 0..formatted.writes() - before;
        let format = (0..before).map(|others| (Write, others));
        for fault in format.chain((0..formatted.erases()).map(|others| (Erase, others))) {
            for others in writes.clone().step_by(every(5)) {
                let flash = Flash::<W, E>::blank_with_sectors(2, 0);
                flash.fail_once(fault.0, fault.1);
                let (mut log, _) = Log::open(flash.clone());
                flash.fail_once(Write, others);
                let is_stored = log.store(settings(1)).is_ok();
                flash.repair();
                for seed in 0..4 {
                    let next = open(&flash.duplicate(seed)).0;
                    let expected = is_stored.then_some(settings(1));
                    assert_eq!(next, expected, "unit of {W}, {fault:?}, {others}");
                }
            }
        }
    });
}

#[test]
fn a_store_that_fails_in_the_last_place_of_both_banks_is_taken_back() {
    with_each_kind!(|W, E| {
        let flash = || Flash::<W, E>::blank_with_sectors(2, 0);
        let room = {
            let (mut log, _) = Log::open(flash());
            (1..).take_while(|n| log.store(settings(*n)).is_ok()).count() as u16
        };
        for others in 0..(32 + 2 * W.max(4)) / W {
            let flash = flash();
            let (mut log, _) = Log::open(flash.clone());
            (1..room).for_each(|n| log.store(settings(n)).unwrap());
            flash.fail_once(Write, others);
            let left = room - u16::from(log.store(settings(room)).is_err());
            for seed in 0..16 {
                let next = open(&flash.duplicate(seed)).0;
                assert_eq!(next, Some(settings(left)), "unit of {W}, write {others}");
            }
        }
    });
}

#[test]
fn a_record_after_a_move_that_failed_says_that_the_other_bank_is_used() {
    let (mut log, flash) = with_content_1(0);
    (2..=15).for_each(|n| log.store(settings(n)).unwrap());
    // The record of the first store in the other bank.
    flash.fail_once(Write, 1);
    assert_eq!(log.store(settings(16)), Err(Error::Refused));
    let taken_back = &flash.content()[1024 + PLACE + 4..][..32];
    assert_eq!((taken_back[5], taken_back[22]), (15, 0));
}

#[test]
fn a_flash_of_any_unit_that_fails_is_reported_and_not_erased() {
    with_each_kind!(|W, E| {
        for operation in [Read, Write, Erase] {
            let flash = Flash::<W, E>::blank_with_sectors(2, 0);
            flash.fail(operation);
            let (mut log, found) = Log::open(flash.clone());
            assert!(matches!(found, Found::MediumFailed(_)), "unit of {W}, {operation:?}");
            assert_eq!(log.settings(), None);
            assert!(log.store(settings(1)).is_err());
        }
        let flash = with_places_taken::<W, E>(0);
        for others in 0..40 {
            let flash = flash.duplicate(0);
            flash.fail_after(Read, others);
            Log::open(flash.clone());
            assert_eq!(flash.erases(), 0, "unit of {W}, {others}");
            flash.repair();
            assert_eq!(found(&flash), content(1, 30), "unit of {W}, {others}");
        }
    });
}

#[test]
fn a_stuck_bit_costs_a_store_but_no_values() {
    // Those of the next store.
    for (len, places) in [(0, 3..4), (60, 6..10)] {
        let certain = places.end * PLACE - 4..places.end * PLACE;
        for at in places.start * PLACE..places.end * PLACE {
            for (bit, value) in (0..8).flat_map(|bit| [(bit, false), (bit, true)]) {
                let (mut log, flash) = with_content_1(len);
                flash.stick(at, 1 << bit, value);
                let outcome = store(&mut log, &content(2, len));
                let case = format!("byte {at}, bit {bit} is {value}: {outcome:?}");
                assert!(
                    outcome.is_ok() || value,
                    "{case}: a place that is not blank is passed over"
                );
                let is_certain = flash.content()[certain.clone()] != [0xFF; 4];
                assert!(outcome.is_ok() || !is_certain, "{case}: that comes after a read-back");
                let left = content(if outcome.is_ok() { 2 } else { 1 }, len);
                assert_eq!(held(&log), left, "{case}");
                assert_eq!(found(&flash.duplicate(0)), left, "{case}");
                assert_eq!(store(&mut log, &content(3, len)), Ok(()), "{case}");
                assert_eq!(found(&flash), content(3, len), "{case}");
            }
        }
    }
}

#[test]
fn a_stuck_bit_in_the_other_bank_loses_nothing() {
    for at in 1024..1024 + 2 * PLACE {
        for (bit, value) in (0..8).flat_map(|bit| [(bit, false), (bit, true)]) {
            let flash = Flash::<4, 1024>::blank(0);
            let (mut log, ..) = start(&flash);
            // Up to the last place that is not kept for starts.
            (2..16).for_each(|n| log.store(settings(n)).unwrap());
            flash.stick(at, 1 << bit, value);
            let (mut log, then, _) = start(&flash);
            let case = format!("byte {at}, bit {bit} is {value}");
            assert_eq!(then.0, Some(settings(15)), "{case}");
            let mut last: Settings = settings(15);
            for n in 16..22 {
                if log.store(settings(n)).is_ok() {
                    last = settings(n);
                }
                assert_eq!(found(&flash.duplicate(0)).0, Some(last), "{case}, {n}");
            }
            assert_eq!(last, settings(21), "{case}: it costs a store");
            assert_eq!(found(&flash).0, Some(last), "{case}");
        }
    }
}

#[test]
fn each_failure_says_what_the_flash_does_and_what_to_do() {
    for (error, what) in [
        (Error::Refused, "the flash reports an error"),
        (Error::NotBlank, "the flash is not blank where it was erased"),
        (Error::NotAsWritten, "the flash reads back otherwise than written"),
        (
            Error::Full,
            "the flash is full: reset the node (NMT command 81h) or switch it off and on",
        ),
        (
            Error::OtherLayout,
            "the flash holds settings of another version: load that version, or erase them",
        ),
    ] {
        assert_eq!(error.to_string(), what);
    }
}
