//! The LSS chapter: the services of CiA 305 in both states, by raw frames. The certifier's tool has no such chapter.
//!
//! The cases ask for nothing that only one slave can know: the LSS addresses of the devices are in [`Target`], with what
//! the devices lack. The group `LSS further` is about what CiA 305 leaves open, and where its texts differ.

mod bit_rate;
mod fastscan;
mod frames;
mod further;
mod identify;
mod node_id;
mod several;
mod states;
mod store;

use std::{str::FromStr, time::Duration};

use canopen_node::{
    BitRate, Frame,
    lss::{Address, REQUEST_COB_ID, RESPONSE_COB_ID},
};

use crate::{Bench, Command, Group, Step, Stop, ms};

/// The groups of CiA 305.
pub const LSS: &[Group] = &[
    states::GROUP,
    identify::GROUP,
    fastscan::UNCONFIGURED,
    fastscan::GROUP,
    node_id::GROUP,
    bit_rate::GROUP,
    store::GROUP,
    frames::GROUP,
    several::GROUP,
    further::GROUP,
];

/// The devices on the line, as LSS sees them.
#[derive(Clone, Debug)]
pub struct Target {
    /// The LSS addresses; cases with one device take the first.
    pub devices: Vec<Address>,
    /// The bit rate that the devices have stored, and at which the line is.
    pub rate: BitRate,
    /// What the devices do not offer.
    pub without: Vec<Feature>,
    /// An SDO server has answered.
    has_sdo: bool,
    /// The bit rate of the line at present.
    now: BitRate,
    /// The time of the last request.
    last: Duration,
}

impl Target {
    pub fn new(devices: Vec<Address>, rate: BitRate, without: Vec<Feature>) -> Self {
        Self { devices, rate, without, has_sdo: false, now: rate, last: Duration::ZERO }
    }
}

/// No device.
impl Default for Target {
    fn default() -> Self {
        Self::new(Vec::new(), BitRate::Kbit125, Vec::new())
    }
}

/// What a device may lack: the cases that need it are skipped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Feature {
    /// Identify remote slave.
    Identify,
    /// Identify non-configured remote slave.
    NonConfigured,
    Fastscan,
    /// Configure bit timing.
    BitTiming,
    /// Activate bit timing.
    Activate,
    /// Store configuration.
    Store,
    /// An SDO server.
    Sdo,
    /// Automatic detection of the bit rate, table index 9.
    Detect,
    /// The search for the bit rate of others from a rate that no frame has proven.
    Rescue,
    /// The decisions in `LSS further`.
    Further,
}

impl Feature {
    /// All, with the words of the command line.
    pub const ALL: [(Self, &str); 10] = [
        (Self::Identify, "identify"),
        (Self::NonConfigured, "non-configured"),
        (Self::Fastscan, "fastscan"),
        (Self::BitTiming, "bit-timing"),
        (Self::Activate, "activate"),
        (Self::Store, "store"),
        (Self::Sdo, "sdo"),
        (Self::Detect, "detect"),
        (Self::Rescue, "rescue"),
        (Self::Further, "further"),
    ];
}

impl FromStr for Feature {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|(_, name)| *name == text);
        let names = || Self::ALL.map(|(_, name)| name).join(", ");
        found.map(|(feature, _)| feature).ok_or_else(|| format!("it is one of {}", names()))
    }
}

/// The wait for an answer; CiA 305 names none.
const PATIENCE: Duration = ms(1_000);
/// The wait for the answer to a store, which may erase flash, and for a boot-up.
const LONG_PATIENCE: Duration = ms(5_000);
/// The wait for an answer that must not come.
const QUIET: Duration = ms(50);
/// How often a device is asked whether it has an SDO server.
const SDO_ATTEMPTS: usize = 3;
/// The least time between two requests, but for the cases about requests without a pause.
const GAP: Duration = ms(5);
/// No answer.
const SILENCE: &[u8] = &[];
/// The node-ID FFh: none.
const NO_NODE_ID: u8 = 0xFF;

/// A request with a number.
fn with(command: u8, number: u32) -> [u8; 5] {
    let [a, b, c, d] = number.to_le_bytes();
    [command, a, b, c, d]
}

/// The bytes of a frame, filled up with zeros.
fn padded(bytes: &[u8]) -> [u8; 8] {
    let mut padded = [0; 8];
    padded[..bytes.len()].copy_from_slice(bytes);
    padded
}

/// The bytes of a request or an answer in a script.
fn bytes_of(text: &str, node: u8, address: Address) -> Vec<u8> {
    let mut bytes = Vec::new();
    for word in text.split(' ') {
        match word {
            "NN" => bytes.push(node),
            "MM" => bytes.push(other_id(node)),
            "V" => bytes.extend(address.vendor_id.to_le_bytes()),
            "P" => bytes.extend(address.product_code.to_le_bytes()),
            "R" => bytes.extend(address.revision_number.to_le_bytes()),
            "S" => bytes.extend(address.serial_number.to_le_bytes()),
            _ => bytes.push(u8::from_str_radix(word, 16).expect("two digits")),
        }
    }
    bytes
}

/// Another node-ID.
const fn other_id(node: u8) -> u8 {
    if node == 0x51 { 0x52 } else { 0x51 }
}

fn is_answer(frame: &Frame) -> bool {
    frame.cob_id() == RESPONSE_COB_ID
}

/// The bytes that count.
fn text(bytes: &[u8]) -> String {
    let texts: Vec<_> = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
    texts.join(" ")
}

impl Bench<'_> {
    /// Skips the case if the devices lack this.
    fn needs_feature(&self, feature: Feature) -> Step {
        match self.lss.without.contains(&feature) {
            true => {
                let (_, name) = Feature::ALL[feature as usize];
                self.skip(format!("the run is without {name}"))
            }
            false => Ok(()),
        }
    }

    /// Whether the device, which has the node-ID of the bench, has an SDO server: one that was found stays to be expected.
    fn has_sdo(&mut self) -> Step<bool> {
        for _ in 0..SDO_ATTEMPTS {
            if self.lss.has_sdo || self.lss.without.contains(&Feature::Sdo) {
                break;
            }
            self.send(0x600 + u16::from(self.node), &[0x40, 0, 0x10, 0, 0, 0, 0, 0])?;
            let cob_id = 0x580 + u16::from(self.node);
            let answer = self.wait_for(PATIENCE, |frame| frame.cob_id() == cob_id)?;
            self.lss.has_sdo = answer.is_some();
        }
        Ok(self.lss.has_sdo)
    }

    /// The LSS address of the device.
    fn address(&self) -> Step<Address> {
        match self.lss.devices.first() {
            Some(address) => Ok(*address),
            None => self.skip("no LSS address is given"),
        }
    }

    /// Puts the first `count` devices on the bus, and no others.
    fn attach(&mut self, count: usize) -> Step {
        let all = self.lss.devices.len();
        match self.lab("attach devices") {
            Ok(lab) if count <= all => lab.attach(count),
            Err(_) if count == all => {}
            _ => return self.skip(format!("devices needed on the bus: {count}, there: {all}")),
        }
        Ok(())
    }

    /// Joins the bus at another bit rate.
    fn set_rate(&mut self, rate: BitRate) -> Step {
        if self.lss.now != rate {
            self.open(rate)?;
            self.lss.now = rate;
            self.note(format!("the line is at {rate}"));
        }
        Ok(())
    }

    /// Sends an LSS request as soon as a slow device can take it: some lose one that follows too closely.
    fn request(&mut self, bytes: &[u8]) -> Step {
        self.pass((self.lss.last + GAP).saturating_sub(self.now()))?;
        self.request_at_once(bytes)
    }

    /// Sends an LSS request without a pause.
    fn request_at_once(&mut self, bytes: &[u8]) -> Step {
        self.lss.last = self.now();
        self.send(REQUEST_COB_ID, &padded(bytes))
    }

    /// Sends an LSS request; returns what answers it within `span`. Older frames are dropped.
    fn ask_lss(&mut self, bytes: &[u8], span: Duration) -> Step<Option<[u8; 8]>> {
        self.pass(Duration::ZERO)?;
        self.request(bytes)?;
        self.lss_answer(span)
    }

    /// The next LSS answer within `span`.
    fn lss_answer(&mut self, span: Duration) -> Step<Option<[u8; 8]>> {
        match self.wait_for(span, is_answer)? {
            None => Ok(None),
            Some((_, frame)) => match frame.data().try_into() {
                Ok(answer) => Ok(Some(answer)),
                Err(_) => self.fail("an LSS answer has eight bytes"),
            },
        }
    }

    fn quiet(&self) -> Duration {
        QUIET + 2 * self.jitter
    }

    /// Sends an LSS request and expects these bytes, the rest zeros, or [`SILENCE`].
    fn lss(&mut self, request: &[u8], expected: &[u8]) -> Step {
        let span = match (expected, request[0]) {
            (SILENCE, _) => self.quiet(),
            (_, 0x17) => LONG_PATIENCE,
            _ => PATIENCE,
        };
        match self.ask_lss(request, span)? {
            None => self.check(
                expected.is_empty(),
                format!("{} is answered {}", text(request), text(expected)),
            ),
            Some(_) if expected.is_empty() => {
                self.fail(format!("{} is not answered", text(request)))
            }
            Some(answer) => self.check(
                answer == padded(expected),
                format!("{} is answered {} and zeros", text(request), text(expected)),
            ),
        }
    }

    /// Plays a script of requests, answers and states, separated by semicolons:
    ///
    /// - `04 01`: a request;
    /// - `5E = 5E NN`: a request and its answer, whose other bytes are 0; `5E = -`: it is not answered;
    /// - `waiting`, `configuration`: the LSS state;
    /// - `reset communication`: the NMT command to all nodes;
    /// - `boot-up NN`.
    ///
    /// `NN` is the node-ID of the bench, `MM` another, `V`, `P`, `R` and `S` are the parts of the LSS address.
    fn play(&mut self, script: &str) -> Step {
        let address = self.address()?;
        for step in script.split(';').map(str::trim) {
            match step {
                "waiting" => self.expect_waiting()?,
                "configuration" => self.expect_configuring()?,
                "reset communication" => self.nmt_to(Command::ResetCommunication, 0)?,
                _ => {
                    let bytes = |text| bytes_of(text, self.node, address);
                    match (step.strip_prefix("boot-up "), step.split_once(" = ")) {
                        (Some(node), _) => self.boots_as(bytes(node)[0])?,
                        (_, Some((request, "-"))) => self.lss(&bytes(request), SILENCE)?,
                        (_, Some((request, answer))) => {
                            self.lss(&bytes(request), &bytes(answer))?
                        }
                        (None, None) => self.request(&bytes(step))?,
                    }
                }
            }
        }
        Ok(())
    }

    /// Sends an LSS request that must be refused: the second byte of the answer is not 0.
    fn refused(&mut self, request: &[u8]) -> Step {
        match self.ask_lss(request, PATIENCE)? {
            Some(answer) if answer[0] == request[0] && answer[1] != 0 => Ok(()),
            _ => self.fail(format!("{} is answered by an error", text(request))),
        }
    }

    /// Switches all devices to LSS configuration state.
    fn enter(&mut self) -> Step {
        self.request(&[0x04, 1])
    }

    /// Switches all devices to LSS waiting state.
    fn leave(&mut self) -> Step {
        self.request(&[0x04, 0])
    }

    /// The active node-ID; the device must be in LSS configuration state.
    fn inquire_node_id(&mut self) -> Step<u8> {
        match self.ask_lss(&[0x5E], PATIENCE)? {
            Some([0x5E, id, 0, 0, 0, 0, 0, 0]) => Ok(id),
            _ => self.fail("5E is answered 5E, the active node-ID and zeros"),
        }
    }

    /// Whether the device is in LSS configuration state: only then it answers 5E.
    fn is_configuring(&mut self) -> Step<bool> {
        let span = self.quiet();
        Ok(self.ask_lss(&[0x5E], span)?.is_some())
    }

    /// Reaches the device, which must have this active node-ID.
    fn expect_active(&mut self, id: u8) -> Step {
        let active = self.reach()?;
        self.check(active == id, format!("5E {id:02X}"))
    }

    fn expect_waiting(&mut self) -> Step {
        let is_configuring = self.is_configuring()?;
        self.check(!is_configuring, "LSS waiting state: 5E is not answered")
    }

    fn expect_configuring(&mut self) -> Step {
        let is_configuring = self.is_configuring()?;
        self.check(is_configuring, "LSS configuration state: 5E is answered")
    }

    /// Sends the four steps of a select; returns whether the last one is answered.
    fn select(&mut self, address: [u32; 4]) -> Step<bool> {
        self.pass(Duration::ZERO)?;
        for (command, number) in (0x40..).zip(address) {
            self.request(&with(command, number))?;
        }
        let span = self.quiet();
        match self.lss_answer(span)? {
            None => Ok(false),
            Some([0x44, 0, 0, 0, 0, 0, 0, 0]) => Ok(true),
            Some(_) => self.fail("a select is answered 44 and zeros"),
        }
    }

    /// Selects one of several devices.
    fn must_select(&mut self, address: Address) -> Step {
        self.leave()?;
        let is_selected = self.select(address.into())?;
        self.check(is_selected, "44: the device with this LSS address is selected")
    }

    /// Waits for the boot-up of this node.
    fn boots_as(&mut self, node: u8) -> Step {
        let cob_id = 0x700 + u16::from(node);
        let is_it =
            |frame: &Frame| (0x701..=0x77F).contains(&frame.cob_id()) && frame.data() == [0];
        match self.wait_for(LONG_PATIENCE, is_it)? {
            Some((_, frame)) if frame.cob_id() == cob_id => Ok(()),
            _ => self.fail(format!("{cob_id:03X} 00: the boot-up as node {node}")),
        }
    }

    /// Resets all nodes, which then have their stored values.
    fn restart(&mut self) -> Step {
        self.nmt_to(Command::ResetNode, 0)?;
        self.pass(ms(100) + self.jitter)
    }

    /// Brings the only device to LSS configuration state, at its bit rate if it can be found at another; returns its
    /// active node-ID. It may be starting.
    fn reach(&mut self) -> Step<u8> {
        self.set_rate(self.lss.rate)?;
        if let Some(id) = self.find(LONG_PATIENCE)? {
            return Ok(id);
        }
        let base = self.lss.rate;
        for rate in BitRate::ALL {
            self.set_rate(rate)?;
            if self.find(PATIENCE)?.is_some() {
                self.note("an earlier case has left the device at this rate");
                self.lss(&[0x13, 0, base.index()], &[0x13])?;
                self.ask_lss(&[0x17], LONG_PATIENCE)?;
                self.restart()?;
                break;
            }
        }
        self.set_rate(base)?;
        match self.find(LONG_PATIENCE)? {
            Some(id) => Ok(id),
            None => self.fail("the device answers 04 01, 5E"),
        }
    }

    /// Asks for the node-ID until an answer comes.
    fn find(&mut self, span: Duration) -> Step<Option<u8>> {
        let until = self.now() + span;
        while self.now() < until {
            self.leave()?;
            self.enter()?;
            if let Some([0x5E, id, ..]) = self.ask_lss(&[0x5E], ms(100) + self.jitter)? {
                return Ok(Some(id));
            }
        }
        Ok(None)
    }

    /// The only device with its stored values, as far as NMT reset node brings them back; in LSS configuration state.
    /// Returns its node-ID.
    fn begin_alone(&mut self) -> Step<u8> {
        self.address()?;
        self.attach(1)?;
        self.reach()?;
        self.leave()?;
        self.restart()?;
        self.reach()
    }
}

/// One device in LSS waiting state, which has the node-ID of the bench and has not stored it.
fn configured(bench: &mut Bench) -> Step {
    let active = bench.begin_alone()?;
    give_node_id(bench, active)
}

/// Makes the node-ID of the bench active; the device is in LSS configuration state.
fn give_node_id(bench: &mut Bench, active: u8) -> Step {
    let node = bench.node;
    bench.lss(&[0x11, node], &[0x11])?;
    bench.leave()?;
    if active == node {
        return Ok(());
    }
    if active != NO_NODE_ID {
        bench.nmt_to(Command::ResetCommunication, 0)?;
    }
    bench.pass(ms(100))?;
    bench.expect_active(node)?;
    bench.leave()
}

/// One device in LSS waiting state without a node-ID.
fn unconfigured(bench: &mut Bench) -> Step {
    let active = bench.begin_alone()?;
    bench.lss(&[0x11, NO_NODE_ID], &[0x11])?;
    bench.leave()?;
    if active != NO_NODE_ID {
        bench.nmt_to(Command::ResetCommunication, 0)?;
        bench.pass(ms(100))?;
    }
    bench.expect_active(NO_NODE_ID)?;
    bench.leave()
}

/// Runs `body`, then stores what was stored before.
fn with_stored_values(bench: &mut Bench, body: impl FnOnce(&mut Bench) -> Step) -> Step {
    bench.needs_feature(Feature::Store)?;
    let stored = bench.begin_alone()?;
    let outcome = body(bench);
    if let Err(Stop::Broken(_)) = outcome {
        return outcome;
    }
    bench.note("the values of before are stored again");
    bench.reach()?;
    bench.lss(&[0x11, stored], &[0x11])?;
    if !bench.lss.without.contains(&Feature::BitTiming) {
        bench.lss(&[0x13, 0, bench.lss.rate.index()], &[0x13])?;
    }
    bench.lss(&[0x17], &[0x17])?;
    bench.leave()?;
    outcome
}
