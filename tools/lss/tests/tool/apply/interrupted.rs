//! `lss apply` that is interrupted: the next run goes on.

use std::fs;

use canopen_node::BitRate;
use testkit::random::Random;

use super::{RATE, file, folder, node, node_of, short_sheet};
use crate::in_process::{At, Fault, Wire, address_text};

/// Three boards that exchange node-IDs and have values; the table asks for this bit rate.
pub fn exchange(test: &str, rate: u16) -> String {
    let sheet = short_sheet(test, &["1010", "1020", "1800", "1A00", "2100", "2101"]);
    let values = "\"2100\" = 4\n\"2101:3\" = \"Ada Lovelace\"\n\"1A00:0\" = 1\n\"1A00:1\" = 0x64010110\n\"1800:1\" = \"$NODEID+0x40000280\"\n";
    format!(
        "bit_rate = {rate}\n{}{}{}",
        node_of(&sheet, 6, 0, values),
        node(5, 1),
        node_of(&sheet, 7, 2, "\"2100\" = 5")
    )
}

pub fn assert_exchanged(wire: &Wire, what: &str) {
    assert_eq!(wire.ids(), [6, 5, 7].map(|id| (Some(id), Some(id))), "{what}");
    assert_eq!(wire.value(0, 0x2100, 0), [4], "{what}");
    assert_eq!(wire.value(0, 0x2101, 3), b"Ada Lovelace", "{what}");
    assert_eq!(wire.value(0, 0x1A00, 1), [0x10, 0x01, 0x01, 0x64], "{what}");
    assert_eq!(wire.value(0, 0x1800, 1), [0x86, 0x02, 0, 0x40], "{what}");
    assert_eq!(wire.value(2, 0x2100, 0), [5], "{what}");
}

/// Lets this go wrong at each write of a run in turn. The next run goes on, after a power failure of all boards or
/// without one, and the run after it writes nothing.
fn interrupt_at_each_write(name: &str, fault: Fault, power_fails: bool) {
    let file = file(name, &exchange(name, 125));
    for write in 0.. {
        let wire = Wire::new(RATE, &[5, 6, 0xFF]);
        wire.fail_at(At::Write(write), fault);
        let (outcome, _) = wire.apply(&file, "");
        let what = format!("{fault:?} at write {write}");
        if !wire.mend() {
            assert_eq!(outcome.code, 0, "{what}: {}", outcome.error);
            assert!(write > 30, "{write} writes");
            return;
        }
        let possible: &[u8] = match fault {
            // It comes too late at the last writes.
            Fault::CtrlC => &[130, 0],
            Fault::AdapterGone | Fault::AdapterGoneBehind => &[4],
            // The last ones need no answer of this board.
            Fault::BoardGone(_) | Fault::OtherMaster => &[1, 0],
        };
        assert!(possible.contains(&outcome.code), "{what}: {} {}", outcome.code, outcome.error);
        if fault == Fault::CtrlC {
            wire.assert_waiting();
            // A node-ID in use is stored, and no PDO is off.
            assert!(
                wire.ids().iter().all(|(active, stored)| active == stored),
                "{what}: {:?}",
                wire.ids()
            );
            let is_on = wire.ids()[0].0.is_none() || wire.value(0, 0x1800, 1)[3] & 0x80 == 0;
            assert!(is_on, "{what}");
        }
        if power_fails {
            wire.power_cycle();
        }
        let (outcome, _) = wire.apply(&file, "");
        assert_eq!(outcome.code, 0, "{what}: {}", outcome.error);
        wire.power_cycle();
        assert_exchanged(&wire, &what);
        let (outcome, writes) = wire.apply(&file, "");
        assert_eq!((outcome.code, writes), (0, 0), "{what}: {}", outcome.text);
    }
}

#[test]
fn a_run_after_ctrl_c_at_any_write_goes_on() {
    interrupt_at_each_write("ctrl-c", Fault::CtrlC, false);
}

#[test]
fn a_run_after_the_adapter_was_gone_at_any_write_goes_on() {
    interrupt_at_each_write("adapter", Fault::AdapterGone, false);
}

#[test]
fn a_run_after_the_adapter_was_gone_behind_any_write_goes_on() {
    interrupt_at_each_write("behind", Fault::AdapterGoneBehind, false);
}

#[test]
fn a_run_after_a_power_failure_of_all_goes_on() {
    interrupt_at_each_write("power", Fault::AdapterGone, true);
}

#[test]
fn a_run_after_a_board_was_gone_at_any_write_goes_on() {
    interrupt_at_each_write("board", Fault::BoardGone(0), false);
}

#[test]
fn a_run_after_an_interruption_at_any_frame_goes_on() {
    let sheet = short_sheet("frame", &["1010", "1020", "2100"]);
    let text = node_of(&sheet, 6, 0, "\"2100\" = 4") + &node(5, 1);
    for fault in [Fault::CtrlC, Fault::AdapterGone] {
        for frame in 0.. {
            let file = file("frame", &text);
            let wire = Wire::new(RATE, &[5, 6]);
            wire.fail_at(At::Frame(frame), fault);
            let (outcome, _) = wire.apply(&file, "");
            let what = format!("{fault:?} at frame {frame}");
            if !wire.mend() {
                assert_eq!(outcome.code, 0, "{what}: {}", outcome.error);
                assert!(frame > 40, "{frame} frames");
                break;
            }
            if fault == Fault::CtrlC {
                wire.assert_waiting();
            }
            assert_eq!(wire.apply(&file, "").0.code, 0, "{what}");
            wire.power_cycle();
            assert_eq!(wire.ids(), [6, 5].map(|id| (Some(id), Some(id))), "{what}");
            assert_eq!(wire.value(0, 0x2100, 0), [4], "{what}");
            let (outcome, writes) = wire.apply(&file, "");
            assert_eq!((outcome.code, writes), (0, 0), "{what}: {}", outcome.text);
        }
    }
}

#[test]
fn random_networks_come_to_their_tables_through_random_faults() {
    let mut random = Random::from_environment();
    let sheet = short_sheet("random", &["1010", "1020", "2100"]);
    let path = folder("random").join("network.toml");
    for _ in 0..20 {
        let count = random.within(2..6) as usize;
        // Node-IDs out of a few, so that boards are in each other's way.
        let mut ids = || {
            let mut free: Vec<u8> = (1..=6).collect();
            let mut take = || free.remove(random.within(0..free.len() as u64) as usize);
            (0..count).map(|_| take()).collect::<Vec<u8>>()
        };
        let (found, wanted) = (ids(), ids());
        let found: Vec<u8> =
            found.iter().map(|id| if random.one_in(4) { 0xFF } else { *id }).collect();
        let filter: Vec<u8> = (0..count).map(|_| random.within(0..9) as u8).collect();
        let node = |board: usize| {
            node_of(&sheet, wanted[board], board, &format!("\"2100\" = {}", filter[board]))
        };
        fs::write(&path, (0..count).map(node).collect::<String>()).expect("it can be written");
        let wire = Wire::new(RATE, &found);
        for _ in 0..random.within(0..5) {
            let board = random.within(0..count as u64) as usize;
            let faults = [
                Fault::CtrlC,
                Fault::AdapterGone,
                Fault::AdapterGoneBehind,
                Fault::BoardGone(board),
            ];
            let fault = faults[random.within(0..4) as usize];
            wire.fail_at(At::Frame(random.within(0..150) as usize), fault);
            let _ = wire.apply(&path, "");
            wire.mend();
            if random.one_in(3) {
                wire.power_cycle();
            }
        }
        let what = format!("from {found:?} to {wanted:?}");
        let (outcome, _) = wire.apply(&path, "");
        assert_eq!(outcome.code, 0, "{what}: {}", outcome.error);
        wire.power_cycle();
        let ids: Vec<_> = wanted.iter().map(|id| (Some(*id), Some(*id))).collect();
        assert_eq!(wire.ids(), ids, "{what}");
        for (board, filter) in filter.iter().enumerate() {
            assert_eq!(wire.value(board, 0x2100, 0), [*filter], "{what}");
        }
        let (outcome, writes) = wire.apply(&path, "");
        assert_eq!((outcome.code, writes), (0, 0), "{what}: {}", outcome.text);
    }
}

#[test]
fn a_run_after_the_adapter_was_gone_at_any_write_of_a_switch_goes_on() {
    let file = file("switch", &format!("bit_rate = 500\n{}{}", node(5, 0), node(7, 1)));
    for write in 0.. {
        let wire = Wire::with_heartbeat(RATE, &[5, 6], 1000);
        wire.fail_at(At::Write(write), Fault::AdapterGone);
        let (outcome, _) = wire.apply(&file, "--bit-rate 125");
        if !wire.mend() {
            assert_eq!(outcome.code, 0, "{}", outcome.error);
            assert!(write > 8, "{write} writes");
            return;
        }
        // The switch delays of a switch that has begun.
        wire.bus().pass_us(1_100_000);
        let (outcome, _) = wire.apply(&file, "--bit-rate 125");
        assert_eq!(outcome.code, 0, "write {write}: {}", outcome.error);
        wire.power_cycle();
        assert_eq!(wire.ids(), [5, 7].map(|id| (Some(id), Some(id))), "write {write}");
        let rates: Vec<BitRate> = wire.bit_rates();
        assert_eq!(rates, [BitRate::Kbit500; 2], "write {write}");
        let (outcome, writes) = wire.apply(&file, "");
        assert_eq!((outcome.code, writes), (0, 0), "write {write}");
    }
}

#[test]
fn boards_with_values_store_again_after_a_run_that_did_not_finish_and_no_others_do() {
    let sheet = short_sheet("again", &["1010", "1020", "2100"]);
    let text = node_of(&sheet, 5, 0, "\"2100\" = 4")
        + &node_of(&sheet, 6, 1, "")
        + &node_of(&sheet, 7, 2, "\"2100\" = 4");
    let file = file("again", &text);
    let wire = Wire::new(RATE, &[5, 6, 7]);
    assert_eq!(wire.apply(&file, "").0.code, 0);
    let stores = |stored: usize, written: usize| {
        let (outcome, _) = wire.apply(&file, "--full");
        assert_eq!(outcome.code, 0, "{}", outcome.error);
        let counts = ["values stored\n", "1 value written and stored"];
        let counts = counts.map(|words| outcome.text.matches(words).count());
        assert_eq!(counts, [stored, written], "{}", outcome.text);
    };
    fs::write(file.with_file_name("network.toml.unfinished"), "").expect("it can be written");
    stores(2, 0);
    wire.set(2, 0x2100, 0, &[3]);
    stores(0, 1);
}

#[test]
fn a_board_that_vanishes_is_told_and_the_others_are_done() {
    let wire = Wire::new(RATE, &[0xFF, 0xFF]);
    let file = file("vanishes", &(node(5, 0) + &node(6, 1)));
    wire.fail_at(At::Write(0), Fault::BoardGone(0));
    let (outcome, _) = wire.apply(&file, "");
    assert_eq!(outcome.code, 1);
    let why = format!(
        "node 5: no answer to configure node-ID: 5. Board {}: is it still there, and ",
        address_text(0)
    );
    assert!(outcome.error.starts_with(&why), "{}", outcome.error);
    assert_eq!(wire.ids()[1], (Some(6), Some(6)));
}
