//! Switch state selective and identify remote slave (CiA 305): which numbers match. `lss_model` compares the order of
//! their steps with a second model.

use canopen_node::lss::Address;
use testkit::{
    frames::{SILENCE, number},
    node_rig::{ADDRESS, NodeRig, device},
};

/// The steps of an identify with these bounds.
fn identify(board: &mut NodeRig, revision: [u32; 2], serial: [u32; 2]) -> bool {
    let steps = [ADDRESS.vendor_id, ADDRESS.product_code].into_iter().chain(revision).chain(serial);
    let sent = (0x46..).zip(steps).flat_map(|(command, value)| {
        let step = format!("{command:02X} {}", number(value));
        board.lss(&step).0
    });
    sent.count() == 1
}

#[test]
fn a_select_with_any_bit_wrong_in_any_step_is_not_answered() {
    for wrong in 0..4 {
        for bit in 0..32 {
            let mut board = NodeRig::unconfigured();
            let mut parts: [u32; 4] = ADDRESS.into();
            parts[wrong] ^= 1 << bit;
            for (command, part) in (0x40..).zip(parts) {
                assert_eq!(board.lss(&format!("{command:02X} {}", number(part))), SILENCE);
            }
            assert!(!board.is_in_configuration_state(), "bit {bit} of part {wrong}");
            assert_eq!(board.lss("43 EF BE AD DE"), SILENCE, "the wrong step cleared the progress");
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

#[test]
fn the_serial_number_of_a_unique_id_is_its_fnv_1a_hash() {
    for (id, hash) in [
        (&b""[..], 0x811C_9DC5),
        (b"a", 0xE40C_292C),
        (b"b", 0xE70C_2DE5),
        (b"foobar", 0xBF9C_F968),
    ] {
        assert_eq!(Address::serial_number_of(id), hash, "{id:?}");
        let device = device(ADDRESS).with_serial_number(hash);
        assert_eq!(device.address, Address { serial_number: hash, ..ADDRESS });
    }
}

#[test]
fn an_lss_address_in_bytes_has_each_number_from_its_lowest_byte_on() {
    let bytes = *b"\x01\x02\x03\x04\x05\x06\x07\x08\x09\x0A\x0B\x0C\x0D\x0E\x0F\x10";
    let address = Address::from([0x0403_0201, 0x0807_0605, 0x0C0B_0A09, 0x100F_0E0D]);
    assert_eq!(address.to_le_bytes(), bytes);
    assert_eq!(Address::from_le_bytes(bytes), address);
}
