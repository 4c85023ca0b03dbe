//! `cargo demo`: an independent LSS master configures emulated boards with the release firmware.

mod diagram;
#[cfg(test)]
mod example;
mod screen;
mod tokio_bus;

use std::{
    fs,
    path::PathBuf,
    time::{Duration, Instant},
};

use anyhow::{Context, bail, ensure};
use emulator::{
    Time,
    can::{Frame, Id},
    chip::Part,
    network::{Event, Source, What},
};
use lss_slave::{
    BitRate, BitRateSetting, Settings,
    lss::{self, Request},
};
use testkit::image_rig::{DEFAULT_BIT_RATE, SETTINGS_OFFSET, flash_with};
use zencan_client::{
    LssMaster,
    common::{
        NodeId,
        lss::{LssIdentity, LssState},
    },
};

use crate::{boards, record};
use screen::Screen;
use tokio_bus::TokioBus;

const OLD_RATE: BitRate = DEFAULT_BIT_RATE;
const NEW_RATE: BitRate = BitRate::Kbit500;
const NODE_ID: u8 = 5;
const SWITCH_DELAY_MS: u16 = 100;
const START: Duration = Duration::from_millis(boards::FIRST_START.as_ms());
/// The master's time-out for each Fastscan step.
const FASTSCAN_TIMEOUT: Duration = Duration::from_millis(20);
/// The time after the second switch delay until every slave's clock has reached it too.
const TOLERANCE: Duration = Duration::from_millis(10);
const OLD_BOARD_ID: u8 = 9;
/// The settings stored in the second board before the demo.
const OLD_BOARD: Settings = Settings::new(BitRateSetting::Fixed(OLD_RATE))
    .with_node_id(lss_slave::NodeId::new(OLD_BOARD_ID));
const PRE_OPERATIONAL: u8 = 0x7F;

/// Show how a board is found, configured and power-cycled, frame by frame, on an emulated CAN bus
///
/// The boards are emulated STM32F4s with the release firmware, one of them blank. The LSS master is the crate
/// zencan-client. Fails if anything differs from CiA 305.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Show every frame of the Fastscan, not only the start and end of its parts
    #[arg(long)]
    all: bool,
    /// The chip on the board
    #[arg(long, default_value = "stm32f405", value_parser = boards::part())]
    chip: Part,
    /// Draw the switch of the bit rate as a timing diagram
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Write the frames as `candump -l` does
    #[arg(long, value_name = "FILE")]
    candump: Option<PathBuf>,
    /// Write the frames as a capture for Wireshark. To see CANopen: Decode As, CAN next level, or
    /// `tshark -d can.subdissector,canopen`
    #[arg(long, value_name = "FILE")]
    pcap: Option<PathBuf>,
}

impl Arguments {
    fn write_records(&self, events: &[Event]) -> anyhow::Result<()> {
        let mut files = Vec::new();
        if let Some(path) = &self.candump {
            files.push((path, record::candump(events).into_bytes()));
        }
        if let Some(path) = &self.pcap {
            files.push((path, record::pcap(events)));
        }
        if let Some(path) = &self.svg {
            files.push((path, diagram::draw(events)?.into_bytes()));
        }
        for (path, content) in files {
            fs::write(path, content).with_context(|| format!("cannot write {}", path.display()))?;
        }
        Ok(())
    }
}

/// Builds the firmware, runs the session and prints it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let image = testkit::image::build(arguments.chip)?;
    let begin = Instant::now();
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build()?;
    let mut screen = Screen::new(arguments.all);
    runtime.block_on(async {
        let [blank, mut old] = [0, 1].map(|number| boards::board(arguments.chip, &image, number));
        old.set_flash(SETTINGS_OFFSET, &flash_with(&[OLD_BOARD]));
        let bus = TokioBus::new([blank, old], OLD_RATE);
        let outcome = session(&bus, &mut screen).await;
        // Show the events up to the failure.
        screen.show(&bus.events())?;
        outcome?;
        arguments.write_records(&bus.events())?;
        screen.chapter(&format!(
            "As expected: {:.1} s on the board, {:.1} s here.",
            bus.now().as_ms() as f64 / 1000.0,
            begin.elapsed().as_secs_f64()
        ))
    })
}

async fn session(bus: &TokioBus, screen: &mut Screen) -> anyhow::Result<()> {
    let mut master = LssMaster::new(bus.clone(), bus.clone());

    screen.chapter(
        "Two boards are switched on at 125 kbit/s: node 9, and a blank one, which is silent",
    )?;
    bus.pass(START).await;
    let sent = bus.events().iter().filter(|event| is_frame_of_blank_board(event)).count();
    ensure!(sent == 0, "a board without a node-ID sent {sent} frames unasked");
    expect_boot_up(bus, OLD_BOARD_ID).await?;
    screen.show(&bus.events())?;

    screen.chapter("The master finds it by Fastscan: 128 bits of LSS address, one by one")?;
    let found = master.fast_scan(FASTSCAN_TIMEOUT).await;
    let LssIdentity { vendor_id, product_code, revision, serial } =
        found.context("Fastscan found no board")?;
    screen.show(&bus.events())?;
    screen.remark(&format!(
        "found: vendor-ID {vendor_id:08X}, product code {product_code:08X}, revision number \
         {revision:08X}, serial number {serial:08X}"
    ))?;
    let expected = boards::serial_number(0);
    ensure!(serial == expected, "the serial number of the chip is {expected:08X}");

    screen.chapter("It gets a node-ID; both boards get a bit rate, and store")?;
    let node_id = NodeId::new(NODE_ID).context("1 to 127 is a node-ID")?;
    master.set_node_id(node_id).await.context("configure node-ID")?;
    master.set_global_mode(LssState::Configuring).await;
    master.set_baud_rate(0, NEW_RATE.index()).await.context("configure bit timing")?;
    master.store_config().await.context("store configuration")?;
    screen.show(&bus.events())?;

    screen.chapter("All switch to 500 kbit/s; zencan has no such service: the demo sends it")?;
    bus.send(lss_request(Request::ActivateBitTiming(SWITCH_DELAY_MS))).await;
    let delay = Duration::from_millis(SWITCH_DELAY_MS.into());
    bus.pass(delay).await;
    bus.set_bit_rate(NEW_RATE);
    bus.pass(delay + TOLERANCE).await;
    screen.show(&bus.events())?;

    screen.chapter("Back to LSS waiting state: the new board takes its node-ID and boots up")?;
    while bus.receive(Duration::ZERO).await.is_some() {}
    master.set_global_mode(LssState::Waiting).await;
    expect_boot_up(bus, NODE_ID).await?;
    screen.show(&bus.events())?;

    screen.chapter("The power fails for half a second: node-ID and bit rate were stored")?;
    bus.power_off();
    bus.pass(Duration::from_millis(500)).await;
    bus.power_on();
    expect_boot_up(bus, NODE_ID).await?;
    let heartbeat = bus.receive(Duration::from_secs(2)).await.context("no heartbeat came")?;
    ensure!(
        heartbeat == error_control(NODE_ID, PRE_OPERATIONAL),
        "{heartbeat} came instead of a heartbeat"
    );
    screen.show(&bus.events())?;
    check_conduct(bus)
}

async fn expect_boot_up(bus: &TokioBus, node_id: u8) -> anyhow::Result<()> {
    let boot_up = bus.receive(START).await.context("no boot-up came")?;
    ensure!(
        boot_up == error_control(node_id, 0),
        "{boot_up} came instead of the boot-up of node {node_id}"
    );
    Ok(())
}

fn error_control(node_id: u8, state: u8) -> Frame {
    Frame::data(Id::Standard(0x700 + u16::from(node_id)), &[state])
}

/// Checks that nothing unexpected happened.
fn check_conduct(bus: &TokioBus) -> anyhow::Result<()> {
    for event in bus.events() {
        if let What::Error { kind, .. } = event.what {
            bail!("an error frame, {kind:?}, at {} ms", event.time);
        }
    }
    match bus.findings().first() {
        Some(finding) => {
            bail!("the firmware did something that a real chip does not tolerate: {finding}")
        }
        None => Ok(()),
    }
}

fn is_frame_of_blank_board(event: &Event) -> bool {
    matches!((event.source, &event.what), (Source::Board(0), What::Frame { .. }))
}

fn lss_request(request: Request) -> Frame {
    Frame::data(Id::Standard(lss::REQUEST_COB_ID), &request.to_bytes())
}

/// Converts a duration of tokio's clock to the emulation's.
fn span(duration: Duration) -> Time {
    Time::from_ns(duration.as_nanos() as u64)
}
