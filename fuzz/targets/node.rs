//! The node with frames, time and events in any order: its actions come to an end, it is silent when it must be, and
//! it stores only what a request asks for.

#![no_main]

use libfuzzer_sys::fuzz_target;
use canopen_node::{
    Action, BitRate, BitRateSetting, BitRates, BusEvent, Device, Frame, NodeId, Service, Settings,
    emergency::Fault, lss::StoreError,
};
use testkit::{
    flash::BoardFlash,
    node_rig::{ADDRESS, NodeRig},
};

/// `id` 1..=127: the node-ID, else none; `rate` 0..=4, 6..=8: a bit rate, else automatic.
fn new_board(id: u8, rate: u8) -> NodeRig {
    let bit_rates = BitRates::possible(40_000_000).with_automatic();
    let bit_rate = BitRate::from_table(0, rate).map_or(BitRateSetting::Automatic, Into::into);
    let defaults = Settings::new(bit_rate).with_node_id(NodeId::new(id));
    let device = Device::new(ADDRESS, bit_rates)
        .with_defaults(defaults)
        .with_heartbeat_ms(5)
        .with_name("Fuzz")
        .with_versions("A", "1.2.3")
        .with_rescue(true)
        .with_lss_lock(id & 1 == 1);
    let mut board = NodeRig::with_device(device, BoardFlash::blank(0), u32::MAX - 1_000_000);
    board.let_stores_take_time();
    // From the boot-up on nothing is acknowledged unless the input says so.
    board.is_acknowledged = false;
    board.power_cycle();
    board.take_actions();
    board
}

fn step(board: &mut NodeRig, [kind, ms, data @ ..]: [u8; 10]) {
    board.be_late_ms(ms.into());
    let len = usize::from(kind >> 4).min(8);
    let cob_id = match kind & 0xF {
        0 => 0x000,
        1..=6 => 0x7E5,
        7 | 8 => 0x600 + u16::from(board.node.node_id().map_or(data[7], NodeId::get)),
        9 => u16::from_le_bytes([data[6], data[7]]),
        kind => return report(board, kind, data),
    };
    Frame::new(cob_id, &data[..len]).iter().for_each(|frame| _ = board.receive(frame));
}

/// Reports an event other than a frame.
fn report(board: &mut NodeRig, kind: u8, [what, counter, ..]: [u8; 8]) {
    match kind {
        10 if !board.is_storing() => {}
        10 if what == 0 => _ = board.end_store(Err(StoreError::MediumAccess)),
        10 => _ = board.finish_store(),
        11 => _ = board.acknowledge(if what & 1 == 0 { Service::BootUp } else { Service::Emergency }),
        12 => board.report(match what % 8 {
            0 => BusEvent::Received,
            1 => BusEvent::Error,
            2 => BusEvent::FormError,
            3 => BusEvent::HeldDominant,
            4 => BusEvent::BusOff,
            5 => BusEvent::BusOffRecovered,
            6 => BusEvent::Overrun,
            _ => BusEvent::ErrorCounters { transmit: counter, receive: counter / 2 },
        }),
        13 => board.node.handle_fault(Fault::SettingsLost),
        // A long time, up to a minute.
        _ => _ = board.be_late_ms(u64::from(what) * 250),
    }
    board.pass_us(0);
}

/// Whether a node with this node-ID may send the frame.
fn is_own(frame: &Frame, id: Option<NodeId>) -> bool {
    let of_node = |function| id.is_some_and(|id| frame.cob_id() == function + u16::from(id.get()));
    frame.cob_id() == 0x7E4 || [0x080, 0x580, 0x700].into_iter().any(of_node)
}

fuzz_target!(|data: (u8, u8, Vec<[u8; 10]>)| {
    let (id, rate, steps) = data;
    let mut board = new_board(id, rate);
    let mut id = NodeId::new(id);
    for data in steps {
        // A store also follows the end of another.
        let may_store = matches!(data[0] & 0xF, 1..=10);
        step(&mut board, data);
        for action in board.take_actions() {
            match action {
                Action::Transmit(frame, _) => assert!(is_own(&frame, id), "{frame:?} of {id:?}"),
                Action::SetNodeId(new) => id = new,
                Action::Store(_) => assert!(may_store, "{data:02X?} asks for no store"),
                Action::ResetDevice => return,
                _ => {}
            }
        }
    }
});
