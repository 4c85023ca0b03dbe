//! `lss blink`, by the pins of the emulated board.

use std::{cell::RefCell, rc::Rc};

use canopen_node::BitRate;
use emulator::{Time, chip::Pin, network::Network};

use crate::emulated::{Boards, address_text};

const RATE: BitRate = BitRate::Kbit125;
const RUN: Pin = Pin('D', 12);
const ERR: Pin = Pin('D', 14);

/// Whether both LEDs of a board flicker in turn.
fn flickers(network: &mut Network, board: usize) -> bool {
    let levels: Vec<_> = (0..20)
        .map(|_| {
            network.run_for(Time::from_ms(50));
            [RUN, ERR].map(|pin| network.board(board).output(pin).level == Some(true))
        })
        .collect();
    levels.iter().all(|[run, error]| run != error)
        && levels.windows(2).all(|pair| pair[0] != pair[1])
}

#[test]
fn only_the_board_that_is_meant_flickers_until_the_person_answers() {
    for which in ["7".to_owned(), address_text(1)] {
        let boards = Boards::new(RATE, &[5, 7, 9]);
        let seen = Rc::new(RefCell::new(Vec::new()));
        let seen_by = Rc::clone(&seen);
        boards.after(5, move |network| {
            seen_by.borrow_mut().extend([0, 1, 2].map(|board| flickers(network, board)));
        });
        let outcome = boards.lss(&format!("blink {which}"));
        assert_eq!(outcome.code, 0, "{}", outcome.error);
        assert!(outcome.text.starts_with(&format!("node 7  {}  both LEDs", address_text(1))));
        assert_eq!(*seen.borrow(), [false, true, false]);
        boards.assert_waiting(RATE);
        assert!(!flickers(&mut boards.rig().network, 1));
        // A person ends it.
        boards.person.set(Some(&[""]));
        let before = boards.rig().network.now();
        assert_eq!(boards.lss(&format!("blink {which}")).code, 0);
        assert!(boards.rig().network.now() - before < Time::from_ms(2_000));
    }
}

#[test]
fn a_board_without_a_node_id_flickers_always_and_the_person_is_told() {
    let outcome = Boards::new(RATE, &[0xFF]).lss(&format!("blink {}", address_text(0)));
    assert_eq!(outcome.code, 0);
    assert!(outcome.text.contains("it has no node-ID: "), "{}", outcome.text);
}

#[test]
fn a_node_id_that_nobody_or_several_have_does_not_blink() {
    let boards = Boards::new(RATE, &[5, 5]);
    assert_eq!(boards.lss("blink 6").code, 3);
    let outcome = boards.lss("blink 5");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.contains("boards have node-ID 5"), "{}", outcome.error);
    boards.assert_waiting(RATE);
}
