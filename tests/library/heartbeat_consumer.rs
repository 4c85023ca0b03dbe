//! The heartbeat consumer 1016h (CiA 301, 7.2.8.3.2): when a producer is lost, and what follows.

use canopen_node::{Frame, NodeId, application::Event};
use testkit::{frames::SILENCE, node_rig::NodeRig, sdo::Client};

use crate::process_data::{
    Board, INCOMPATIBLE, INVALID_VALUE, With, board, operational, receive, set, take_events, write,
};

const NO_ERROR: &str = "0C0: 00 00 00 00 00 00 00 00";
const NODE_5_LOST: &str = "0C0: 30 81 11 05 00 00 00 00";

fn node_5() -> NodeId {
    NodeId::new(5).expect("a node-ID")
}

/// A board in NMT operational that expects the heartbeat of node 5 each 100 ms.
fn watching() -> Board {
    let mut board = operational();
    set(&mut board, 0x1016, 1, 0x0005_0064, 4);
    board
}

#[test]
fn messages_and_history_agree_on_the_producers_that_were_lost() {
    let mut board = NodeRig::running(With::<3, 2, 3>::new());
    set(&mut board, 0x1015, 0, 1000, 2);
    for (node, time_ms) in [(1, 100), (2, 110), (3, 120)] {
        set(&mut board, 0x1016, node, u32::from(node) << 16 | time_ms, 4);
        board.receive(&Frame::new(0x700 + u16::from(node), &[5]).expect("a frame"));
    }
    let messages = ["0C0: 30 81 11 01 00 00 00 00", "0C0: 30 81 11 03 00 00 00 00"];
    assert_eq!(board.pass_ms(1_000), messages);
    let history = [0, 1, 2].map(|sub_index| board.number(0x1003, sub_index));
    assert_eq!(history, [2, 0x0003_8130, 0x0001_8130]);
}

#[test]
fn the_boot_up_of_a_producer_is_an_event_and_its_first_heartbeat() {
    let mut board = watching();
    receive(&mut board, "705: 00");
    assert_eq!(take_events(), [Event::BootUp(node_5())]);
    assert_eq!(board.pass_ms(100), [NODE_5_LOST]);
    receive(&mut board, "705: 05");
    assert_eq!(receive(&mut board, "706: 00"), SILENCE, "nobody watches node 6");
}

#[test]
fn a_node_is_watched_by_one_entry() {
    let mut board = watching();
    assert_eq!(write(&mut board, 0x1016, 2, 0x0005_00C8, 4), Err(INCOMPATIBLE));
    assert_eq!(board.number(0x1016, 2), 0, "the old value stays");
    set(&mut board, 0x1016, 1, 0x0005_00C8, 4);
    set(&mut board, 0x1016, 2, 0x0005_0000, 4);
    set(&mut board, 0x1016, 1, 0, 4);
    set(&mut board, 0x1016, 2, 0x0005_00C8, 4);
    assert_eq!(write(&mut board, 0x1016, 1, 0x0105_00C8, 4), Err(INVALID_VALUE));
    assert_eq!((board.number(0x1016, 0), board.upload(0x1016, 3)), (2, Err(0x0609_0011)));
}

#[test]
fn an_entry_that_is_not_used_watches_nobody() {
    let mut board = board();
    for entry in [0x0005_0000, 0x0000_0064, 0x0080_0064, 0x00FF_FFFF] {
        set(&mut board, 0x1016, 1, entry, 4);
        assert_eq!(board.number(0x1016, 1), entry);
        receive(&mut board, "705: 05");
        assert_eq!(board.pass_ms(100), SILENCE, "{entry:X}");
        assert_eq!(board.node.receives().heartbeats, [0x7E5; 2]);
    }
}

#[test]
fn a_lost_producer_that_is_no_longer_watched_is_no_error() {
    let mut board = watching();
    receive(&mut board, "705: 05");
    board.pass_ms(100);
    assert_eq!(board.sdo("23 16 10 01 00 00 00 00"), ["5C0: 60 16 10 01 00 00 00 00", NO_ERROR]);
}

#[test]
fn the_silence_of_a_switch_loses_no_producer() {
    let mut board = watching();
    receive(&mut board, "705: 05");
    board.configure("13 00 02, 15 E8 03");
    assert_eq!(board.pass_ms(2_000), ["1C0: 00 00 00"]);
    assert_eq!(board.pass_ms(99), SILENCE);
    assert_eq!(board.pass_ms(1), [NODE_5_LOST], "a period after it");
}
