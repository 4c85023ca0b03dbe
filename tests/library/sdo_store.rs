//! Store parameters 1010h and restore default parameters 1011h (CiA 301), which share the settings log with LSS store.

use testkit::{
    frames::SILENCE,
    node_rig::{NodeRig, defaults},
    sdo::Client,
};

use crate::sdo_machine;

const SAVE: &str = "23 10 10 01 73 61 76 65";
const SAVED: &str = "5C0: 60 10 10 01 00 00 00 00";
const LOAD: &str = "23 11 10 01 6C 6F 61 64";
const LOADED: &str = "5C0: 60 11 10 01 00 00 00 00";
const HEARTBEAT_1000: &str = "2B 17 10 00 E8 03";

#[test]
fn save_is_confirmed_only_when_done_and_others_are_served_meanwhile() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    board.let_stores_take_time();
    assert_eq!(board.sdo(SAVE), SILENCE);
    assert_eq!(board.pass_ms(100), ["740: 7F"]);
    assert_eq!(board.lss("04 01"), SILENCE);
    assert_eq!(board.lss("5E"), ["5E 40"]);
    assert_eq!(board.number(0x1018, 4), 0xDEAD_BEEF);
    assert_eq!(board.finish_store(), [SAVED]);
    assert_eq!(board.pass_ms(100), ["740: 7F"], "and only once");
}

#[test]
fn lss_store_and_save_at_the_same_time_are_both_done_and_both_answered() {
    let expected = defaults(0x04);
    for lss_is_first in [true, false] {
        let mut board = NodeRig::with_slow_stores();
        board.sdo(HEARTBEAT_1000);
        board.configure("11 04");
        let answers = if lss_is_first {
            board.lss("17");
            board.sdo(SAVE);
            ["17 00", SAVED]
        } else {
            board.sdo(SAVE);
            board.lss("17");
            [SAVED, "17 00"]
        };
        assert_eq!(board.finish_store(), [answers[0]]);
        assert_eq!(board.finish_store(), [answers[1]]);
        assert_eq!((board.stored(), board.stored_heartbeat_ms()), (Some(expected), Some(1000)));
    }
}

#[test]
fn a_store_that_is_asked_for_while_one_waits_is_0800_0021() {
    let mut board = NodeRig::with_slow_stores();
    board.configure("17");
    assert_eq!(board.sdo(SAVE), SILENCE);
    assert_eq!(board.sdo(SAVE), ["5C0: 80 10 10 01 21 00 00 08"]);
    assert_eq!(board.sdo(LOAD), ["5C0: 80 11 10 01 21 00 00 08"]);
    assert_eq!(board.finish_store(), ["17 00"]);
    assert_eq!(board.finish_store(), [SAVED]);
}

#[test]
fn after_an_abort_of_the_client_or_reset_communication_a_store_ends_without_an_answer() {
    for (request, answer, is_reset) in
        [(SAVE, SAVED, false), (LOAD, LOADED, false), (SAVE, SAVED, true), (LOAD, LOADED, true)]
    {
        let mut board = NodeRig::with_slow_stores();
        board.sdo(HEARTBEAT_1000);
        board.sdo(request);
        if is_reset {
            assert_eq!(board.nmt("82 00"), ["740: 00"]);
        } else {
            assert_eq!(board.sdo("80 10 10 01 00 00 04 05"), SILENCE);
        }
        assert_eq!(board.finish_store(), SILENCE);
        let stored = if request == SAVE { Some(1000) } else { None };
        assert_eq!(board.stored_heartbeat_ms(), stored);
        assert_eq!(board.sdo(request), SILENCE);
        assert_eq!(board.finish_store(), [answer], "and the next one is answered");
    }
}

#[test]
fn stores_one_behind_the_other_are_each_confirmed_in_their_way() {
    for (messages, confirmation) in [
        (&["20 10 10 01", "07 73 61 76 65"][..], "5C0: 20 00 00 00 00 00 00 00"),
        (&["C0 10 10 01", "81 73 61 76 65", "CD"], "5C0: A1 00 00 00 00 00 00 00"),
    ] {
        // One with block transfer.
        let mut board = sdo_machine::board();
        board.let_stores_take_time();
        let answers: Vec<_> = messages.iter().map(|message| board.sdo(message)).collect();
        assert_eq!(answers[messages.len() - 1], SILENCE, "it is not stored yet");
        assert_eq!(board.sdo(LOAD), SILENCE);
        assert_eq!(board.number(0x1018, 4), 0xDEAD_BEEF);
        assert_eq!(board.finish_store(), [confirmation]);
        assert_eq!(board.finish_store(), [LOADED]);
    }
}

#[test]
fn a_save_that_still_waits_is_forgotten_by_reset_communication() {
    let mut board = NodeRig::with_slow_stores();
    board.configure("17");
    board.sdo(HEARTBEAT_1000);
    board.sdo(SAVE);
    assert_eq!(board.nmt("82 00"), ["740: 00"]);
    assert_eq!(board.finish_store(), ["17 00"], "LSS continues");
    assert_eq!(board.stored(), Some(defaults(0x40)));
    let stores = board.timeline().into_iter().filter(|line| line.ends_with("store"));
    assert_eq!(stores.count(), 1, "no other one has begun");
}

#[test]
fn an_outcome_without_a_store_is_ignored() {
    let mut board = NodeRig::with_node_id(0x40);
    board.node.handle_stored(Ok(&[]));
    assert_eq!(board.pass_ms(1), SILENCE);
    board.lss("04 01");
    assert_eq!(board.lss("17"), ["17 00"], "the next store is answered once");
}
