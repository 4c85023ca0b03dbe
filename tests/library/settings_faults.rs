//! The settings log in a failing flash, with and without parameters: reads, writes and erases with errors, stuck bits.

use canopen_node::{
    NodeId, Settings,
    settings::{Error, Found, Log},
};
use testkit::{
    flash::{
        BoardFlash, Flash,
        Operation::{Erase, Read, Write},
    },
    settings::{Content, flash_with, open_with_parameters, parameters, record, settings},
};

/// The longest parameters, which take three places of 32 bytes.
const LEN: usize = 66;
/// A flash with room for 16 places a bank.
type Chip = Flash<4, 512>;
type ChipLog = Log<Chip, LEN>;

/// The lengths of the parameter that is stored with the settings; 0: none.
const LENS: [usize; 2] = [0, 60];

fn start(flash: &Chip) -> (ChipLog, Content, Found) {
    open_with_parameters(flash)
}

fn found(flash: &Chip) -> Content {
    start(flash).1
}

fn content(n: u16, len: usize) -> Content {
    (Some(settings(n)), parameters(n, len))
}

fn held(log: &ChipLog) -> Content {
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

/// A log in whose bank `bank` there is room for `room` of 16 records, after those of an earlier version; the other bank
/// is not known to be erased.
fn nearly_full(bank: usize, room: u16) -> Chip {
    let records: Vec<_> = (1..=16 - room)
        .map(|n| {
            let Settings { node_id, bit_rate, heartbeat_ms, .. } = settings(n);
            let node_id = NodeId::to_lss(node_id);
            let record = record(n.into(), 1, node_id, bit_rate.index(), heartbeat_ms);
            (bank, usize::from(n) - 1, record)
        })
        .collect();
    flash_with(&records)
}

/// A log with parameters that moves to its other bank at the next start, or has just moved there.
fn about_to_move(has_moved: bool) -> Chip {
    let (mut log, flash) = with_content_1(60);
    store(&mut log, &content(2, 60)).unwrap();
    // 10 of 16 places are in use.
    for n in 0..6 + u16::from(has_moved) {
        log.store(settings(100 + n)).unwrap();
    }
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
fn after_any_failed_operation_old_values_stay_and_the_next_store_works() {
    let beginnings = [
        (0, with_content_1(0).1, content(1, 0)),
        (60, with_content_1(60).1, content(1, 60)),
        // The store goes to the other bank.
        (0, nearly_full(0, 0), content(16, 0)),
    ];
    for (len, beginning, old) in beginnings {
        for operation in [Write, Read] {
            for others in 0.. {
                let flash = beginning.duplicate(0);
                let (mut log, ..) = start(&flash);
                flash.fail_once(operation, others);
                let outcome = store(&mut log, &content(20, len));
                if flash.is_faulty() {
                    assert!(others > 2, "it reads and writes");
                    break;
                }
                let case = format!("{operation:?} {others}: {outcome:?}");
                let left = if outcome.is_ok() { &content(20, len) } else { &old };
                assert_eq!(held(&log), *left, "{case}");
                assert_eq!(found(&flash.duplicate(0)), *left, "{case}");
                assert_eq!(store(&mut log, &content(21, len)), Ok(()), "{case}");
                assert_eq!(found(&flash), content(21, len), "{case}");
            }
        }
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
        let outcome = (2..40).map(|n| log.store(settings(n))).find(Result::is_err);
        flash.repair();
        let (mut log, ..) = start(&flash);
        assert_eq!(log.store(settings(50)), Ok(()));
        outcome.expect("a failure").unwrap_err()
    };
    assert_eq!(why(|flash| flash.fail(Write)), Error::Refused);
    assert_eq!(why(|flash| flash.stick(96, 1, false)), Error::NotBlank);
    assert_eq!(why(|flash| flash.stick(100, 1, false)), Error::NotBlank);
    assert_eq!(why(|flash| flash.stick(100, 4, true)), Error::NotAsWritten);
    assert_eq!(why(|_| ()), Error::Full);
}

#[test]
fn a_start_that_fails_at_any_operation_loses_nothing() {
    let mut beginnings = vec![about_to_move(false), about_to_move(true)];
    for bank in [0, 1] {
        beginnings.extend([0, 1, 2].map(|room| nearly_full(bank, room)));
    }
    for (number, beginning) in beginnings.iter().enumerate() {
        let old = found(&beginning.duplicate(0));
        for operation in [Read, Write, Erase] {
            for others in 0.. {
                let flash = beginning.duplicate(0);
                flash.fail_once(operation, others);
                let (mut log, _, result) = start(&flash);
                if flash.is_faulty() {
                    break;
                }
                let case = format!("{number}, {operation:?} {others}: {result:?}");
                // A store by LSS keeps the parameters in flash, even if they could not be read.
                let is_stored = log.store(settings(8)).is_ok();
                let left = if is_stored { Some(settings(8)) } else { old.0 };
                let (mut log, then, _) = start(&flash);
                assert_eq!(then, (left, old.1.clone()), "{case}");
                assert_eq!(store(&mut log, &content(9, 60)), Ok(()), "{case}");
                assert_eq!(found(&flash), content(9, 60), "{case}");
            }
        }
    }
}

#[test]
fn a_stuck_bit_costs_a_store_but_no_values() {
    // Those of the next store, and the record before it.
    for (len, places) in [(0, 2..4), (60, 5..10)] {
        let commit_word = places.end * 32 - 4..places.end * 32;
        for at in places.start * 32..places.end * 32 {
            for (bit, value) in (0..8).flat_map(|bit| [(bit, false), (bit, true)]) {
                let (mut log, flash) = with_content_1(len);
                flash.stick(at, 1 << bit, value);
                let outcome = store(&mut log, &content(2, len));
                let case = format!("byte {at}, bit {bit} is {value}: {outcome:?}");
                let has_commit_word = flash.content()[commit_word.clone()] != [0xFF; 4];
                assert!(
                    outcome.is_ok() || commit_word.contains(&at) || !has_commit_word,
                    "{case}: the commit word comes after a read-back"
                );
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
    for at in 512..576 {
        for (bit, value) in (0..8).flat_map(|bit| [(bit, false), (bit, true)]) {
            let flash = nearly_full(0, 1);
            flash.stick(at, 1 << bit, value);
            let case = format!("byte {at}, bit {bit} is {value}");
            let (mut log, then, result) = start(&flash);
            assert_eq!(then, content(15, 0), "{case}");
            assert_eq!(log.store(settings(16)), Ok(()), "{case}: there was still room");
            let outcome = log.store(settings(17));
            let last = content(if outcome.is_ok() { 17 } else { 16 }, 0);
            assert_eq!(found(&flash.duplicate(0)), last, "{case}: {outcome:?}");
            let is_marked = !matches!(result, Found::MediumFailed(_));
            let second = log.store(settings(18));
            assert_eq!(second.is_ok(), is_marked, "{case}: it costs one store");
            assert_eq!(found(&flash), if is_marked { content(18, 0) } else { last });
        }
    }
}
