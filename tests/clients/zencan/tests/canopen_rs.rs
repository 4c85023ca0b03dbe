//! A session of canopen-rs' Fastscan master, which does no I/O itself.

use std::time::Duration;

use canopen_rs::lss::{
    self, FastscanMaster, LSS_MASTER_COB_ID, LSS_SLAVE_COB_ID, LssAddress, LssFrame,
};
use emulator::{
    can::{Frame, Id},
    chip::Part,
};
use lss_slave::BitRate;
use testkit::{boards, image};
use zencan_sessions::TokioBus;

const BOARDS: usize = 3;
/// The master's time-out for each request.
const TIMEOUT: Duration = Duration::from_millis(20);
/// The byte of a step that says from which bit on the parts of the identity are compared.
const BIT_CHECK: usize = 5;
/// The value that begins a scan. canopen-rs 0.6.1 sends 20h, which CiA 305 reserves, so that no slave answers.
const BEGIN: u8 = 0x80;

#[test]
fn canopen_rs_finds_three_blank_boards_with_the_first_byte_put_right() {
    let image = image::image();
    let boards = (0..BOARDS).map(|number| boards::board(Part::Stm32f405, image, number));
    zencan_sessions::run(async {
        let bus = TokioBus::new(boards, BitRate::Kbit125);
        let mut found = Vec::new();
        for node_id in 1..=BOARDS as u8 {
            let address = scan(&bus).await.expect("a board");
            found.push(address.serial_number);
            let answer = ask(&bus, lss::encode_configure_node_id(node_id)).await;
            assert_eq!(
                answer.and_then(|a| lss::decode_configure_node_id_response(&a)),
                Some(Ok(()))
            );
            assert!(ask(&bus, lss::encode_store()).await.is_some());
            assert_eq!(ask(&bus, lss::encode_switch_global(false)).await, None);
        }
        assert_eq!(scan(&bus).await, None, "all have a node-ID");

        found.sort_unstable();
        let mut expected: Vec<_> = (0..BOARDS).map(boards::serial_number).collect();
        expected.sort_unstable();
        assert_eq!(found, expected);
    });
}

/// The identity of a board that has no node-ID, which is in configuration state then.
async fn scan(bus: &TokioBus) -> Option<LssAddress> {
    let mut master = FastscanMaster::new();
    while let Some(mut request) = master.next_request() {
        if request[BIT_CHECK] == lss::FASTSCAN_INIT {
            assert_eq!(ask(bus, request).await, None);
            request[BIT_CHECK] = BEGIN;
        }
        let answer = ask(bus, request).await;
        master.on_response(answer.is_some_and(|answer| lss::is_identify_slave_response(&answer)));
    }
    master.found().then(|| master.address())
}

/// Sends a request, and returns the answer.
async fn ask(bus: &TokioBus, request: LssFrame) -> Option<LssFrame> {
    while bus.receive(Duration::ZERO).await.is_some() {}
    bus.send(Frame::data(Id::Standard(LSS_MASTER_COB_ID), &request)).await;
    let end = tokio::time::Instant::now() + TIMEOUT;
    loop {
        let frame = bus.receive(end.saturating_duration_since(tokio::time::Instant::now())).await?;
        if frame.id == Id::Standard(LSS_SLAVE_COB_ID) {
            return frame.payload().try_into().ok();
        }
    }
}
