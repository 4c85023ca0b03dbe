//! `lss inquire`, `identify`, `set-id`, `store` and `raw`.

use canopen_node::BitRate;
use emulator::Time;

use crate::emulated::{Boards, address, address_text};

const RATE: BitRate = BitRate::Kbit125;

#[test]
fn the_only_board_tells_its_address_and_node_id() {
    let boards = Boards::new(RATE, &[5]);
    let outcome = boards.lss("inquire");
    assert_eq!(outcome.code, 0);
    assert!(outcome.text.contains(&format!("LSS address      {}\n", address_text(0))));
    assert!(outcome.text.contains("node-ID          5\nbit rate         125 kbit/s\n"));
    boards.assert_waiting(RATE);
}

#[test]
fn one_of_several_boards_is_chosen_by_its_address() {
    let boards = Boards::new(RATE, &[5, 0xFF, 7]);
    let outcome = boards.lss(&format!("inquire --address {}", address_text(1)));
    assert!(outcome.text.contains("node-ID          none\n"), "{}", outcome.text);
    let outcome = boards.lss("inquire");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.starts_with("several boards answer, with the serial numbers "));
    for board in 0..3 {
        let serial_number = format!("{:08X}", address(board).serial_number);
        assert!(outcome.error.contains(&serial_number), "{}", outcome.error);
    }
    boards.assert_waiting(RATE);
}

#[test]
fn a_board_that_is_not_there_is_named() {
    let boards = Boards::new(RATE, &[5]);
    let outcome = boards.lss("inquire --address 1:2:3:4");
    assert_eq!(outcome.code, 3);
    assert!(
        outcome
            .error
            .starts_with("no board with the LSS address 00000001:00000002:00000003:00000004"),
        "{}",
        outcome.error
    );
    boards.assert_waiting(RATE);
}

#[test]
fn a_bus_without_a_board_and_a_wrong_bit_rate_are_told() {
    let outcome = Boards::new(RATE, &[]).lss("inquire");
    assert_eq!(outcome.code, 3);
    assert!(outcome.error.starts_with("nobody takes part in the bus at 125 kbit/s"));
    // The board is not disturbed so much that it looks for another rate.
    let boards = Boards::new(RATE, &[5]);
    assert_eq!(boards.lss("--bit-rate 500 inquire").code, 3);
    assert_eq!(boards.lss("inquire").code, 0);
}

#[test]
fn ranges_of_serial_numbers_are_asked_for_without_a_change_of_state() {
    let boards = Boards::new(RATE, &[5, 0xFF, 7]);
    let first = address(0);
    let product = format!("identify --vendor {} --product {}", first.vendor_id, first.product_code);
    let outcome = boards.lss(&product);
    assert_eq!((outcome.code, outcome.text.as_str()), (0, "a board within these ranges answers\n"));
    let serial = first.serial_number;
    assert_eq!(boards.lss(&format!("{product} --serial {serial}..{serial}")).code, 0);
    assert_eq!(boards.lss(&format!("{product} --serial 1276..2468")).code, 3);
    assert_eq!(boards.lss(&format!("{product} --revision 0xFFFFFFFF")).code, 3);

    let mut all: Vec<String> = (0..3).map(address_text).collect();
    all.sort();
    let outcome = boards.lss(&format!("{product} --each"));
    assert_eq!(outcome.text.lines().collect::<Vec<_>>(), all);
    boards.assert_waiting(RATE);
}

#[test]
fn a_blank_board_gets_a_node_id_and_boots_up() {
    let boards = Boards::new(RATE, &[0xFF]);
    let outcome = boards.lss("set-id 5");
    assert_eq!(outcome.code, 0);
    let expected =
        format!("board {}: node-ID 5, until a power cut: `lss store` keeps it\n", address_text(0));
    assert_eq!(outcome.text, expected);
    assert_eq!(boards.stored(0), None);

    let outcome = boards.lss("store");
    assert_eq!(outcome.text, format!("board {}: node-ID and bit rate stored\n", address_text(0)));
    assert_eq!(boards.stored(0), Some((5, 4)));
    boards.assert_waiting(RATE);
}

#[test]
fn another_node_id_takes_effect_at_a_reset() {
    let boards = Boards::new(RATE, &[5, 9]);
    let set = |id: &str| boards.lss(&format!("set-id {id} --address {}", address_text(0)));
    assert!(set("6").text.contains("node-ID 5, and 6 from NMT reset communication on (--reset)"));
    assert!(set("7 --reset --store").text.ends_with(": node-ID 7, stored\n"));
    assert_eq!(boards.stored(0), Some((7, 4)));
    assert_eq!(boards.stored(1), Some((9, 4)));
    assert!(set("none --reset").text.contains("node-ID none"));
    let inquired = boards.lss(&format!("inquire --address {}", address_text(0)));
    assert!(inquired.text.contains("node-ID          none\n"));
    boards.assert_waiting(RATE);
}

#[test]
fn a_node_id_that_another_node_has_is_not_given() {
    let boards = Boards::new(RATE, &[5, 0xFF]);
    let outcome = boards.lss(&format!("set-id 5 --address {}", address_text(1)));
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.starts_with("another node has the node-ID 5"), "{}", outcome.error);
    boards.assert_waiting(RATE);
}

#[test]
fn a_raw_request_is_sent_as_it_is_and_answers_have_words() {
    let boards = Boards::new(RATE, &[5]);
    let outcome = boards.lss("raw 04 01");
    assert_eq!(
        outcome.text,
        "7E5  04 01 00 00 00 00 00 00  LSS switch state global: configuration\n"
    );
    let outcome = boards.lss("raw 5E");
    assert_eq!(
        outcome.text,
        "7E5  5E 00 00 00 00 00 00 00  LSS inquire node-ID\n\
         7E4  5E 05 00 00 00 00 00 00  LSS node-ID is 5\n"
    );
    boards.lss("raw 04");
    boards.assert_waiting(RATE);
}

#[test]
fn ctrl_c_at_any_frame_leaves_no_board_in_configuration_state() {
    for number in 1..=30 {
        let boards = Boards::new(RATE, &[0xFF]);
        boards.interrupt_at(number);
        let outcome = boards.lss("set-id 5 --store");
        assert_eq!(outcome.code, if outcome.error.is_empty() { 0 } else { 130 }, "frame {number}");
        boards.assert_waiting(RATE);
        if outcome.code == 0 {
            assert!(number > 15);
            return;
        }
    }
    panic!("the command has no end");
}

#[test]
fn another_lss_master_ends_the_command() {
    let boards = Boards::new(RATE, &[5]);
    {
        let mut rig = boards.rig();
        let [other, _] = rig.add_others(RATE);
        let frame = testkit::wire::on_the_wire(&testkit::frames::request("04 00"));
        boards.at_each_frame(move |request, network| {
            // Between two frames of the tool, with which it would collide.
            if request.data().first() == Some(&0x5A) {
                network.run_for(Time::from_ms(3));
                network.send(other, frame);
            }
        });
    }
    let outcome = boards.lss("inquire");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.starts_with("two masters"), "{}", outcome.error);
}
