//! `cargo hil`: checks flashed boards through a CAN adapter (hardware in the loop), and reports.

mod bench;
mod board;
mod conformance;
mod diagnosis;
mod product;
mod report;
mod sessions;

use std::{
    io::{self, IsTerminal},
    path::{Path, PathBuf},
    process::ExitCode,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use anyhow::{Context, ensure};
use clap::{Parser, builder::PossibleValuesParser};

use can_bus::{adapter, address, bus, person, sdo, stop};
use canopen_node::{BitRate, NodeId};

use adapter::Place;
use bench::Bench;
use bus::Bus;
use conformance::{Identity, Subject};
use person::Person;
use product::Product;
use report::{Head, Report};
use stop::Stop;

/// Check flashed boards through a CAN adapter, and report
///
/// First it diagnoses the bench. Then it drives all boards of this firmware, or of another product, through every LSS
/// service, all bit rates, SDO, NMT and heartbeat, and compares what they do with the emulated board. In the end it stores their
/// original settings again, also after Ctrl-C and after an error. No other node may be on the bus.
///
/// It ends with 0 if nothing failed, with 1 otherwise. How to begin: docs/first-board.md.
#[derive(Parser)]
#[command(name = "cargo hil", bin_name = "cargo hil", version, verbatim_doc_comment, after_help = EXAMPLES)]
struct Arguments {
    /// The CAN adapter: `slcan:DEVICE[@BAUD]`, slcan:tcp:HOST:PORT, socketcan:INTERFACE; socketcan:INTERFACE@KBIT if
    /// the interface is up and its bit rate must stay
    #[arg(long, value_name = "ADAPTER")]
    adapter: Place,
    /// Leave out most bit rates and repetitions: about 20 s instead of 40 with one board
    #[arg(long)]
    quick: bool,
    /// Run only this session, and the first, which finds the boards; can be repeated
    #[arg(long, value_name = "NAME", value_parser = PossibleValuesParser::new(sessions::ALL.map(|session| session.name)))]
    session: Vec<String>,
    /// Write the report to FILE.txt, FILE.json and FILE.html
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// The time in ms that the adapter takes for a frame and its answer, if it is longer than the adapter itself
    /// reports
    #[arg(long, value_name = "MS", default_value_t = 2)]
    latency: u16,
    /// The data sheet of the boards, if they are those of another product; or --vendor-id with --product-code. What a
    /// session needs and the product lacks is skipped
    #[arg(long, value_name = "EDS", conflicts_with = "conformance")]
    eds: Option<PathBuf>,
    /// The chip of the boards, for the head of the report: no service tells it
    #[arg(long, value_name = "CHIP")]
    chip: Option<String>,
    /// Whether to ask for a power cut and a short circuit; by default if the standard input is a terminal
    #[arg(long, value_name = "WHETHER", value_enum, default_value = "auto")]
    ask: Ask,
    /// Run the cases of a conformance test of CANopen in place of the sessions, on any device with this data sheet:
    /// docs/conformance.md. Its stored parameters become the defaults. With `lss` in place of the data sheet: the
    /// cases of LSS, on any LSS slave
    #[arg(long, value_name = "EDS", conflicts_with_all = ["quick", "session"])]
    conformance: Option<Subject>,
    #[command(flatten)]
    identity: Identity,
    /// The node-ID of that device, if there are others on the bus; without it all nodes are reset
    #[arg(long, value_name = "ID", value_parser = address::node_id, requires = "conformance")]
    node: Option<NodeId>,
    /// The bit rate of that device in kbit/s
    #[arg(long, value_name = "KBIT", value_parser = adapter::bit_rate, default_value = "125", requires = "conformance")]
    bit_rate: BitRate,
    /// Run only the cases whose number begins so, such as "PDO 23" or PDO; can be repeated
    #[arg(long, value_name = "NUMBER", requires = "conformance")]
    case: Vec<String>,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Ask {
    Auto,
    Always,
    Never,
}

const EXAMPLES: &str = "Examples:
  cargo hil --adapter slcan:/dev/ttyACM0 --chip stm32f407 --report first-board
  cargo hil --adapter socketcan:can0 --quick
  cargo hil --adapter socketcan:can0 --eds ../lamp/lamp.eds
  cargo hil --adapter socketcan:can0 --conformance eds/io.eds --bit-rate 500 --report io
  cargo hil --adapter socketcan:can0 --conformance lss --vendor-id 0x1A2 --product-code 7 --without rescue,detect
  cargo hil --adapter slcan:tcp:127.0.0.1:29536      with `cargo emulate` in another window";

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match run(&arguments) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Runs the sessions and reports; returns whether nothing failed.
fn run(arguments: &Arguments) -> anyhow::Result<bool> {
    if let Some(path) = &arguments.report {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        ensure!(
            folder.is_none_or(Path::is_dir),
            "--report {}: there is no such folder",
            path.display()
        );
    }
    let is_interrupted = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&is_interrupted);
    ctrlc::set_handler(move || {
        if flag.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("Ctrl-C: restoring the boards; again to end at once");
    })
    .context("cannot wait for Ctrl-C")?;

    if let Some(subject) = &arguments.conformance {
        return conformance::run(&conformance::Test {
            adapter: &arguments.adapter,
            subject,
            identity: &arguments.identity,
            node: arguments.node,
            bit_rate: arguments.bit_rate,
            chip: arguments.chip.as_deref(),
            cases: &arguments.case,
            report: arguments.report.as_deref(),
            latency: Duration::from_millis(arguments.latency.into()),
            is_interrupted,
        });
    }

    let product = Product::new(arguments.eds.as_deref(), &arguments.identity)?;
    let adapter = arguments.adapter.to_string();
    let head = Head::new(product.to_string(), arguments.chip.as_deref(), adapter);
    let mut report = Report::new(head);
    report.begin("bench", "");
    let report = match arguments.adapter.connect() {
        Ok(adapter) => {
            report.head.adapter = adapter.description();
            report.bench(&format!("adapter: {}", adapter.description()));
            let is_asked = match arguments.ask {
                Ask::Auto => io::stdin().is_terminal(),
                Ask::Always => true,
                Ask::Never => false,
            };
            let person = if is_asked { Person::at_standard_input() } else { Person::absent() };
            let bus =
                Bus::new(adapter, Duration::from_millis(arguments.latency.into()), is_interrupted);
            let mut bench = Bench {
                base: bus.rate(),
                product,
                offered: Vec::new(),
                lacking: Vec::new(),
                detects: false,
                bus,
                report,
                person,
                is_quick: arguments.quick,
                boards: Vec::new(),
                addresses: Vec::new(),
                is_changed: false,
                is_lost: false,
            };
            let outcome = check(&mut bench, &arguments.session);
            bench.report.stopped = outcome.err().map(|stop| stop.to_string());
            if let Some(reason) = &bench.report.stopped {
                report::show(&format!("  STOP    {reason}"), report::INDENT);
            }
            bench.restore();
            bench.report
        }
        Err(stop) => {
            report.stopped = Some(stop.to_string());
            report
        }
    };
    report::show(&report.summary(), report::INDENT);
    if let Some(path) = &arguments.report {
        let files =
            report.write(path).with_context(|| format!("cannot write {}", path.display()))?;
        println!("Report: {}", files.map(|file| file.display().to_string()).join(", "));
    }
    Ok(report.is_good())
}

fn check(bench: &mut Bench, sessions: &[String]) -> Result<(), Stop> {
    diagnosis::find_rate(&mut bench.bus, &bench.product, &mut bench.report)?;
    sessions::run(bench, sessions)
}
