//! The LSS address: its parts, and a serial number from a chip's unique id.

use canopen_node::lss::{Address, AddressPart};

#[test]
fn a_part_has_the_number_that_fastscan_gives_it() {
    let parts = [
        AddressPart::VendorId,
        AddressPart::ProductCode,
        AddressPart::RevisionNumber,
        AddressPart::SerialNumber,
    ];
    for (number, part) in (0..).zip(parts) {
        assert_eq!(AddressPart::new(number), Some(part));
        assert_eq!(part as u8, number);
    }
    assert!((4..=0xFF).all(|number| AddressPart::new(number).is_none()));
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
    }
}
