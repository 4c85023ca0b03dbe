//! The node of zencan-node, with the objects that its SDO server needs, and an RPDO.

#![no_std]
#![no_main]

use core::ptr::addr_of_mut;

use bench::{
    DEVICE_NAME, IDENTITY, NOW, Place, padded, received_data, received_identifier, transmit,
};
// Provides its critical section.
use cortex_m as _;
use zencan_node::{
    Callbacks, Node, NodeMbox, NodeState, SDO_BUFFER_SIZE,
    common::{
        NodeId,
        messages::{CanId, CanMessage},
        objects::{ObjectCode, SubInfo},
    },
    object_dict::{
        ConstByteRefField, ConstField, ODEntry, ProvidesSubObjects, ScalarField, SubObjectAccess,
    },
    pdo::{Pdo, PdoDefaults},
    priority_queue::PriorityQueue,
};

/// An object with a number at sub-index 0.
struct Variable<T: SubObjectAccess>(T, SubInfo);

impl<T: SubObjectAccess> ProvidesSubObjects for Variable<T> {
    fn get_sub_object(&self, sub: u8) -> Option<(SubInfo, &dyn SubObjectAccess)> {
        (sub == 0).then_some((self.1, &self.0))
    }

    fn object_code(&self) -> ObjectCode {
        ObjectCode::Var
    }
}

struct Identity([ConstField<4>; 4]);

impl ProvidesSubObjects for Identity {
    fn get_sub_object(&self, sub: u8) -> Option<(SubInfo, &dyn SubObjectAccess)> {
        if sub == 0 {
            return Some((SubInfo::MAX_SUB_NUMBER, const { &ConstField::new([4]) }));
        }
        let field = self.0.get(usize::from(sub) - 1)?;
        Some((SubInfo::new_u32().const_access(), field))
    }

    fn object_code(&self) -> ObjectCode {
        ObjectCode::Record
    }
}

static DEVICE_TYPE: Variable<ConstField<4>> =
    Variable(ConstField::new([0; 4]), SubInfo::new_u32().const_access());
static ERROR_REGISTER: Variable<ScalarField<u8>> =
    Variable(ScalarField::<u8>::new(0), SubInfo::new_u8().ro_access());
static NAME: Variable<ConstByteRefField> = Variable(
    ConstByteRefField::new(DEVICE_NAME.as_bytes()),
    SubInfo::new_visible_str(DEVICE_NAME.len()).const_access(),
);
static HEARTBEAT_TIME: Variable<ScalarField<u16>> =
    Variable(ScalarField::<u16>::new(0), SubInfo::new_u16().rw_access());
static IDENTITY_OBJECT: Identity = Identity([
    ConstField::new(IDENTITY[0].to_le_bytes()),
    ConstField::new(IDENTITY[1].to_le_bytes()),
    ConstField::new(IDENTITY[2].to_le_bytes()),
    ConstField::new(IDENTITY[3].to_le_bytes()),
]);
static NUMBER: Variable<ScalarField<u32>> =
    Variable(ScalarField::<u32>::new(0), SubInfo::new_u32().rw_access());
static DICTIONARY: [ODEntry<'static>; 6] = [
    ODEntry { index: 0x1000, data: &DEVICE_TYPE },
    ODEntry { index: 0x1001, data: &ERROR_REGISTER },
    ODEntry { index: 0x1008, data: &NAME },
    ODEntry { index: 0x1017, data: &HEARTBEAT_TIME },
    ODEntry { index: 0x1018, data: &IDENTITY_OBJECT },
    ODEntry { index: 0x2100, data: &NUMBER },
];

static RPDO: PdoDefaults<'static> =
    PdoDefaults::new(0x200, false, true, true, false, 255, &[0x2100_0020]);
static RPDOS: [Pdo<'static>; 1] = [Pdo::new_with_defaults(&DICTIONARY, &STATE, &RPDO)];
static STATE: NodeState<'static> = NodeState::new(&RPDOS, &[]);
static QUEUE: PriorityQueue<4, CanMessage> = PriorityQueue::new();
static mut SDO_BUFFER: [u8; SDO_BUFFER_SIZE] = [0; SDO_BUFFER_SIZE];
static MAILBOX: NodeMbox =
    // SAFETY: there is no other reference to the buffer.
    NodeMbox::new(&RPDOS, &[], &QUEUE, unsafe { &mut *addr_of_mut!(SDO_BUFFER) });
static NODE: Place<Node<'static>> = Place::empty();

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn prepare() {
    let callbacks = Callbacks::new();
    let mut node = Node::new(NodeId::Unconfigured, callbacks, &MAILBOX, &STATE, &DICTIONARY);
    node.process(0);
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
    if MAILBOX.store_message(CanMessage::new(CanId::std(cob_id), data)).is_err() {
        return;
    }
    // SAFETY: `prepare` has filled it, and the reference ends here.
    unsafe { NODE.get() }.process(NOW.read().into());
    while let Some(message) = MAILBOX.next_transmit_message() {
        let data = message.data();
        transmit(message.id().raw() as u16, data.len(), padded(data));
    }
}
