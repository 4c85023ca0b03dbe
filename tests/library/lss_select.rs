//! Switch state selective and identify remote slave (CiA 305): all of their four and six steps must match in order.

use canopen_node::lss::Address;
use testkit::{
    frames::{self, Frames, SILENCE, number},
    node_rig::{ADDRESS, NodeRig},
};

const VENDOR: &str = "40 44 33 22 11";
const PRODUCT: &str = "41 88 77 66 55";
const REVISION: &str = "42 03 02 01 00";
const SERIAL: &str = "43 EF BE AD DE";
/// The steps of a select that matches.
const SELECT: [&str; 4] = [VENDOR, PRODUCT, REVISION, SERIAL];

/// The steps of an identify that exactly matches this slave.
const IDENTIFY: [&str; 6] = [
    "46 44 33 22 11",
    "47 88 77 66 55",
    "48 03 02 01 00",
    "49 03 02 01 00",
    "4A EF BE AD DE",
    "4B EF BE AD DE",
];

/// The steps of an identify with these bounds.
fn identify(board: &mut NodeRig, revision: [u32; 2], serial: [u32; 2]) -> bool {
    let steps = [ADDRESS.vendor_id, ADDRESS.product_code].into_iter().chain(revision).chain(serial);
    let sent = (0x46..).zip(steps).flat_map(|(command, value)| {
        let step = format!("{command:02X} {}", number(value));
        board.lss(&step).0
    });
    sent.count() == 1
}

fn send_all(board: &mut NodeRig, requests: &[&str]) {
    for request in requests {
        assert_eq!(board.lss(request), SILENCE, "{request}");
    }
}

#[test]
fn a_matching_select_is_answered_44_once_and_ends_in_configuration() {
    let mut board = NodeRig::with_node_id(0x40);
    send_all(&mut board, &SELECT[..3]);
    assert_eq!(board.lss(SERIAL), ["44 00 00 00 00 00 00 00"]);
    assert_eq!(board.lss("5E"), ["5E 40"]);
    let mut board = NodeRig::unconfigured();
    send_all(&mut board, &SELECT[..3]);
    assert!(!board.is_in_configuration_state(), "three of four steps");
    assert_eq!(board.lss(SERIAL), ["44"], "an inquiry between the steps does not matter");
}

#[test]
fn a_select_with_any_bit_wrong_in_any_step_is_not_answered() {
    for wrong in 0..4 {
        for bit in 0..32 {
            let mut board = NodeRig::unconfigured();
            let Address { vendor_id, product_code, revision_number, serial_number } = ADDRESS;
            let mut parts = [vendor_id, product_code, revision_number, serial_number];
            parts[wrong] ^= 1 << bit;
            for (command, part) in (0x40..).zip(parts) {
                assert_eq!(board.lss(&format!("{command:02X} {}", number(part))), SILENCE);
            }
            assert!(!board.is_in_configuration_state(), "bit {bit} of part {wrong}");
            assert_eq!(board.lss(SERIAL), SILENCE, "the wrong step cleared the progress");
        }
    }
}

#[test]
fn a_select_in_any_order_but_the_ascending_is_not_answered() {
    for order in 0..256 {
        let steps = [order >> 6, order >> 4 & 3, order >> 2 & 3, order & 3];
        let mut board = NodeRig::unconfigured();
        let sent: usize = steps.iter().map(|&step| board.lss(SELECT[step]).0.len()).sum();
        assert_eq!(sent == 1, steps == [0, 1, 2, 3], "{steps:?}");
        assert_eq!(board.is_in_configuration_state(), steps == [0, 1, 2, 3], "{steps:?}");
    }
}

#[test]
fn steps_of_an_earlier_attempt_do_not_count() {
    let mut board = NodeRig::unconfigured();
    send_all(&mut board, &[VENDOR, PRODUCT, REVISION, "43 00 00 00 00", SERIAL]);
    send_all(&mut board, &[VENDOR, PRODUCT, "42 00 00 00 00", REVISION, SERIAL]);
    send_all(&mut board, &[VENDOR, "41 00 00 00 00", PRODUCT, REVISION, SERIAL]);
    send_all(&mut board, &["40 00 00 00 00", PRODUCT, REVISION, SERIAL]);
    send_all(&mut board, &[VENDOR, PRODUCT, REVISION, "40 00 00 00 00", SERIAL]);
    send_all(&mut board, &[VENDOR, PRODUCT, REVISION, VENDOR, SERIAL]);
    send_all(&mut board, &[VENDOR, PRODUCT, REVISION, REVISION, SERIAL]);
    send_all(&mut board, &[VENDOR, PRODUCT, REVISION, VENDOR, PRODUCT, REVISION]);
    assert_eq!(board.lss(SERIAL), ["44"], "40 starts again");
}

#[test]
fn the_end_of_a_select_and_of_an_identify_resets_it() {
    let mut board = NodeRig::unconfigured();
    send_all(&mut board, &SELECT[..3]);
    assert_eq!(board.lss(SERIAL), ["44"]);
    assert_eq!(board.lss(SERIAL), SILENCE);
    send_all(&mut board, &IDENTIFY[..5]);
    assert_eq!(board.lss(IDENTIFY[5]), ["4F"]);
    assert_eq!(board.lss(IDENTIFY[5]), SILENCE);
}

#[test]
fn a_matching_identify_is_answered_4f_with_or_without_a_node_id() {
    for mut board in [NodeRig::unconfigured(), NodeRig::with_node_id(0x40)] {
        for state in ["04 00", "04 01"] {
            board.lss(state);
            send_all(&mut board, &IDENTIFY[..5]);
            assert_eq!(board.lss(IDENTIFY[5]), ["4F 00 00 00 00 00 00 00"]);
            assert_eq!(board.is_in_configuration_state(), state == "04 01", "the state stays");
        }
    }
}

#[test]
fn the_bounds_of_identify_are_unsigned_and_belong_to_the_range() {
    let Address { revision_number: revision, serial_number: serial, .. } = ADDRESS;
    let whole = [0, u32::MAX];
    let mut board = NodeRig::unconfigured();
    assert!(identify(&mut board, whole, whole));
    assert!(identify(&mut board, [revision, revision], whole));
    assert!(identify(&mut board, [revision - 1, revision + 1], whole));
    assert!(!identify(&mut board, [0, revision - 1], whole));
    assert!(!identify(&mut board, [revision + 1, u32::MAX], whole));
    assert!(identify(&mut board, whole, [serial, serial]));
    assert!(identify(&mut board, whole, [serial - 1, serial + 1]));
    assert!(!identify(&mut board, whole, [0, serial - 1]));
    assert!(!identify(&mut board, whole, [serial + 1, u32::MAX]));
    assert!(!identify(&mut board, [u32::MAX, 0], whole), "the bounds exchanged");
    assert!(!identify(&mut board, whole, [u32::MAX, 0]), "the bounds exchanged");
    let address = Address { revision_number: 0x8000_0000, serial_number: 0, ..ADDRESS };
    let mut board = NodeRig::with_address(address);
    assert!(identify(&mut board, [0x7FFF_FFFF, 0x8000_0000], [0, 0]));
    assert!(!identify(&mut board, [0x7FFF_FFFF, 0x7FFF_FFFF], [0, 0]));
}

/// The answers to the last of `steps`, with `event` before it.
fn answers_after(event: &str, steps: &[&str]) -> Frames {
    let (last, others) = steps.split_last().expect("several steps");
    let mut board = NodeRig::with_node_id(0x40);
    send_all(&mut board, others);
    board.receive(&frames::of_master(event));
    board.lss(last)
}

#[test]
fn each_accepted_04_and_each_reset_ends_a_select_or_an_identify_that_has_begun() {
    for (steps, answer) in [(&SELECT[..], "44"), (&IDENTIFY, "4F")] {
        for reset in ["04 00", "04 01", "000: 81 00", "000: 82 00"] {
            assert_eq!(answers_after(reset, steps), SILENCE, "{reset}");
        }
        for other in ["04 02", "000: 01 00", "000: 80 00"] {
            assert_eq!(answers_after(other, steps), [answer], "{other}");
        }
    }
}

#[test]
fn frames_of_another_family_leave_a_select_and_an_identify_alone() {
    const OTHERS: &str = "4C, 51 00 00 00 00 80, 51 00 00 00 00 1F 01 01, 5A, 5E, 11 05, \
        13 00 02, 17, 44, 4F, 00, FF";
    for (state, steps, other_family) in [
        ("04 00", &SELECT[..], &IDENTIFY[..]),
        ("04 00", &IDENTIFY, &SELECT),
        ("04 01", &IDENTIFY, &SELECT),
    ] {
        for other in other_family.iter().copied().chain(OTHERS.split(", ")) {
            for done in 1..steps.len() {
                let mut board = NodeRig::unconfigured();
                board.lss(state);
                send_all(&mut board, &steps[..done]);
                board.lss(other);
                let sent: usize = steps[done..].iter().map(|step| board.lss(step).0.len()).sum();
                assert_eq!(sent, 1, "{other} after {done} steps");
            }
        }
    }
}
