//! Boards with bit-rate supervision, in the initial states of its tests.

use canopen_node::{
    BitRate,
    BusEvent::{Error, Received},
    Settings,
};

use super::node_rig::{ADDRESS, NodeRig, defaults, device};

/// A supervised board with these factory defaults, just powered on.
pub fn with_defaults(defaults: Settings) -> NodeRig {
    NodeRig::of(device(ADDRESS).with_rescue(true).with_defaults(defaults))
}

/// A supervised board with node-ID 40h at `home`, just powered on.
pub fn powered_on(home: BitRate, heartbeat_ms: u16) -> NodeRig {
    let device = device(ADDRESS).with_rescue(true).with_heartbeat_ms(heartbeat_ms);
    NodeRig::of(device.with_defaults(defaults(0x40).with_bit_rate(home.into())))
}

/// A board at `home` that has received nothing and whose boot-up was not acknowledged, with an empty timeline.
pub fn unproven_at(home: BitRate, heartbeat_ms: u16) -> NodeRig {
    let mut board = powered_on(home, heartbeat_ms);
    board.is_acknowledged = false;
    board.power_cycle();
    board.timeline();
    board
}

/// The same at 125 kbit/s without a heartbeat.
pub fn unproven() -> NodeRig {
    unproven_at(BitRate::Kbit125, 0)
}

/// A board at 125 kbit/s whose boot-up was acknowledged, with an empty timeline.
pub fn proven() -> NodeRig {
    let mut board = powered_on(BitRate::Kbit125, 0);
    board.timeline();
    board
}

/// A board in configuration state that has switched from 250 to 50 kbit/s, with an empty timeline: `15` is 20 ms ago.
pub fn switched() -> NodeRig {
    let mut board = powered_on(BitRate::Kbit250, 0);
    board.configure("13 00 06, 15 0A 00");
    board.pass_ms(20);
    assert_eq!(board.bit_rate(), BitRate::Kbit50);
    board.timeline();
    board
}

/// A board that has just begun to listen at 1000 kbit/s because of an error at the unproven rate of 125 kbit/s.
pub fn searching() -> NodeRig {
    let mut board = unproven();
    board.see(Error);
    assert!(board.node.is_listening());
    board.timeline();
    board
}

/// The turn at home at 125 kbit/s, in microseconds: 30 ms and 18 frames.
pub const TURN_US: u64 = 49_440;

/// A board with home rate 125 kbit/s that has just become a guest at 1000 kbit/s, whose frames are acknowledged, with
/// an empty timeline.
pub fn guest() -> NodeRig {
    let mut board = searching();
    board.is_acknowledged = true;
    board.see(Received);
    board.timeline();
    board
}

/// The same after its first answer, with which it has reported itself.
pub fn asked_guest() -> NodeRig {
    let mut board = guest();
    board.sdo("40 00 10 00");
    board.timeline();
    board
}
