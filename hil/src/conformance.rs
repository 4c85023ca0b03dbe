//! `cargo hil --conformance`: the cases of a conformance test on a real device.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use ::conformance::{APPLICATION_LAYER, Bench, Broken, Line, Report, eds::Eds, ms};
use anyhow::{Context, bail};
use canopen_node::{BitRate, Frame, NodeId};

use crate::{
    adapter::{Adapter, Mode, Place},
    stop::Stop,
};

/// The wait for the boot-ups of all nodes.
const BOOT: Duration = ms(3_000);
/// The longest wait between two looks at Ctrl-C.
const SLICE: Duration = ms(50);
/// How late this computer may see a frame, besides the adapter's latency.
const PAUSE: Duration = ms(20);

/// What is tested, and how.
pub struct Test<'a> {
    pub adapter: &'a Place,
    /// The data sheet of the device.
    pub eds: &'a Path,
    /// The node-ID of the device; `None`: it is the only node.
    pub node: Option<NodeId>,
    pub bit_rate: BitRate,
    /// The beginnings of the numbers of the wanted cases; empty: all.
    pub cases: &'a [String],
    /// The files without their endings.
    pub report: Option<&'a Path>,
    pub latency: Duration,
    pub is_interrupted: Arc<AtomicBool>,
}

/// Runs the cases, prints their outcomes and writes the report; returns whether none failed.
///
/// # Errors
/// The adapter does not work, or there is no device.
pub fn run(test: &Test) -> anyhow::Result<bool> {
    let text = fs::read_to_string(test.eds);
    let text = text.with_context(|| format!("cannot read {}", test.eds.display()))?;
    let eds = Eds::parse(&text);
    let mut adapter = test.adapter.connect()?;
    adapter.open(adapter.fixed_rate().unwrap_or(test.bit_rate), Mode::Normal)?;
    let mut report = Report::new(format!("{} at {}", test.eds.display(), adapter.description()));
    let latency = adapter.latency().unwrap_or_default().max(test.latency);
    let is_interrupted = Arc::clone(&test.is_interrupted);
    let mut line = AdapterLine { adapter, latency, is_interrupted, start: Instant::now() };
    let node = match test.node {
        Some(node) => node.get(),
        None => only_node(&mut line)?,
    };
    println!("node {node}");
    let mut bench = Bench::new(&mut line, &eds, node);
    ::conformance::run(&mut bench, APPLICATION_LAYER, test.cases, &mut report, |finding| {
        println!("{}", finding.line());
    })?;
    println!("\n{}", report.summary());
    let is_good = report.failed() == 0;
    if let Some(path) = test.report {
        let reports = [report];
        let html = (path.with_extension("html"), ::conformance::html(&reports));
        let junit = (path.with_extension("xml"), ::conformance::junit(&reports));
        for (file, content) in [html, junit] {
            write(&file, &content)?;
        }
    }
    Ok(is_good)
}

fn write(file: &PathBuf, content: &str) -> anyhow::Result<()> {
    fs::write(file, content).with_context(|| format!("cannot write {}", file.display()))?;
    println!("Report: {}", file.display());
    Ok(())
}

/// Resets all nodes; returns the node-ID of the only one that boots up.
fn only_node(line: &mut AdapterLine) -> anyhow::Result<u8> {
    let reset = Frame::new(0x000, &[0x81, 0]).expect("two bytes");
    line.send(&reset)?;
    let until = line.now() + BOOT;
    let mut nodes = Vec::new();
    while let Some((_, frame)) = line.receive(until)? {
        if (0x701..=0x77F).contains(&frame.cob_id()) && frame.data() == [0] {
            nodes.push((frame.cob_id() & 0x7F) as u8);
        }
    }
    match nodes[..] {
        [node] => Ok(node),
        [] => bail!("no node boots up: has it a node-ID, and is --bit-rate right?"),
        _ => bail!("the nodes {nodes:?} boot up: which is to be tested, --node N?"),
    }
}

/// An adapter as the cases see it, on the computer's clock.
struct AdapterLine {
    adapter: Box<dyn Adapter>,
    latency: Duration,
    is_interrupted: Arc<AtomicBool>,
    start: Instant,
}

impl From<Stop> for Broken {
    fn from(stop: Stop) -> Self {
        Self(stop.to_string())
    }
}

impl Line for AdapterLine {
    fn now(&self) -> Duration {
        self.start.elapsed()
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Broken> {
        Ok(self.adapter.send(frame)?)
    }

    fn receive(&mut self, until: Duration) -> Result<Option<(Duration, Frame)>, Broken> {
        loop {
            if self.is_interrupted.load(Ordering::Relaxed) {
                return Err(Stop::Interrupted.into());
            }
            let wait = until.saturating_sub(self.now()).min(SLICE);
            if let Some(received) = self.adapter.receive(wait)? {
                let time = received.here.saturating_duration_since(self.start);
                return Ok(Some((time, received.frame)));
            }
            if self.now() >= until {
                return Ok(None);
            }
        }
    }

    fn jitter(&self) -> Duration {
        self.latency + PAUSE
    }

    fn set_bit_rate(&mut self, rate: BitRate) -> Result<bool, Broken> {
        if self.adapter.fixed_rate().is_some() {
            return Ok(false);
        }
        self.adapter.open(rate, Mode::Normal)?;
        Ok(true)
    }
}
