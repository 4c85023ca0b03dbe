//! `cargo demo`: an LSS master configures emulated boards with the release firmware.

mod arguments;
mod diagram;
mod record;
mod screen;

use std::{
    env,
    fs::{self, File},
    io::{self, Write},
    path::Path,
    process::ExitCode,
    time::Instant,
};

use anstyle::{AnsiColor, Style};
use anyhow::{Context, bail, ensure};
use emulator::{
    Time,
    network::{Event, What},
};
use lss_master::Fastscan;
use lss_slave::{
    BitRate,
    lss::{Address, Request},
};
use testkit::{
    boards::{self, FIRST_START},
    frames,
    image_rig::{DEFAULT_BIT_RATE, ImageRig, SETTINGS_OFFSET, flash_with, settings},
    sessions,
};

use arguments::{Arguments, HELP};
use screen::Screen;

const ERROR: Style = AnsiColor::Red.on_default().bold();
const OLD_RATE: BitRate = DEFAULT_BIT_RATE;
const NEW_RATE: BitRate = BitRate::Kbit500;
const SWITCH_DELAY_MS: u16 = 100;
/// The time after the second switch delay until every slave's clock has reached it too.
const TOLERANCE: Time = Time::from_ms(10);
/// The time from the reception of a frame to its record.
const TO_THE_END: Time = Time::from_us(100);

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
    let arguments = match Arguments::parse(env::args_os().skip(1)) {
        Ok(Some(arguments)) => arguments,
        Ok(None) => {
            // Whoever closes the pipe has read enough.
            let _ = io::stdout().write_all(HELP.as_bytes());
            return ExitCode::SUCCESS;
        }
        Err(error) => {
            anstream::eprintln!("{ERROR}error:{ERROR:#} {error:#}");
            return ExitCode::from(2);
        }
    };
    match run(&arguments) {
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
    old.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(9, OLD_RATE)]));
    let mut rig = ImageRig::new(OLD_RATE, [blank, old]);
    let outcome = sessions::outcome(|| session(&mut rig, &mut screen));
    // Show the events up to the failure.
    let events = rig.network.trace();
    screen.show(events)?;
    outcome??;
    arguments.write_records(events)?;
    screen.chapter(&format!(
        "As expected: {:.1} s on the board, {:.1} s here.",
        rig.network.now().as_ms() as f64 / 1000.0,
        begin.elapsed().as_secs_f64()
    ))
}

fn session(rig: &mut ImageRig, screen: &mut Screen) -> anyhow::Result<()> {
    screen.chapter(
        "Two boards are switched on at 125 kbit/s: node 9, and a blank one, which is silent",
    )?;
    rig.network.run_until(FIRST_START);
    expect(rig, screen, &["709: 00"])?;
    let sent = rig.did(0, Time::ZERO).filter(|event| matches!(event.what, What::Frame { .. }));
    ensure!(sent.count() == 0, "a board without a node-ID sent a frame unasked");

    screen.chapter("The master finds it by Fastscan: 128 bits of LSS address, one by one")?;
    let found = rig.carry_out(Fastscan::new()).context("all nodes have a node-ID")?;
    let Address { vendor_id, product_code, revision_number, serial_number } = found;
    expect(rig, screen, &[])?;
    screen.remark(&format!(
        "found: vendor-ID {vendor_id:08X}, product code {product_code:08X}, revision number \
         {revision_number:08X}, serial number {serial_number:08X}"
    ))?;
    let expected = boards::serial_number(0);
    ensure!(serial_number == expected, "the serial number of the chip is {expected:08X}");

    screen.chapter("It gets a node-ID; both boards get a bit rate, and store")?;
    for request in [
        Request::ConfigureNodeId(5),
        Request::SwitchToConfiguration,
        Request::ConfigureBitTiming { table: 0, index: NEW_RATE.index() },
        Request::StoreConfiguration,
    ] {
        rig.carry_out(request);
    }
    expect(rig, screen, &[])?;

    screen
        .chapter("All switch to 500 kbit/s, after the switch delay and in silence for another")?;
    rig.carry_out(Request::ActivateBitTiming(SWITCH_DELAY_MS));
    let delay = Time::from_ms(SWITCH_DELAY_MS.into());
    rig.network.run_for(delay);
    rig.set_master_bit_rate(NEW_RATE);
    rig.network.run_for(delay + TOLERANCE);
    expect(rig, screen, &[])?;

    screen.chapter("Back to LSS waiting state: the new board takes its node-ID and boots up")?;
    rig.carry_out(Request::SwitchToWaiting);
    expect(rig, screen, &["705: 00"])?;

    screen.chapter("The power fails for half a second: node-ID and bit rate were stored")?;
    rig.network.power_off(0);
    rig.network.run_for(Time::from_ms(500));
    rig.network.power_on(0);
    expect(rig, screen, &["705: 00", "705: 7F"])?;
    let errors = rig.network.trace().iter().find(|event| matches!(event.what, What::Error { .. }));
    errors.map_or(Ok(()), |event| bail!("{event}"))
}

/// Expects these frames and no others, and shows what has happened.
fn expect(rig: &mut ImageRig, screen: &mut Screen, expected: &[&str]) -> anyhow::Result<()> {
    for expected in expected {
        let received = rig.wait_for(FIRST_START, |_| true);
        let (_, frame) = received.with_context(|| format!("{expected} is missing"))?;
        ensure!(frame == frames::of_node(expected), "{frame:?} came instead of {expected}");
    }
    rig.network.run_for(TO_THE_END);
    screen.show(rig.network.trace())
}

/// Whether the reader of the output, such as `head`, has closed it.
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.downcast_ref::<io::Error>().is_some_and(|error| error.kind() == io::ErrorKind::BrokenPipe)
}
