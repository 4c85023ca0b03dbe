//! A session of zencan-client's LSS master: Fastscan, node-ID, bit rate, store, and a switch of the bit rate.

use std::time::Duration;

use emulator::can::{Frame, Id};
use lss_slave::{BitRate, lss::Request};
use testkit::{boards, image};
use zencan_client::{
    LssMaster,
    common::{NodeId, lss::LssState},
};
use zencan_sessions::TokioBus;

const OLD_RATE: BitRate = BitRate::Kbit125;
const NEW_RATE: BitRate = BitRate::Kbit500;
const NODE_ID: u8 = 5;
const BOOT_UP: u16 = 0x700 + NODE_ID as u16;
/// The master's time-out for each Fastscan step.
const FASTSCAN_TIMEOUT: Duration = Duration::from_millis(20);
const SWITCH_DELAY_MS: u16 = 100;
/// More than the time to a boot-up.
const PATIENCE: Duration = Duration::from_secs(1);

#[test]
fn zencan_client_finds_and_configures_a_board_that_keeps_it() {
    let board = boards::board(image::PART, image::image(), 0);
    zencan_sessions::run(async {
        let bus = TokioBus::new([board], OLD_RATE);
        session(&bus).await;
    });
}

async fn session(bus: &TokioBus) {
    let boot_up = Some(Frame::data(Id::Standard(BOOT_UP), &[0]));
    let mut master = LssMaster::new(bus.clone(), bus.clone());
    let found = master.fast_scan(FASTSCAN_TIMEOUT).await.expect("a board");
    assert_eq!(found.serial, boards::serial_number(0));
    master.set_node_id(NodeId::new(NODE_ID).expect("a node-ID")).await.expect("accepted");
    master.set_baud_rate(0, NEW_RATE.index()).await.expect("accepted");
    master.store_config().await.expect("stored");

    // zencan-client cannot request it.
    let request = Request::ActivateBitTiming(SWITCH_DELAY_MS);
    bus.send(Frame::data(Id::Standard(0x7E5), &request.to_bytes())).await;
    let delay = Duration::from_millis(SWITCH_DELAY_MS.into());
    bus.pass(delay).await;
    bus.rig().set_master_bit_rate(NEW_RATE);
    bus.pass(delay + Duration::from_millis(10)).await;

    master.set_global_mode(LssState::Waiting).await;
    assert_eq!(bus.receive(PATIENCE).await, boot_up);
    bus.rig().network.power_off(0);
    bus.pass(Duration::from_millis(500)).await;
    bus.rig().network.power_on(0);
    assert_eq!(bus.receive(PATIENCE).await, boot_up);
}
