//! A session of zencan-client with the example `io`: SDO, block download, and PDOs.

use std::time::Duration;

use emulator::can::{Frame, Id};
use testkit::image_rig::{DEFAULT_BIT_RATE, example_board, settings};
use zencan_client::{
    RawAbortCode, SdoClient, SdoClientError,
    common::{CanId, pdo::PdoMapping, sdo::AbortCode},
};

use zencan_sessions::TokioBus;

const NODE_ID: u8 = 5;
const LEDS: PdoMapping = PdoMapping { index: 0x6200, sub: 1, size: 8 };
const TEMPERATURE: PdoMapping = PdoMapping { index: 0x6401, sub: 1, size: 16 };

#[test]
fn zencan_client_uses_objects_and_pdos_of_the_example() {
    zencan_sessions::run(async {
        let board = example_board(settings(NODE_ID, DEFAULT_BIT_RATE));
        let bus = TokioBus::new([board], DEFAULT_BIT_RATE);
        session(&bus).await.expect("all requests are answered");
    });
}

async fn session(bus: &TokioBus) -> Result<(), SdoClientError> {
    let mut client = SdoClient::new_std(NODE_ID, bus.clone(), bus.clone());
    assert_eq!(client.read_visible_string(0x1008, 0).await?, "LSS slave");
    client.write_u8(0x2100, 0, 8).await?;
    assert_eq!(client.read_u8(0x2100, 0).await?, 8);
    let Err(SdoClientError::ServerAbort { abort_code, .. }) = client.write_u8(0x2100, 0, 9).await
    else {
        panic!("9 is above the limit");
    };
    assert_eq!(abort_code, RawAbortCode::Valid(AbortCode::ValueTooHigh));
    client.block_download(0x6426, 1, &7_u32.to_le_bytes()).await?;
    assert_eq!(client.read_u32(0x6426, 1).await?, 7);

    let leds = client.read_rpdo_config(0).await?;
    assert_eq!((leds.comm.cob_id, leds.mappings), (CanId::std(0x205), vec![LEDS]));
    let mut inputs = client.read_tpdo_config(0).await?;
    inputs.comm.transmission_type = 1;
    inputs.mappings.push(TEMPERATURE);
    client.configure_tpdo(0, &inputs).await?;
    assert_eq!(client.read_tpdo_config(0).await?, inputs);

    let frame = |id, data: &[u8]| Frame::data(Id::Standard(id), data);
    bus.send(frame(0x000, &[1, NODE_ID])).await;
    bus.send(frame(0x205, &[3])).await;
    bus.pass(Duration::from_millis(20)).await;
    assert_eq!(client.read_u8(0x6200, 1).await?, 3);
    let temperature = client.read_i16(0x6401, 1).await?;
    while bus.receive(Duration::ZERO).await.is_some() {}
    bus.send(frame(0x080, &[])).await;
    let [low, high] = temperature.to_le_bytes();
    let answer = bus.receive(Duration::from_millis(10)).await;
    assert_eq!(answer, Some(frame(0x185, &[0, low, high])));
    Ok(())
}
