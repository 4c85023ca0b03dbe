//! `cargo hil --conformance`: the cases of a conformance test on a real device.

use std::{
    fs,
    path::{Path, PathBuf},
    str::FromStr,
    sync::{Arc, atomic::AtomicBool},
    time::Duration,
};

use ::conformance::{
    APPLICATION_LAYER, Bench, Command, Group, Line, OWN, Report,
    eds::Eds,
    lss::{Feature, LSS, Target},
    ms,
};
use anyhow::{Context, bail, ensure};
use can_bus::address::number;
use canopen_node::{
    BitRate, NodeId,
    lss::{Address, REQUEST_COB_ID, RESPONSE_COB_ID},
};

use crate::{
    adapter::{Mode, Place},
    report::{Head, show},
};

/// The wait for the boot-ups of all nodes.
const BOOT: Duration = ms(3_000);
/// The column of the purpose of a case.
const PURPOSE: usize = 38;
/// How late this computer may see a frame, besides the adapter's latency.
const PAUSE: Duration = ms(20);

/// The node-ID that the device gets for the LSS chapter, unless another is given.
const LSS_NODE: u8 = 5;
/// The wait for an answer to an inquiry.
const INQUIRY: Duration = ms(1_000);

/// The cases to run.
#[derive(Clone, Debug)]
pub enum Subject {
    /// CiA 301, with this data sheet.
    ApplicationLayer(PathBuf),
    Lss,
}

impl FromStr for Subject {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(if text == "lss" { Self::Lss } else { Self::ApplicationLayer(text.into()) })
    }
}

/// What is known of the devices, for the LSS chapter and for boards without a data sheet.
#[derive(Clone, Debug, clap::Args)]
pub struct Identity {
    /// The vendor-ID of the device; what is not given of its LSS address is inquired for the LSS chapter
    #[arg(long, value_name = "NUMBER", value_parser = number, conflicts_with = "eds")]
    pub vendor_id: Option<u32>,
    /// Its product code
    #[arg(long, value_name = "NUMBER", value_parser = number, conflicts_with = "eds")]
    pub product_code: Option<u32>,
    /// Its revision number
    #[arg(long, value_name = "NUMBER", value_parser = number, requires = "conformance")]
    revision_number: Option<u32>,
    /// Its serial number; several devices of one product on the bus are tested together
    #[arg(long, value_name = "NUMBER", value_parser = number, value_delimiter = ',', requires = "conformance")]
    serial_number: Vec<u32>,
    /// What the device lacks, for the LSS chapter: identify, non-configured, fastscan, bit-timing, activate, store, sdo,
    /// detect, rescue, further; the sessions look at rescue
    #[arg(long, value_name = "FEATURE", value_delimiter = ',')]
    pub without: Vec<Feature>,
}

/// What is tested, and how.
pub struct Test<'a> {
    pub adapter: &'a Place,
    pub subject: &'a Subject,
    pub identity: &'a Identity,
    /// The node-ID of the device; `None`: it is the only node.
    pub node: Option<NodeId>,
    pub bit_rate: BitRate,
    pub chip: Option<&'a str>,
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
    let (eds, chapters, name): (_, &[(&[Group], &str)], _) = match test.subject {
        Subject::Lss => (Eds::default(), &[(LSS, "")], "LSS".to_owned()),
        Subject::ApplicationLayer(path) => {
            let eds = Eds::read(path).map_err(anyhow::Error::msg)?;
            let chapters = &[(APPLICATION_LAYER, ""), (OWN, ", our own cases")];
            (eds, chapters, path.display().to_string())
        }
    };
    let mut adapter = test.adapter.connect()?;
    let bit_rate = adapter.fixed_rate().unwrap_or(test.bit_rate);
    adapter.open(bit_rate, Mode::Normal)?;
    let description = adapter.description();
    let latency = adapter.latency().unwrap_or_default().max(test.latency);
    let node = test.node.map_or(LSS_NODE, NodeId::get);
    let mut bench = Bench::new(Line::Adapter(&mut *adapter), &eds, node);
    bench.jitter = latency + PAUSE;
    bench.is_interrupted = Arc::clone(&test.is_interrupted);
    match test.subject {
        Subject::Lss => {
            let devices = addresses(&mut bench, test.identity)?;
            bench.lss = Target::new(devices, bit_rate, test.identity.without.clone());
        }
        Subject::ApplicationLayer(_) if test.node.is_none() => bench.node = only_node(&mut bench)?,
        Subject::ApplicationLayer(_) => {}
    }
    println!("node {}", bench.node);
    let product = match test.subject {
        Subject::Lss => {
            let devices: Vec<_> = bench.lss.devices.iter().map(Address::to_string).collect();
            format!("LSS address {}", devices.join(", "))
        }
        Subject::ApplicationLayer(path) => format!("node {}, by {}", bench.node, path.display()),
    };
    let head = Head::new(product, test.chip, description);
    let mut reports = Vec::new();
    let has_case = |(groups, _): &&(&[Group], &str)| ::conformance::has_case(groups, test.cases);
    for (groups, suffix) in chapters.iter().filter(has_case) {
        let mut report = Report::new(format!("{name} at {}{suffix}", head.adapter));
        report.head = head.lines().map(|(name, value)| (name, value.to_owned())).to_vec();
        ::conformance::run(&mut bench, groups, test.cases, &mut report, |finding| {
            show(&finding.line(), PURPOSE);
        })?;
        show(&format!("\n{}", report.summary()), 0);
        reports.push(report);
    }
    ensure!(!reports.is_empty(), "no case begins with {}", test.cases.join(" or "));
    let is_good = reports.iter().all(|report| report.failed() == 0);
    if let Some(path) = test.report {
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
fn only_node(bench: &mut Bench) -> anyhow::Result<u8> {
    bench.nmt_to(Command::ResetNode, 0)?;
    let until = bench.now() + BOOT;
    let mut nodes = Vec::new();
    while let Some((_, frame)) = bench.receive(until)? {
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

/// The LSS addresses of the devices. What is not given is inquired, of the only device.
fn addresses(bench: &mut Bench, known: &Identity) -> anyhow::Result<Vec<Address>> {
    let [first, ..] = known.serial_number[..] else {
        return Ok(vec![inquired(bench, known, None)?]);
    };
    let address = match (known.vendor_id, known.product_code, known.revision_number) {
        (Some(vendor_id), Some(product_code), Some(revision_number)) => {
            Address { vendor_id, product_code, revision_number, serial_number: first }
        }
        _ => inquired(bench, known, Some(first))?,
    };
    let serial_numbers = known.serial_number.iter();
    Ok(serial_numbers.map(|number| Address { serial_number: *number, ..address }).collect())
}

/// The LSS address of the only device, which must agree with what is known.
fn inquired(
    bench: &mut Bench,
    known: &Identity,
    serial_number: Option<u32>,
) -> anyhow::Result<Address> {
    let request = |bench: &mut Bench, command, mode| {
        bench.send(REQUEST_COB_ID, &[command, mode, 0, 0, 0, 0, 0, 0])
    };
    request(bench, 0x04, 1)?;
    // Some devices lose a request that follows too closely.
    bench.pass(ms(50))?;
    let known = [known.vendor_id, known.product_code, known.revision_number, serial_number];
    let mut address = [0; 4];
    for ((part, known), command) in address.iter_mut().zip(known).zip(0x5A..) {
        request(bench, command, 0)?;
        let answer = bench.wait_for(INQUIRY, |frame| {
            frame.cob_id() == RESPONSE_COB_ID
                && frame.data().len() >= 5
                && frame.data()[0] == command
        })?;
        let bytes = answer.map(|(_, frame)| frame.padded_data());
        let number = bytes.map(|[_, a, b, c, d, ..]| u32::from_le_bytes([a, b, c, d])).or(known);
        *part = number.with_context(|| format!("{command:02X} is not answered"))?;
        ensure!(
            known.is_none_or(|known| known == *part),
            "{command:02X} is answered {part:08X}h, not {:08X}h",
            known.unwrap_or_default()
        );
    }
    request(bench, 0x04, 0)?;
    Ok(address.into())
}
