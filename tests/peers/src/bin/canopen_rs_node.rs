//! The node of canopen-rs, with the objects that its SDO server needs.

#![no_std]
#![no_main]

use bench::{DEVICE_NAME, IDENTITY, Place, padded, received_data, received_identifier, transmit};
use canopen_rs::{
    Address, ByteString, Entry, LssAddress, MappingEntry, Node, NodeId, ObjectDictionary,
    PdoMapping, Value,
};

const NMT_COB_ID: u16 = 0;
const RESET_COMMUNICATION: u8 = 0x82;

static NODE: Place<Node<16>> = Place::empty();

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
    if let Ok(name) = ByteString::from_str(DEVICE_NAME) {
        insert(0x1008, 0, Entry::constant(Value::VisibleString(name)));
    }
    insert(0x1017, 0, Entry::rw(Value::Unsigned16(0)));
    insert(0x1018, 0, Entry::constant(Value::Unsigned8(4)));
    for (sub_index, number) in (1..).zip(IDENTITY) {
        insert(0x1018, sub_index, Entry::constant(Value::Unsigned32(number)));
    }
    insert(0x2100, 0, Entry::rw(Value::Unsigned32(0)));
    let Ok(id) = NodeId::new(1) else { return };
    let mut node = Node::new(id, dictionary);
    let address = LssAddress { vendor_id, product_code, revision_number, serial_number };
    node.enable_lss_unconfigured(address);
    let mut mapping = PdoMapping::new();
    let _ = mapping.push(MappingEntry::new(0x2100, 0, 32));
    let _ = node.add_rpdo(0x205, mapping);
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
    let node = unsafe { NODE.get() };
    if let Some(frame) = node.on_frame(cob_id, data) {
        transmit(frame.cob_id, frame.data().len(), padded(frame.data()));
    } else if cob_id == NMT_COB_ID && data.first() == Some(&RESET_COMMUNICATION) {
        node.apply_lss_node_id();
        node.boot();
    }
}
