//! The settings log in a failing flash: reads, writes and erases with errors, stuck bits.

use canopen_node::{
    NodeId, Settings,
    settings::{Error, Found, Log},
};
use testkit::{
    flash::{BoardFlash, Flash, Operation},
    settings::{flash_with, open, record, settings},
};

/// A log of eight records a bank that holds `settings(1)`.
fn with_settings_1() -> (Log<Flash<4, 256>>, Flash<4, 256>) {
    let flash = Flash::blank(7);
    let (mut log, _) = Log::open(flash.clone());
    log.store(settings(1)).unwrap();
    (log, flash)
}

#[test]
fn a_flash_that_fails_refuses_stores_and_the_old_settings_stay() {
    for operation in [Operation::Write, Operation::Read] {
        let (mut log, flash) = with_settings_1();
        flash.fail(operation);
        for n in 2..5 {
            assert_eq!(log.store(settings(n)), Err(Error::Refused), "{operation:?}");
            assert_eq!(log.settings(), Some(settings(1)));
        }
        flash.repair();
        assert_eq!(open(&flash.duplicate(0)).0, Some(settings(1)), "{operation:?}");
        assert_eq!(log.store(settings(5)), Ok(()), "the flash works again");
        assert_eq!(open(&flash).0, Some(settings(5)));
    }
}

#[test]
fn after_a_failed_operation_old_settings_stay_and_the_next_store_works() {
    for operation in [Operation::Write, Operation::Read] {
        for others in 0.. {
            let (mut log, flash) = with_settings_1();
            flash.fail_once(operation, others);
            let outcome = log.store(settings(2));
            if flash.is_faulty() {
                break;
            }
            let left = if outcome.is_ok() { settings(2) } else { settings(1) };
            assert_eq!(log.settings(), Some(left));
            let found = open(&flash.duplicate(0)).0;
            assert_eq!(found, Some(left), "{operation:?} {others}: {outcome:?}");
            assert_eq!(log.store(settings(3)), Ok(()));
            assert_eq!(open(&flash).0, Some(settings(3)), "{operation:?} {others}");
        }
    }
}

#[test]
fn settings_that_are_stored_again_after_a_store_that_failed_are_found() {
    for operation in [Operation::Write, Operation::Read] {
        for others in 0.. {
            let (mut log, flash) = with_settings_1();
            flash.fail_once(operation, others);
            let _ = log.store(settings(2));
            if flash.is_faulty() {
                break;
            }
            assert_eq!(log.store(settings(1)), Ok(()));
            assert_eq!(open(&flash).0, Some(settings(1)), "{operation:?} {others}");
        }
    }
}

#[test]
fn settings_stored_again_after_a_temporary_flash_failure_are_found() {
    for operation in [Operation::Write, Operation::Read] {
        for others in 0..10 {
            let (mut log, flash) = with_settings_1();
            flash.fail_after(operation, others);
            let left = if log.store(settings(2)).is_ok() { settings(2) } else { settings(1) };
            flash.repair();
            assert_eq!(log.store(left), Ok(()));
            assert_eq!(open(&flash).0, Some(left), "{operation:?} {others}");
        }
    }
}

#[test]
fn a_blank_flash_that_fails_is_reported_and_refuses() {
    for operation in [Operation::Read, Operation::Write, Operation::Erase] {
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
    let why = |fault: fn(&Flash<4, 256>)| {
        let (mut log, flash) = with_settings_1();
        fault(&flash);
        let outcome = (2..20).map(|n| log.store(settings(n))).find(Result::is_err);
        flash.repair();
        let (mut log, _) = Log::open(flash);
        assert_eq!(log.store(settings(30)), Ok(()));
        outcome.expect("a failure").unwrap_err()
    };
    assert_eq!(why(|flash| flash.fail(Operation::Write)), Error::Refused);
    assert_eq!(why(|flash| flash.stick(96, 1, false)), Error::NotBlank);
    assert_eq!(why(|flash| flash.stick(100, 1, false)), Error::NotBlank);
    assert_eq!(why(|flash| flash.stick(100, 4, true)), Error::NotAsWritten);
    assert_eq!(why(|_| ()), Error::Full);
}

/// A flash whose bank `bank` has room for `room` of eight records, after those of an earlier version; the other is not
/// known to be erased. It holds `settings(8 - room)`.
fn nearly_full(bank: usize, room: u16) -> Flash<4, 256> {
    let records: Vec<_> = (1..=8 - room)
        .map(|n| {
            let Settings { node_id, bit_rate, heartbeat_ms, .. } = settings(n);
            let node_id = NodeId::to_lss(node_id);
            let sequence = u32::from(n);
            let at = usize::from(n) - 1;
            (bank, at, record(sequence, 1, node_id, bit_rate.index(), heartbeat_ms))
        })
        .collect();
    flash_with(&records)
}

#[test]
fn an_open_that_fails_at_any_operation_loses_nothing() {
    for bank in [0, 1] {
        'next: for operation in [Operation::Read, Operation::Write, Operation::Erase] {
            for others in 0.. {
                for room in 0..3 {
                    let flash = nearly_full(bank, room);
                    flash.fail_once(operation, others);
                    let (mut log, found) = Log::open(flash.clone());
                    if flash.is_faulty() {
                        assert_ne!(flash.erases(), 0, "it has erased the other bank");
                        continue 'next;
                    }
                    let case =
                        format!("bank {bank}, room {room}, {operation:?} {others}: {found:?}");
                    let stored = log.store(settings(8)).is_ok();
                    let last = settings(if stored { 8 } else { 8 - room });
                    let (mut log, _) = Log::open(flash.clone());
                    assert_eq!(log.settings(), Some(last), "{case}");
                    assert_eq!(log.store(settings(9)), Ok(()), "{case}");
                    assert_eq!(open(&flash).0, Some(settings(9)), "{case}");
                }
            }
        }
    }
}

#[test]
fn a_store_in_the_other_bank_that_fails_at_any_operation_loses_nothing() {
    for operation in [Operation::Write, Operation::Read] {
        for others in 0.. {
            let flash = nearly_full(0, 1);
            let (mut log, _) = Log::open(flash.clone());
            flash.fail_once(operation, others);
            let outcome = log.store(settings(8));
            if flash.is_faulty() {
                assert!(others > 2, "it reads and writes");
                break;
            }
            let case = format!("{operation:?} {others}: {outcome:?}");
            let last = settings(if outcome.is_ok() { 8 } else { 7 });
            assert_eq!(log.settings(), Some(last), "{case}");
            assert_eq!(open(&flash.duplicate(0)).0, Some(last), "{case}");
            assert_eq!(log.store(settings(9)), Ok(()), "{case}");
            assert_eq!(open(&flash).0, Some(settings(9)), "{case}");
        }
    }
}

#[test]
fn a_stuck_bit_costs_a_record_but_no_settings() {
    for at in 96..128 {
        for bit in 0..8 {
            for value in [false, true] {
                let (mut log, flash) = with_settings_1();
                flash.stick(at, 1 << bit, value);
                let outcome = log.store(settings(2));
                let left = if outcome.is_ok() { settings(2) } else { settings(1) };
                let has_commit_word = flash.content()[124..128] != [0xFF; 4];
                assert!(
                    outcome.is_ok() || at >= 124 || !has_commit_word,
                    "byte {at}, bit {bit} is {value}: the commit word comes after a read-back"
                );
                assert_eq!(log.settings(), Some(left), "byte {at}, bit {bit} is {value}");
                let found = open(&flash.duplicate(0)).0;
                assert_eq!(found, Some(left), "byte {at}, bit {bit} is {value}");
                assert_eq!(log.store(settings(3)), Ok(()));
                assert_eq!(open(&flash).0, Some(settings(3)));
            }
        }
    }
}

#[test]
fn a_stuck_bit_in_the_other_bank_loses_nothing() {
    for at in 256..320 {
        for bit in 0..8 {
            for value in [false, true] {
                let flash = nearly_full(0, 2);
                flash.stick(at, 1 << bit, value);
                let case = format!("byte {at}, bit {bit} is {value}");
                let (mut log, found) = Log::open(flash.clone());
                assert_eq!(log.settings(), Some(settings(6)), "{case}");
                assert_eq!(log.store(settings(7)), Ok(()), "{case}: there was still room");
                let outcome = log.store(settings(8));
                let last = settings(if outcome.is_ok() { 8 } else { 7 });
                assert_eq!(open(&flash.duplicate(0)).0, Some(last), "{case}: {outcome:?}");
                let is_marked = !matches!(found, Found::MediumFailed(_));
                let second = log.store(settings(9));
                assert_eq!(second.is_ok(), is_marked, "{case}: it costs one store");
                assert_eq!(open(&flash).0, Some(if is_marked { settings(9) } else { last }));
            }
        }
    }
}
