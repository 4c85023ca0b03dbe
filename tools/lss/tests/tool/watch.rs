//! `lss list --watch`.

use std::{cell::RefCell, rc::Rc};

use canopen_node::{BitRate, Frame};

use crate::emulated::{Boards, address_text};

const RATE: BitRate = BitRate::Kbit125;

/// Boards with these node-IDs, each of which sends a heartbeat once a second, and further ones without a node-ID.
fn with_heartbeats<const N: usize>(ids: [u8; N], blank: usize) -> Boards {
    let boards = Boards::new(RATE, &vec![0xFF; N + blank]);
    for (board, id) in ids.into_iter().enumerate() {
        let set = format!("set-id {id} --store --address {}", address_text(board));
        assert_eq!(boards.lss(&set).code, 0);
    }
    boards
}

/// The lines after the table, without their times.
fn events(text: &str) -> Vec<&str> {
    let lines = text.lines().skip_while(|line| !line.starts_with("   "));
    lines.map(|line| &line[11..]).collect()
}

/// Keeps the frames that the tool sends, with their time in seconds.
fn record(boards: &Boards) -> Rc<RefCell<Vec<(f64, Frame)>>> {
    let frames = Rc::new(RefCell::new(Vec::new()));
    let recorded = Rc::clone(&frames);
    let start = boards.rig().network.now();
    boards.at_each_frame(move |frame, network| {
        let seconds = (network.now() - start).as_us() as f64 / 1e6;
        recorded.borrow_mut().push((seconds, *frame));
    });
    frames
}

#[test]
fn a_board_that_vanishes_and_comes_back_is_told_and_only_it_is_asked() {
    let boards = with_heartbeats([5, 7], 0);
    let frames = record(&boards);
    boards.after(20, |network| network.power_off(1));
    boards.after(30, |network| network.power_on(1));
    boards.interrupt_after(40);
    let outcome = boards.lss("list --watch");
    assert_eq!((outcome.code, outcome.error.as_str()), (0, ""));
    assert!(outcome.text.starts_with("node-ID  LSS address "), "{}", outcome.text);
    let events = events(&outcome.text);
    assert!(events[0].starts_with("node 7 has vanished: no heartbeat for 2."), "{events:?}");
    assert_eq!(events[1..], ["node 7: boot-up (1)", "node 7: pre-operational"]);
    // From the list on it is silent, and asks nobody but the board that has come back, by SDO.
    let frames = frames.borrow();
    let late: Vec<_> = frames.iter().filter(|(seconds, _)| *seconds > 10.0).collect();
    assert!(late.iter().all(|(seconds, _)| (30.0..31.0).contains(seconds)), "{late:?}");
    assert!(late.iter().all(|(_, frame)| frame.cob_id() == 0x607), "{late:?}");
    assert!((5..30).contains(&late.len()), "{late:?}");
    boards.assert_waiting(RATE);
}

#[test]
fn a_board_that_appears_is_asked_who_it_is() {
    let boards = with_heartbeats([5, 7], 1);
    boards.rig().network.power_off(1);
    let frames = record(&boards);
    boards.after(20, |network| network.power_on(1));
    // Another master gives the board without a node-ID one.
    let blank = crate::emulated::address(2);
    {
        let mut rig = boards.rig();
        let [master, _] = rig.add_others(RATE);
        let send = move |network: &mut emulator::network::Network, request: &str| {
            let frame = testkit::wire::on_the_wire(&testkit::frames::request(request));
            network.send(master, frame);
        };
        drop(rig);
        boards.after(30, move |network| {
            let [vendor, product, revision, serial] =
                [blank.vendor_id, blank.product_code, blank.revision_number, blank.serial_number];
            for (specifier, number) in
                [(0x40, vendor), (0x41, product), (0x42, revision), (0x43, serial)]
            {
                let [a, b, c, d] = number.to_le_bytes();
                send(network, &format!("{specifier:02X} {a:02X} {b:02X} {c:02X} {d:02X}"));
            }
            send(network, "11 09");
            send(network, "04 00");
        });
    }
    boards.interrupt_after(40);
    let outcome = boards.lss("list --watch");
    assert_eq!((outcome.code, outcome.error.as_str()), (0, ""));
    let expected = [
        "node 7 appears".to_owned(),
        "node 7: boot-up (1)".into(),
        format!("node 7 is board {} LSS slave", address_text(1)),
        "node 7: pre-operational".into(),
        "node 9 appears".into(),
        "node 9: boot-up (1)".into(),
        format!("node 9 is board {} LSS slave", address_text(2)),
        "node 9: pre-operational".into(),
    ];
    assert_eq!(events(&outcome.text), expected);
    let frames = frames.borrow();
    let late = frames.iter().filter(|(seconds, _)| *seconds > 10.0);
    assert!(late.clone().count() > 20);
    assert!(late.clone().all(|(_, frame)| (0x601..=0x67F).contains(&frame.cob_id())));
}

#[test]
fn an_emergency_is_told_in_words() {
    let boards = with_heartbeats([5], 0);
    boards.after(20, |network| network.set_short(Some(emulator::can::Short::Recessive)));
    boards.after(23, |network| network.set_short(None));
    boards.interrupt_after(40);
    let outcome = boards.lss("list --watch");
    let events = events(&outcome.text).join("\n");
    assert!(events.contains("node 5: emergency 8140h, recovered from bus-off"), "{events}");
}

#[test]
fn a_terminal_shows_the_table_and_draws_it_again() {
    let boards = with_heartbeats([5, 7], 1);
    boards.has_screen.set(true);
    boards.after(20, |network| network.power_off(1));
    boards.interrupt_after(30);
    let outcome = boards.lss("list --watch");
    assert_eq!((outcome.code, outcome.error.as_str()), (0, ""));
    let drawings: Vec<&str> = outcome.text.split("\x1B[H").skip(1).collect();
    // Four a second, and some seconds for the list.
    assert!((70..120).contains(&drawings.len()), "{}", drawings.len());
    let lines = |drawing: &str| -> Vec<String> {
        drawing.replace("\x1B[K", "").replace("\x1B[J", "").lines().map(str::to_owned).collect()
    };
    let first = lines(drawings[0]);
    assert_eq!(first[0], "125 kbit/s, nodes: 2, boards without a node-ID: 1. Ctrl-C ends");
    assert!(first[3].starts_with("7        pre-operational "), "{first:?}");
    // The very last one is drawn when the next heartbeat is due.
    let last = lines(drawings[drawings.len() - 2]);
    assert_eq!(last[0], "125 kbit/s, nodes: 1, boards without a node-ID: 1. Ctrl-C ends");
    assert!(last[2].starts_with("5        pre-operational      0."), "{last:?}");
    assert!(last[3].starts_with("7        vanished             "), "{last:?}");
    assert!(last[4].starts_with("none     -                        -         0  125 "), "{last:?}");
    assert!(last[6].contains("node 7 has vanished: no heartbeat for"), "{last:?}");
    assert!(last.iter().all(|line| line.len() <= 80));
}

#[test]
fn a_watch_without_a_node_waits_for_one_and_ctrl_c_in_its_list_ends_it() {
    let boards = with_heartbeats([5], 0);
    boards.rig().network.power_off(0);
    boards.after(20, |network| network.power_on(0));
    boards.interrupt_after(30);
    let outcome = boards.lss("list --watch");
    assert_eq!(outcome.code, 0);
    assert!(outcome.text.contains("\nnobody answers at 125 kbit/s yet. `lss find` looks for the"));
    let expected = [
        "node 5 appears".to_owned(),
        "node 5: boot-up (1)".into(),
        format!("node 5 is board {} LSS slave", address_text(0)),
        "node 5: pre-operational".into(),
    ];
    assert_eq!(events(&outcome.text), expected);
    let boards = Boards::new(RATE, &[0xFF]);
    boards.interrupt_at(150);
    assert_eq!(boards.lss("list --watch").code, 130);
    boards.assert_waiting(RATE);
}
