//! `cargo demo`: an LSS master configures emulated boards with the release firmware.

mod diagram;
mod master;
mod record;
mod screen;

use std::{
    fs::{self, File},
    io,
    path::{Path, PathBuf},
    process::ExitCode,
    time::Instant,
};

use anstyle::{AnsiColor, Style};
use anyhow::{Context, bail, ensure};
use clap::Parser;
use emulator::{
    Time,
    board::Board,
    can::{Frame, Id},
    chip::Part,
    network::{Event, Source, What},
};
use lss_master::Fastscan;
use lss_slave::{
    BitRate, BitRateSetting, NodeId, Settings,
    lss::{Address, Request},
};
use testkit::{
    boards::{self, FIRST_START},
    image_rig::{DEFAULT_BIT_RATE, SETTINGS_OFFSET, flash_with},
};

use master::Master;
use screen::Screen;

const ERROR: Style = AnsiColor::Red.on_default().bold();
const OLD_RATE: BitRate = DEFAULT_BIT_RATE;
const NEW_RATE: BitRate = BitRate::Kbit500;
const NODE_ID: u8 = 5;
const SWITCH_DELAY_MS: u16 = 100;
/// The time after the second switch delay until every slave's clock has reached it too.
const TOLERANCE: Time = Time::from_ms(10);
const OLD_BOARD_ID: u8 = 9;
/// The settings stored in the second board before the demo.
const OLD_BOARD: Settings =
    Settings::new(BitRateSetting::Fixed(OLD_RATE)).with_node_id(NodeId::new(OLD_BOARD_ID));
const PRE_OPERATIONAL: u8 = 0x7F;

/// Show how a board is found, configured and power-cycled, frame by frame, on an emulated CAN bus
///
/// The boards are emulated STM32F4s with the release firmware, one of them blank. Fails if anything differs from
/// CiA 305.
#[derive(Parser)]
#[command(name = "cargo demo", bin_name = "cargo demo", verbatim_doc_comment)]
struct Arguments {
    /// Show every frame of the Fastscan, not only the start and end of its parts
    #[arg(long)]
    all: bool,
    /// The chip on the boards, such as stm32f446; the README lists them all
    #[arg(long, default_value = "stm32f405")]
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
    /// Checks before the session that its records can be written. A file that is there keeps its content.
    fn check_records(&self) -> anyhow::Result<()> {
        for path in [&self.candump, &self.pcap, &self.svg].into_iter().flatten() {
            let file = File::options().append(true).create(true).open(path);
            file.with_context(|| cannot_write(path))?;
        }
        Ok(())
    }

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
            fs::write(path, content).with_context(|| cannot_write(path))?;
        }
        Ok(())
    }
}

fn cannot_write(path: &Path) -> String {
    format!("cannot write {}", path.display())
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            anstream::eprintln!("{ERROR}error:{ERROR:#} {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Builds the firmware, runs the session and prints it.
fn run(arguments: &Arguments) -> anyhow::Result<()> {
    arguments.check_records()?;
    let image = testkit::image::build(arguments.chip)?;
    let begin = Instant::now();
    let mut screen = Screen::new(arguments.all);
    let [blank, mut old] = [0, 1].map(|number| boards::board(arguments.chip, &image, number));
    old.set_flash(SETTINGS_OFFSET, &flash_with(&[OLD_BOARD]));
    let mut master = Master::new([blank, old], OLD_RATE);
    let outcome = session(&mut master, &mut screen);
    let network = &master.network;
    // Show the events up to the failure.
    screen.show(network.trace())?;
    outcome?;
    arguments.write_records(network.trace())?;
    screen.chapter(&format!(
        "As expected: {:.1} s on the board, {:.1} s here.",
        network.now().as_ms() as f64 / 1000.0,
        begin.elapsed().as_secs_f64()
    ))
}

fn session(master: &mut Master, screen: &mut Screen) -> anyhow::Result<()> {
    screen.chapter(
        "Two boards are switched on at 125 kbit/s: node 9, and a blank one, which is silent",
    )?;
    master.pass(FIRST_START);
    let sent = master.network.trace().iter().filter(|event| is_frame_of_blank_board(event)).count();
    ensure!(sent == 0, "a board without a node-ID sent {sent} frames unasked");
    expect(master, error_control(OLD_BOARD_ID, 0), FIRST_START)?;
    screen.show(master.network.trace())?;

    screen.chapter("The master finds it by Fastscan: 128 bits of LSS address, one by one")?;
    let found = master.carry_out(Fastscan::new())?.context("all nodes have a node-ID")?;
    let Address { vendor_id, product_code, revision_number, serial_number } = found;
    screen.show(master.network.trace())?;
    screen.remark(&format!(
        "found: vendor-ID {vendor_id:08X}, product code {product_code:08X}, revision number \
         {revision_number:08X}, serial number {serial_number:08X}"
    ))?;
    let expected = boards::serial_number(0);
    ensure!(serial_number == expected, "the serial number of the chip is {expected:08X}");

    screen.chapter("It gets a node-ID; both boards get a bit rate, and store")?;
    master.carry_out(Request::ConfigureNodeId(NODE_ID))?;
    master.carry_out(Request::SwitchToConfiguration)?;
    master.carry_out(Request::ConfigureBitTiming { table: 0, index: NEW_RATE.index() })?;
    master.carry_out(Request::StoreConfiguration)?;
    screen.show(master.network.trace())?;

    screen
        .chapter("All switch to 500 kbit/s, after the switch delay and in silence for another")?;
    master.carry_out(Request::ActivateBitTiming(SWITCH_DELAY_MS))?;
    let delay = Time::from_ms(SWITCH_DELAY_MS.into());
    master.pass(delay);
    master.set_bit_rate(NEW_RATE);
    master.pass(delay + TOLERANCE);
    screen.show(master.network.trace())?;

    screen.chapter("Back to LSS waiting state: the new board takes its node-ID and boots up")?;
    master.carry_out(Request::SwitchToWaiting)?;
    expect(master, error_control(NODE_ID, 0), FIRST_START)?;
    screen.show(master.network.trace())?;

    screen.chapter("The power fails for half a second: node-ID and bit rate were stored")?;
    master.network.power_off(0);
    master.pass(Time::from_ms(500));
    master.network.power_on(0);
    expect(master, error_control(NODE_ID, 0), FIRST_START)?;
    expect(master, error_control(NODE_ID, PRE_OPERATIONAL), Time::from_s(2))?;
    screen.show(master.network.trace())?;
    check_conduct(master)
}

fn expect(master: &mut Master, expected: Frame, timeout: Time) -> anyhow::Result<()> {
    let frame = master.receive(timeout).with_context(|| format!("{expected} is missing"))?;
    ensure!(frame == expected, "{frame} came instead of {expected}");
    Ok(())
}

fn error_control(node_id: u8, state: u8) -> Frame {
    Frame::data(Id::Standard(0x700 + u16::from(node_id)), &[state])
}

/// Checks that nothing unexpected happened.
fn check_conduct(master: &Master) -> anyhow::Result<()> {
    for event in master.network.trace() {
        if let What::Error { kind, .. } = event.what {
            bail!("an error frame, {kind:?}, at {} ms", event.time);
        }
    }
    match master.network.boards().iter().flat_map(Board::findings).next() {
        Some(finding) => {
            bail!("the firmware did something that a real chip does not tolerate: {finding}")
        }
        None => Ok(()),
    }
}

fn is_frame_of_blank_board(event: &Event) -> bool {
    matches!((event.source, &event.what), (Source::Board(0), What::Frame { .. }))
}

/// Whether the reader of the output, such as `head`, has closed it.
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.downcast_ref::<io::Error>().is_some_and(|error| error.kind() == io::ErrorKind::BrokenPipe)
}
