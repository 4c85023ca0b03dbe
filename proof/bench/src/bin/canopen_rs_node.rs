//! The node of canopen-rs, with the objects that its SDO server needs.

#![no_std]
#![no_main]

use bench::{IDENTITY, Place, padded, received_data, received_identifier, transmit};
use canopen_rs::{Address, Entry, LssAddress, Node, NodeId, ObjectDictionary, Value};

static NODE: Place<Node<8>> = Place::empty();

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn prepare() {
    let [vendor_id, product_code, revision_number, serial_number] = IDENTITY;
    let mut dictionary = ObjectDictionary::new();
    let mut insert = |index, sub_index, entry| {
        let _ = dictionary.insert(Address::new(index, sub_index), entry);
    };
    insert(0x1000, 0, Entry::constant(Value::Unsigned32(0)));
    insert(0x1001, 0, Entry::ro(Value::Unsigned8(0)));
    insert(0x1017, 0, Entry::rw(Value::Unsigned16(0)));
    insert(0x1018, 0, Entry::constant(Value::Unsigned8(4)));
    for (sub_index, number) in (1..).zip(IDENTITY) {
        insert(0x1018, sub_index, Entry::constant(Value::Unsigned32(number)));
    }
    let Ok(id) = NodeId::new(1) else { return };
    let mut node = Node::new(id, dictionary);
    let address = LssAddress { vendor_id, product_code, revision_number, serial_number };
    node.enable_lss_unconfigured(address);
    NODE.fill(node);
}

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn receive() {
    let cob_id = received_identifier();
    let (length, data) = received_data();
    let Some(data) = data.get(..length) else {
        return;
    };
    // SAFETY: `prepare` has filled it, and the reference ends here.
    if let Some(frame) = unsafe { NODE.get() }.on_frame(cob_id, data) {
        transmit(frame.cob_id, frame.data().len(), padded(frame.data()));
    }
}
