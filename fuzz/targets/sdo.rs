//! The SDO server through the node: any request has at most one answer, of eight bytes, with the node's COB-ID.

#![no_main]

use libfuzzer_sys::fuzz_target;
use canopen_node::{Action, Frame};
use testkit::{
    flash::BoardFlash,
    node_rig::{ADDRESS, NodeRig, defaults, device},
};

const ABORT: u8 = 0x80;

fuzz_target!(|requests: Vec<[u8; 8]>| {
    let device = device(ADDRESS)
        .with_defaults(defaults(5))
        .with_name("A name that takes more than one segment")
        .with_versions("", "1.2.34.5");
    let mut board = NodeRig::with_device(device, BoardFlash::blank(0), 0);
    // Nothing leads to a second frame of a block.
    board.is_acknowledged = false;
    let boot_up = board.take_actions();
    assert!(matches!(boot_up[..], [Action::Transmit(frame, _)] if frame.cob_id() == 0x705));
    let (mut answers, mut stores) = (0, 0);
    for request in &requests {
        board.receive(&Frame::new(0x605, request).expect("eight bytes"));
        for action in board.take_actions() {
            match action {
                Action::Transmit(answer, _) if answer.cob_id() == 0x585 => {
                    assert_eq!(answer.data().len(), 8);
                    assert_ne!(request[0], ABORT, "an abort is answered");
                    answers += 1;
                }
                // A heartbeat, once its time has been written.
                Action::Transmit(other, _) => assert_eq!(other.cob_id(), 0x705),
                Action::Store(_) => stores += 1,
                other => panic!("{other:?} by SDO"),
            }
        }
    }
    assert!(answers <= requests.len());
    assert!(stores <= requests.len());
});
