//! Networks with the release image of the commissioner, in virtual time. None of them has a node-ID twice, at any time:
//! the rig checks that.

mod rig;

use std::fmt::Debug;

use canopen_node::{NodeId, Settings};
use emulator::Time;
use rig::{RATE, Rig, State, address, blank, blanks, table, with_node_id};
use testkit::{
    image::Firmware,
    image_rig::{BOOT, blank_board},
    node_rig::NodeRig,
    parallel,
    random::{Random, every},
    slave_bus::{Defect, Habits, Happening},
};

/// Three boards of product 1 in the table, with the node-IDs 1 to 3.
fn three() -> Rig {
    with_others([])
}

/// The same, with other boards that have no power yet.
fn with_others<const N: usize>(others: [NodeRig; N]) -> Rig {
    let mut rig = Rig::with_table(table(&[1, 2, 3]), blanks(1..=3).into_iter().chain(others));
    (3..3 + N).for_each(|slave| rig.slaves.happen(slave, Happening::PowerOff));
    assert_eq!(rig.settle(), State::Complete);
    rig
}

#[test]
fn each_press_takes_a_board_of_twenty() {
    let mut rig = Rig::new(blanks(1..=20));
    assert_eq!(rig.settle(), State::New);
    for count in 1..20 {
        assert_eq!(rig.press(), State::New);
        assert_eq!(rig.node_ids().iter().flatten().count(), count);
    }
    assert_eq!(rig.press(), State::Complete);
    let nodes = rig.node_ids();
    let mut sorted = nodes.clone();
    sorted.sort_unstable();
    assert_eq!(sorted, (1..=20).map(Some).collect::<Vec<_>>());
    assert!(rig.nothing_is_stored(), "the table has the node-IDs");

    assert_eq!(rig.restart_all(), State::Complete);
    assert_eq!(rig.node_ids(), nodes);
    assert!(rig.places().iter().all(|(place, node)| place == node));
    assert_eq!(rig.places().len(), 20);
}

#[test]
fn boards_of_the_table_are_asked_before_it_scans() {
    let mut rig = three();
    rig.take_requests();
    rig.restart_all();
    let requests = rig.take_requests();
    let scan = requests.iter().position(|request| *request == 0x51);
    let given = requests.iter().position(|request| *request == 0x11);
    assert!(given.is_some() && given < scan, "{requests:02X?}");
}

#[test]
fn boards_with_the_release_image_are_commissioned() {
    let mut rig = Rig::new([]);
    for number in 1..=3 {
        rig.network.add_board(blank_board(Firmware::Default, number));
    }
    // They format their flash.
    rig.run_for(BOOT);
    assert_eq!(rig.restart(), State::New);
    assert_eq!([(); 3].map(|()| rig.press()), [State::New, State::New, State::Complete]);
    (0..4).for_each(|board| rig.network.power_off(board));
    rig.run_for(Time::from_ms(10));
    (0..4).for_each(|board| rig.network.power_on(board));
    assert_eq!(rig.settle(), State::Complete);
}

#[test]
fn nothing_is_given_and_nothing_stored_without_the_button() {
    let mut rig = Rig::new(blanks(1..=2));
    assert_eq!(rig.settle(), State::New);
    let flash = rig.network.board(0).flash();
    assert_eq!(rig.restart(), State::New);
    rig.run_for(Time::from_s(30));
    assert_eq!(rig.node_ids(), [None; 2]);
    assert_eq!(rig.take_requests().last(), Some(&0x04), "none is left in configuration state");
    assert_eq!(rig.network.board(0).flash(), flash);
    assert!(rig.nothing_is_stored());
}

#[test]
fn a_press_takes_one_board_also_if_it_bounces_or_comes_while_it_asks() {
    let mut rig = Rig::new(blanks(1..=3));
    rig.settle();
    assert_eq!(rig.press(), State::New);
    assert_eq!(rig.node_ids().iter().flatten().collect::<Vec<_>>(), [&1]);
    let bounce = |rig: &mut Rig, last: bool| {
        for level in [!last, last].repeat(4) {
            rig.push(level);
            rig.run_for(Time::from_ms(7));
        }
    };
    bounce(&mut rig, true);
    rig.run_for(Time::from_ms(60));
    bounce(&mut rig, false);
    assert_eq!(rig.settle(), State::New);
    assert_eq!(rig.node_ids().iter().flatten().count(), 2);
    rig.take_requests();
    while rig.requests.is_empty() {
        rig.run_for(Time::from_ms(10));
    }
    assert_eq!(rig.press(), State::Complete);
    assert_eq!(rig.places().len(), 3);
}

#[test]
fn a_lost_board_is_replaced_by_one_of_its_product_and_no_other() {
    let mut rig = with_others([blank(address(2, 4)), blank(address(1, 5))]);
    rig.slaves.happen(1, Happening::PowerOff);
    rig.slaves.happen(3, Happening::PowerOn);
    rig.run_for(Time::from_s(10));
    assert_eq!(rig.settle(), State::New);
    assert_eq!(rig.press(), State::Missing);
    assert_eq!(rig.node_ids(), [Some(1), None, Some(3), Some(4), None], "another product is new");
    rig.slaves.happen(4, Happening::PowerOn);
    assert_eq!(rig.press(), State::Complete);
    assert_eq!(rig.node_ids(), [Some(1), None, Some(3), Some(4), Some(2)]);
    // The old one is a new one if it comes back.
    rig.slaves.happen(1, Happening::PowerOn);
    assert_eq!(rig.restart_all(), State::New);
    assert_eq!(rig.node_ids(), [Some(1), None, Some(3), Some(4), Some(2)]);
}

#[test]
fn a_board_that_could_replace_two_lost_ones_is_not_taken() {
    let mut rig = with_others([blank(address(1, 4))]);
    (0..2).for_each(|slave| rig.slaves.happen(slave, Happening::PowerOff));
    rig.slaves.happen(3, Happening::PowerOn);
    assert_eq!(rig.press(), State::Conflict);
    assert_eq!(rig.node_ids(), [None, None, Some(3), None]);
    assert_eq!(rig.table(), table(&[1, 2, 3]));
}

#[test]
fn the_node_id_of_another_node_is_not_given() {
    // It sends no heartbeat, and answers by SDO.
    let silent = || with_node_id(address(2, 1), 1);
    let mut rig = Rig::new([silent(), blank(address(1, 2))]);
    assert_eq!((rig.settle(), rig.press()), (State::New, State::Complete));
    assert_eq!(rig.node_ids(), [Some(1), Some(2)]);
    // It has a heartbeat and no server.
    let settings = Settings::new(RATE.into()).with_node_id(NodeId::new(1));
    let heard = || NodeRig::with_heartbeat_and(settings, 1_000);
    for (node, defect) in [(silent(), None), (heard(), Some(Defect::LosesAnswers(usize::MAX)))] {
        let mut rig = Rig::with_table(table(&[2]), [node, blank(address(1, 2))]);
        rig.slaves.slaves[0].defect = defect;
        assert_eq!((rig.settle(), rig.press()), (State::Conflict, State::Conflict));
        assert_eq!((rig.node_ids(), rig.table()), (vec![Some(1), None], table(&[2])));
    }
}

#[test]
fn a_board_without_its_node_id_has_it_again_after_seconds_in_every_state() {
    let silent = with_node_id(address(2, 5), 4);
    let mut rig = with_others([blank(address(1, 4)), silent]);
    for (state, others) in [
        (State::Complete, [false, false]),
        (State::New, [true, false]),
        (State::Complete, [false, true]),
    ] {
        for (slave, is_on) in (3..).zip(others) {
            let happening = if is_on { Happening::PowerOn } else { Happening::PowerOff };
            rig.slaves.happen(slave, happening);
        }
        rig.run_for(Time::from_s(12));
        assert_eq!(rig.settle(), state);
        rig.cut_power_of(1, Time::from_s(5));
        rig.run_for(Time::from_s(20));
        assert_eq!(rig.settle(), state);
        assert_eq!(rig.node_ids()[..3], [1, 2, 3].map(Some));
    }
    // A board is missing.
    rig.slaves.happen(0, Happening::PowerOff);
    rig.cut_power_of(1, Time::from_s(5));
    rig.run_for(Time::from_s(20));
    assert_eq!((rig.settle(), &rig.node_ids()[1..3]), (State::Missing, &[2, 3].map(Some)[..]));
}

#[test]
fn a_board_that_loses_its_power_while_it_gets_its_node_id_is_no_conflict() {
    for (request, times) in [(0x5E, 2), (0x11, 1)] {
        let mut rig = Rig::with_table(table(&[1]), blanks(1..=1));
        let is_request = |(_, sent): &&(Time, [u8; 8])| sent[0] == request;
        while rig.requests.iter().filter(is_request).count() < times {
            rig.run_for(Time::from_us(100));
        }
        rig.cut_power_of(0, Time::from_ms(20));
        assert_eq!((rig.settle(), rig.node_ids()), (State::Complete, vec![Some(1)]));
    }
}

#[test]
fn a_boot_up_makes_it_ask_within_two_seconds() {
    let mut rig = with_others([with_node_id(address(2, 4), 40)]);
    rig.take_requests();
    rig.slaves.happen(3, Happening::PowerOn);
    rig.run_for(Time::from_ms(2_000));
    assert!(!rig.requests.is_empty());
}

#[test]
fn a_board_with_another_node_id_gets_that_of_the_table() {
    let mut rig = Rig::with_table(table(&[1, 2]), [with_node_id(address(1, 2), 40)]);
    assert_eq!((rig.settle(), rig.node_ids()), (State::Missing, vec![Some(2)]));
    assert_eq!(rig.resets, 1);
    // One that takes none is left alone.
    let mut rig = Rig::with_table(table(&[1]), [with_node_id(address(1, 1), 40)]);
    rig.slaves.slaves[0].defect = Some(Defect::Refuses(&[0x11]));
    assert_eq!((rig.settle(), rig.node_ids()), (State::Conflict, vec![Some(40)]));
    assert_eq!(rig.resets, 0);
}

#[test]
fn boards_that_hold_the_node_ids_of_one_another_are_parted() {
    for others in [&[2, 1][..], &[2, 3, 1], &[3, 2, 1]] {
        let boards =
            (1..).zip(others).map(|(number, node)| with_node_id(address(1, number), *node));
        let mut rig = Rig::with_table(table(&[1, 2, 3][..others.len()]), boards);
        assert_eq!(rig.settle(), State::Complete);
        assert_eq!(
            rig.places(),
            (1..=others.len() as u8).map(|node| (Some(node), Some(node))).collect::<Vec<_>>()
        );
        assert!(rig.nothing_is_stored());
    }
}

#[test]
fn two_boards_with_one_address_get_no_node_id() {
    // In the table, and new.
    for rows in [table(&[1, 2]), table(&[2])] {
        let mut rig = Rig::with_table(rows, blanks([1, 1, 2]));
        rig.settle();
        assert_eq!(rig.press(), State::Conflict);
        assert_eq!(rig.node_ids()[..2], [None; 2]);
        assert!(rig.node_ids()[2].is_some());
        assert_eq!(rig.table(), rows);
        // One of them alone gets it.
        rig.slaves.happen(1, Happening::PowerOff);
        rig.press();
        assert_eq!(rig.settle(), State::Complete);
        // The other comes later.
        rig.slaves.happen(1, Happening::PowerOn);
        rig.run_for(Time::from_s(12));
        assert_eq!(rig.settle(), State::Conflict);
        assert!(rig.node_ids()[0].is_some() && rig.node_ids()[1].is_none());
    }
}

#[test]
fn a_table_with_one_address_twice_is_refused() {
    let mut rig = Rig::with_table(table(&[1, 2, 1]), blanks(1..=3));
    rig.settle();
    assert_eq!(rig.press(), State::Invalid);
    assert_eq!((rig.node_ids(), rig.table()), (vec![None; 3], table(&[1, 2, 1])));
    assert!(rig.requests.is_empty());
}

#[test]
fn a_damaged_table_is_refused() {
    let mut rig = three();
    let (flash, serial_number) = (rig.network.board(0).flash(), address(1, 1).serial_number);
    let mut words = flash.windows(4);
    let damaged = words.position(|word| word == serial_number.to_le_bytes()).expect("it is there");
    rig.network.power_off(0);
    rig.network.board_mut(0).set_flash(damaged as u32, &[0; 4]);
    rig.network.power_on(0);
    assert_eq!((rig.settle(), rig.press()), (State::Invalid, State::Invalid));
}

#[test]
fn foreign_slaves_are_commissioned_as_far_as_they_can() {
    // One looks for a frame every ten milliseconds and loses the others, one knows no Fastscan.
    let slaves = || {
        [
            (blank(address(7, 1)), Habits { poll_us: 10_000, ..Habits::default() }),
            (blank(address(8, 2)), Habits { without: &[0x51, 0x4C], ..Habits::default() }),
        ]
    };
    let mut rig = Rig::with_habits(None, slaves());
    assert_eq!((rig.settle(), rig.press()), (State::New, State::Complete));
    assert_eq!(rig.node_ids(), [Some(1), None]);
    let mut rows = table(&[]);
    (rows[0], rows[1]) = (Some(address(7, 1)), Some(address(8, 2)));
    let mut rig = Rig::with_habits(rows, slaves());
    assert_eq!(rig.settle(), State::Complete);
    assert_eq!(rig.node_ids(), [Some(1), Some(2)]);
    assert!(rig.nothing_is_stored());
}

#[test]
fn it_stays_away_from_the_work_of_another_master() {
    let mut rig = with_others([blank(address(1, 4))]);
    let rival = rig.add_rival();
    rig.slaves.happen(3, Happening::PowerOn);
    rig.run_for(Time::from_s(12));
    assert_eq!(rig.settle(), State::New);
    rig.take_requests();
    for _ in 0..12 {
        rig.send_as_rival(rival, "04 00");
        rig.run_for(Time::from_ms(1_000));
    }
    assert_eq!(rig.take_requests(), [0x04; 12], "those of the rival alone");
    assert_eq!(rig.state(), State::Waiting);
    // A press meanwhile is void, and so is one in the middle of its work.
    rig.push(true);
    rig.run_for(Time::from_ms(50));
    rig.push(false);
    rig.send_as_rival(rival, "04 00");
    rig.run_for(Time::from_ms(500));
    assert_eq!(rig.take_requests(), [0x04]);
    assert_eq!(rig.settle(), State::New);
    rig.push(true);
    rig.run_for(Time::from_ms(200));
    rig.push(false);
    rig.send_as_rival(rival, "04 00");
    rig.run_for(Time::from_ms(100));
    assert_eq!(rig.state(), State::Waiting);
    assert_eq!(rig.settle(), State::New);
    assert_eq!(rig.node_ids(), [Some(1), Some(2), Some(3), None]);
}

#[test]
fn the_led_flickers_until_it_has_asked() {
    assert_eq!(Rig::with_table(table(&[1]), blanks(1..=1)).state(), State::Waiting);
}

#[test]
fn alone_on_the_bus_it_waits_for_its_boards() {
    let mut rig = three();
    (0..3).for_each(|slave| rig.slaves.happen(slave, Happening::PowerOff));
    rig.run_for(Time::from_s(30));
    assert_eq!(rig.state(), State::Missing);
    (0..3).for_each(|slave| rig.slaves.happen(slave, Happening::PowerOn));
    rig.run_for(Time::from_s(12));
    assert_eq!(rig.settle(), State::Complete);
    assert_eq!(rig.node_ids(), [1, 2, 3].map(Some));
}

/// A workshop for an hour: boards of ours and foreign ones, power cuts of all, a button that bounces, and at times another
/// master. In the end every board of the table is at its place.
fn work(seed: u64) {
    let mut random = Random::from_seed(seed);
    let slow = Habits { poll_us: 10_000, ..Habits::default() };
    let mut slaves: Vec<_> =
        blanks(1..=6).into_iter().map(|board| (board, Habits::default())).collect();
    slaves.push((blank(address(7, 7)), slow));
    slaves.push((blank(address(8, 8)), Habits { without: &[0x51, 0x4C], ..Habits::default() }));
    slaves.push((with_node_id(address(1, 10), 40), Habits::default()));
    // Always there, with a node-ID that is free in the table.
    slaves.push((with_node_id(address(9, 9), 4), Habits::default()));
    let mut rows = table(&[1, 2, 3]);
    // Without Fastscan one comes by the table alone.
    (rows[4], rows[5]) = (Some(address(1, 10)), Some(address(8, 8)));
    let mut rig = Rig::with_habits(rows, slaves);
    let rival = rig.add_rival();
    let end = Time::from_s(3_600);
    while rig.network.now() < end {
        rig.run_for(Time::from_ms(random.within(1..40_000)));
        let span = Time::from_ms(random.within(5..20_000));
        match random.within(0..8) {
            0 => rig.cut_power(span),
            1..=3 => rig.cut_power_of(random.within(0..9) as usize, span),
            4..=6 => {
                for _ in 0..random.within(1..8) {
                    rig.push(true);
                    rig.run_for(Time::from_ms(random.within(1..90)));
                    rig.push(false);
                    rig.run_for(Time::from_ms(random.within(1..15)));
                }
            }
            _ => {
                for _ in 0..random.within(1..20) {
                    rig.send_as_rival(rival, "04 00");
                    rig.run_for(Time::from_ms(random.within(1..900)));
                }
            }
        }
    }
    rig.run_for(Time::from_s(60));
    println!("seed {seed}: {:?}", rig.places());
    assert!(rig.places().iter().all(|(place, node)| place == node), "{:?}", rig.places());
}

#[test]
fn after_an_hour_in_a_workshop_every_board_of_the_table_is_at_its_place() {
    let mut random = Random::from_environment();
    let seeds: Vec<u64> = (0..12).step_by(every(12)).map(|_| random.u64()).collect();
    parallel::map(&seeds, |seed| work(*seed), |_, ()| {});
}

/// One board of the table, and a new one for which the button is pressed.
fn taking() -> Rig {
    let mut rig = Rig::with_table(table(&[1]), blanks(1..=2));
    assert_eq!(rig.settle(), State::New);
    rig.frames = 0;
    rig.push(true);
    rig.run_for(Time::from_ms(50));
    rig.push(false);
    rig
}

/// The board has its node-ID, or waits for the button and nothing of it is in the table.
fn expect_both(rig: &mut Rig, cut: impl Debug) {
    while rig.cut.is_some() {
        rig.run_for(Time::from_ms(50));
    }
    // A board that has lost its power and has no node-ID yet is asked ten seconds later at most.
    rig.run_for(Time::from_s(15));
    if rig.settle() == State::New {
        assert_eq!((rig.node_ids(), rig.table()), (vec![Some(1), None], table(&[1])), "{cut:?}");
        assert_eq!(rig.press(), State::Complete, "{cut:?}");
    }
    assert_eq!((rig.state(), rig.table()), (State::Complete, table(&[1, 2])), "{cut:?}");
    assert_eq!(rig.restart_all(), State::Complete, "{cut:?}");
    assert_eq!(rig.node_ids(), [Some(1), Some(2)], "{cut:?}");
    assert!(rig.nothing_is_stored());
}

#[test]
fn a_power_cut_behind_any_frame_while_a_board_is_taken_costs_nothing() {
    let mut rig = taking();
    rig.settle();
    let parties = [None, Some(0), Some(1)];
    let cuts = (1..rig.frames).flat_map(|after| {
        let spans = [Time::from_ms(20), Time::from_s(1)];
        spans.into_iter().flat_map(move |span| parties.map(|party| (after, party, span)))
    });
    let cuts: Vec<_> = cuts.step_by(every(61)).collect();
    let cut = |cut: &_| {
        let mut rig = taking();
        rig.cut = Some(*cut);
        expect_both(&mut rig, cut);
    };
    parallel::map(&cuts, cut, |_, ()| {});
}

#[test]
fn a_power_cut_while_the_table_is_written_leaves_it_or_the_one_before() {
    let mut rig = taking();
    let step = Time::from_us(100);
    let mut end = 0;
    while rig.table() != table(&[1, 2]) {
        rig.run_for(step);
        end += 1;
    }
    let cuts: Vec<_> = (end - 60..end + 2).step_by(every(5)).collect();
    let cut = |at: &u64| {
        let mut rig = taking();
        // Other steps would be another network.
        (0..*at).for_each(|_| rig.run_for(step));
        rig.cut_power(Time::from_ms(20));
        expect_both(&mut rig, at);
    };
    parallel::map(&cuts, cut, |_, ()| {});
}
