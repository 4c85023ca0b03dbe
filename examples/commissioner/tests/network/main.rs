//! Networks with the release image of the commissioner, in virtual time. None of them has a node-ID twice, at any time:
//! the rig checks that.

mod power_cuts;
mod rig;
mod switches;

use canopen_node::{BitRate, NodeId, Settings};
use emulator::{Time, can::Adapter};
use example_commissioner::application::State;
use rig::{Rig, address, blank, commissioner, new_board, silent};
use testkit::{
    image::Firmware,
    image_rig::{BOOT, blank_board},
    sdo::Client,
    slave_bus::{Habits, Happening},
};

const RATE: BitRate = BitRate::Kbit125;

/// Three boards of product 1 in the table, with the node-IDs 1 to 3.
fn three() -> Rig {
    with_others([])
}

/// The same, with other boards that have no power yet.
fn with_others<const N: usize>(others: [testkit::node_rig::NodeRig; N]) -> Rig {
    let mut rig = Rig::new(blank(1..=3).into_iter().chain(others));
    (3..3 + N).for_each(|slave| rig.slaves.happen(slave, Happening::PowerOff));
    rig.settle();
    rig.set_table(&[1, 2, 3].map(|number| Some(address(1, number))));
    assert_eq!(rig.restart(), State::Complete);
    rig
}

#[test]
fn twenty_blank_boards_get_a_node_id_each_while_the_button_is_held() {
    let mut rig = Rig::new(blank(1..=20));
    assert_eq!(rig.settle(), State::New);
    rig.push(true);
    while rig.node_ids().contains(&None) {
        rig.run_for(Time::from_ms(100));
    }
    rig.push(false);
    assert_eq!(rig.settle(), State::Complete);
    let nodes = rig.node_ids();
    let mut sorted = nodes.clone();
    sorted.sort_unstable();
    assert_eq!(sorted, (1..=20).map(Some).collect::<Vec<_>>());
    assert!(rig.nothing_is_stored(), "the table has the node-IDs");

    assert_eq!(rig.restart_all(), State::Complete);
    assert_eq!(rig.node_ids(), nodes);
    let table = rig.table();
    for (number, node) in (1..).zip(nodes) {
        assert_eq!(table[usize::from(node.expect("a node-ID")) - 1], Some(address(1, number)));
    }
    assert_eq!(rig.number(0x2100, 2), (1 << 20) - 1);
}

/// Three boards with the release image, just commissioned.
fn three_real() -> Rig {
    let mut rig = Rig::new([]);
    for number in 1..=3 {
        rig.network.add_board(blank_board(Firmware::Default, number));
    }
    // They format their flash.
    rig.run_for(BOOT);
    assert_eq!(rig.restart(), State::New);
    assert_eq!([(); 3].map(|()| rig.press()), [State::New, State::New, State::Complete]);
    rig
}

#[test]
fn boards_with_the_release_image_are_commissioned_and_switched() {
    let mut rig = three_real();
    assert_eq!(rig.switch(500), State::Complete);
    for board in 0..4 {
        rig.network.power_off(board);
    }
    rig.run_for(Time::from_ms(10));
    // Each has stored the rate, and finds nobody.
    for board in 1..4 {
        rig.network.power_on(board);
        rig.run_for(Time::from_ms(50));
        assert_eq!(rig.network.board(board).chip().can(1).bit_rate(), 500_000);
    }
    rig.network.power_on(0);
    rig.run_for(Time::from_ms(50));
    assert_eq!((rig.settle(), rig.slaves.rate), (State::Complete, BitRate::Kbit500));
    assert_eq!(rig.number(0x2100, 2), 0b111);
}

#[test]
fn boards_of_the_table_are_asked_before_it_scans() {
    let mut rig = three();
    rig.take_requests();
    rig.restart_all();
    let requests = rig.take_requests();
    let scan = requests.iter().position(|request| *request == 0x51);
    assert!(requests.iter().rposition(|request| *request == 0x43) < scan, "{requests:02X?}");
    assert_eq!(requests.iter().filter(|request| **request == 0x51).count(), 3, "nobody answers");
}

#[test]
fn nothing_is_given_and_nothing_stored_without_the_button() {
    let mut rig = Rig::new(blank(1..=2));
    assert_eq!(rig.settle(), State::New);
    let flash = rig.network.board(0).flash();
    for _ in 0..2 {
        assert_eq!(rig.restart(), State::New);
        rig.run_for(Time::from_s(20));
    }
    assert_eq!(rig.node_ids(), [None; 2]);
    assert_eq!(rig.network.board(0).flash(), flash);
    assert!(rig.nothing_is_stored());
}

#[test]
fn the_button_takes_one_board_while_it_is_pressed_for_a_moment() {
    let mut rig = Rig::new(blank(1..=2));
    rig.settle();
    assert_eq!(rig.press(), State::New);
    assert_eq!(rig.node_ids().iter().flatten().collect::<Vec<_>>(), [&1]);
    assert_eq!(rig.press(), State::Complete);
    assert_eq!(rig.node_ids().iter().flatten().count(), 2);
}

#[test]
fn a_lost_board_is_replaced_by_one_of_its_product_and_no_other() {
    let mut rig = with_others([new_board(address(2, 4), RATE), new_board(address(1, 5), RATE)]);
    rig.slaves.happen(1, Happening::PowerOff);
    rig.slaves.happen(3, Happening::PowerOn);
    assert_eq!(rig.press(), State::Missing);
    assert_eq!(rig.node_ids(), [Some(1), None, Some(3), Some(4), None], "another product is new");
    rig.slaves.happen(4, Happening::PowerOn);
    assert_eq!(rig.restart(), State::New);
    assert_eq!(rig.press(), State::Complete);
    assert_eq!(rig.node_ids(), [Some(1), None, Some(3), Some(4), Some(2)]);
    // The old one is a new one if it comes back.
    rig.slaves.happen(1, Happening::PowerOn);
    assert_eq!(rig.restart_all(), State::New);
    assert_eq!(rig.node_ids(), [Some(1), None, Some(3), Some(4), Some(2)]);
}

#[test]
fn a_board_that_could_replace_two_lost_ones_is_not_taken() {
    let mut rig = with_others([new_board(address(1, 4), RATE)]);
    let table = rig.table();
    (0..2).for_each(|slave| rig.slaves.happen(slave, Happening::PowerOff));
    rig.slaves.happen(3, Happening::PowerOn);
    assert_eq!(rig.press(), State::Conflict);
    assert_eq!(rig.node_ids(), [None, None, Some(3), None]);
    assert_eq!(rig.table(), table);
}

#[test]
fn the_node_id_of_a_silent_node_is_not_given_to_another() {
    let settings = Settings::new(RATE.into()).with_node_id(NodeId::new(1));
    let mut rig = Rig::new([silent(address(2, 1), settings), new_board(address(1, 2), RATE)]);
    rig.settle();
    assert_eq!(rig.press(), State::Complete);
    assert_eq!(rig.node_ids(), [Some(1), Some(2)], "1 sends no heartbeat, and answers by SDO");

    // In the table, and without LSS.
    let mut rig = Rig::with_habits([
        (silent(address(1, 1), settings), Habits { without: &[0x43], ..Habits::default() }),
        (new_board(address(1, 2), RATE), Habits::default()),
    ]);
    rig.settle();
    rig.set_table(&[Some(address(1, 1))]);
    let table = rig.table();
    assert_eq!(rig.press(), State::Conflict);
    assert_eq!((rig.node_ids(), rig.table()), (vec![Some(1), None], table));
}

#[test]
fn a_board_that_has_lost_its_power_has_its_node_id_again_after_seconds() {
    let mut rig = three();
    rig.slaves.happen(1, Happening::PowerOff);
    rig.run_for(Time::from_s(12));
    rig.slaves.happen(1, Happening::PowerOn);
    rig.run_for(Time::from_s(15));
    assert_eq!(rig.settle(), State::Complete);
    assert_eq!(rig.node_ids(), [1, 2, 3].map(Some));
}

#[test]
fn a_board_with_another_node_id_gets_that_of_the_table() {
    let other = Settings::new(RATE.into()).with_node_id(NodeId::new(40));
    let mut rig = Rig::new([silent(address(1, 1), other)]);
    rig.settle();
    rig.set_table(&[None, Some(address(1, 1))]);
    assert_eq!(rig.restart(), State::Complete);
    assert_eq!(rig.node_ids(), [Some(2)]);
}

#[test]
fn two_foreign_slaves_are_commissioned_as_far_as_they_can() {
    // One looks for a frame every ten milliseconds and loses the others, one knows no Fastscan.
    let mut rig = Rig::with_habits([
        (new_board(address(7, 1), RATE), Habits { poll_us: 10_000, ..Habits::default() }),
        (new_board(address(8, 2), RATE), Habits { without: &[0x51, 0x4C], ..Habits::default() }),
    ]);
    assert_eq!(rig.settle(), State::New);
    assert_eq!(rig.press(), State::Complete);
    assert_eq!(rig.node_ids(), [Some(1), None]);
    // A client writes its row.
    rig.set_table(&[Some(address(7, 1)), Some(address(8, 2))]);
    assert_eq!(rig.restart_all(), State::Complete);
    assert_eq!(rig.node_ids(), [Some(1), Some(2)]);
    assert!(rig.nothing_is_stored());
}

#[test]
fn it_stays_away_from_the_work_of_another_master() {
    let mut rig = three();
    let rival = rig.network.add_adapter(Adapter::new(125_000));
    rig.take_requests();
    rig.network.power_off(0);
    rig.run_for(Time::from_ms(10));
    rig.network.power_on(0);
    for _ in 0..10 {
        rig.send_as_another_master(rival, "04 00");
        rig.run_for(Time::from_ms(1_000));
    }
    assert_eq!(rig.state(), State::Rival);
    assert_eq!(rig.take_requests(), [0x04; 10], "those of the rival alone");
    rig.run_for(Time::from_s(3));
    assert_eq!(rig.settle(), State::Complete);

    // In the middle of its work: the order of the button is void.
    rig.push(true);
    rig.run_for(Time::from_ms(1_700));
    rig.push(false);
    rig.send_as_another_master(rival, "04 00");
    rig.run_for(Time::from_ms(100));
    assert_eq!(rig.state(), State::Rival);
}

#[test]
fn two_commissioners_with_one_table_do_not_disturb_each_other() {
    // The second one begins so many microseconds later.
    for (rate, later_us) in [(RATE, 300), (BitRate::Kbit1000, 0), (BitRate::Kbit1000, 100)] {
        let boards = [1, 2].map(|number| (new_board(address(1, number), rate), Habits::default()));
        let mut rig = Rig::at(rate, boards);
        rig.settle();
        rig.set_table(&[1, 2].map(|number| Some(address(1, number))));
        let flash = rig.network.board(0).flash();
        let mut second = commissioner(1, rate);
        second.set_flash(0, &flash);
        rig.network.add_board(second);
        (0..2).for_each(|board| rig.network.power_off(board));
        rig.run_for(Time::from_ms(10));
        rig.network.power_on(0);
        rig.run_for(Time::from_us(later_us));
        rig.network.power_on(1);
        rig.run_for(Time::from_s(30));
        assert_eq!(rig.node_ids(), [Some(1), Some(2)]);
        for board in 0..2 {
            assert_eq!(rig.pattern(board), (16, 0), "both know that all are there");
            assert_eq!(rig.network.board(board).flash(), flash);
        }
    }
}

#[test]
fn the_led_says_what_it_does() {
    let mut rig = Rig::new(blank(1..=1));
    assert_eq!(rig.pattern(0), (8, 8), "it asks");
    rig.settle();
    assert_eq!(rig.pattern(0), (8, 2), "a new board");
    rig.press();
    assert_eq!(rig.pattern(0), (16, 0), "all are there");
    rig.slaves.happen(0, Happening::PowerOff);
    rig.restart();
    assert_eq!(rig.pattern(0), (1, 2), "one is missing");
}
