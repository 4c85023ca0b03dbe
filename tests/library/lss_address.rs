//! The LSS address: its parts, and a serial number from a chip's unique id.

use canopen_node::lss::Address;

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
