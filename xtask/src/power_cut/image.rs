//! Power cuts in the release image on an emulated board: in every flash operation of a commissioning by LSS, in every
//! pause between two of them, and at any instant.

use std::{iter, ops::Range};

use anyhow::{Context, bail, ensure};
use emulator::{
    Time,
    can::{Adapter, Frame, Id},
    chip::{Part, PowerCut, Timing},
    image::Image,
    network::{AdapterId, Network, Source, What},
};
use lss_slave::{
    BitRate, NodeId, Settings,
    lss::{REQUEST_COB_ID, RESPONSE_COB_ID, Request},
};

use super::{Expected, Named, Tally};
use testkit::{
    boards,
    image_rig::{
        BOOT, DEFAULT_BIT_RATE, SETTINGS_LENGTH, SETTINGS_OFFSET, bit_per_s, flash_with, has_joined,
    },
    random::Random,
};

/// The time-out for an answer; a store takes 1 ms.
const PATIENCE: Time = Time::from_ms(20);
/// The number of stores after which the next power-on moves to the other half of the flash.
const STORES_TO_MOVE: u16 = 384;
/// The settings that an LSS master stores, one after the other.
const COMMISSIONINGS: [(u8, BitRate); 2] = [(5, BitRate::Kbit500), (6, BitRate::Kbit250)];
/// The settings that it stores after the cuts.
const LAST_COMMISSIONING: (u8, BitRate) = (7, BitRate::Kbit1000);
/// The number of requests whose answer time is measured.
const MEASUREMENTS: u8 = 40;
/// The number of frames behind each of them: 5 ms at 1 Mbit/s.
const FULL_BUS_FRAMES: usize = 40;

/// The content of the flash before the session.
#[derive(Clone, Copy)]
pub enum Session {
    Blank,
    Moving,
}

/// The time of a power cut.
#[derive(Clone, Copy, Debug)]
pub enum Cut {
    /// In the middle of a flash operation.
    In(PowerCut),
    /// At an instant after the first power-on.
    At(Time),
}

/// The session without a cut: the times of its flash operations, and its end.
pub struct Course {
    operations: Vec<Range<Time>>,
    end: Time,
}

impl Course {
    /// A cut in every flash operation.
    pub fn in_operations(&self, random: &mut Random) -> Vec<Cut> {
        let operations = 0..self.operations.len() as u64;
        operations.map(|operation| Cut::In(PowerCut { operation, seed: random.u64() })).collect()
    }

    /// A cut in every pause before, between and after the flash operations.
    pub fn between_operations(&self, random: &mut Random) -> Vec<Cut> {
        let starts = self.operations.iter().map(|operation| operation.start);
        let ends = self.operations.iter().map(|operation| operation.end);
        let pauses = iter::once(Time::ZERO).chain(ends).zip(starts.chain([self.end]));
        pauses.map(|(from, to)| Cut::At(instant(from..to, random))).collect()
    }

    /// A number of cuts at random instants.
    pub fn at_instants(&self, count: usize, random: &mut Random) -> Vec<Cut> {
        (0..count).map(|_| Cut::At(instant(Time::ZERO..self.end, random))).collect()
    }
}

fn instant(range: Range<Time>, random: &mut Random) -> Time {
    // Not at the very start of a range, where the operation before it may be unfinished by a cycle.
    Time::from_ps(random.within(range.start.as_ps() + 10_000..range.end.as_ps()))
}

/// A board and an LSS master on one bus.
struct Rig {
    network: Network,
    master: AdapterId,
}

fn settings((node_id, bit_rate): (u8, BitRate)) -> Settings {
    // The heartbeat time of a blank board is stored together with the LSS settings.
    Settings::new(bit_rate.into()).with_node_id(NodeId::new(node_id)).with_heartbeat_ms(1000)
}

impl Session {
    /// The starting contents that are tried.
    pub const ALL: [Self; 2] = [Self::Blank, Self::Moving];

    pub const fn name(self) -> &'static str {
        match self {
            Self::Blank => "blank flash, two commissionings",
            Self::Moving => "flash to be erased, two commissionings",
        }
    }

    /// The content of the settings' flash, and its meaning.
    fn begin(self) -> (Vec<u8>, Expected) {
        if matches!(self, Self::Blank) {
            return (vec![0xFF; SETTINGS_LENGTH], Expected::NOTHING);
        }
        let settings = |number| settings(((number % 127) as u8 + 1, BitRate::Kbit125));
        let stores: Vec<_> = (0..STORES_TO_MOVE).map(settings).collect();
        (flash_with(&stores), Expected { known: stores.last().copied(), attempted: None })
    }

    /// The session without a cut.
    pub fn course(self, part: Part, image: &Image) -> anyhow::Result<Course> {
        let (content, mut expected) = self.begin();
        let rig = session(part, image, &content, None, &mut expected)?;
        let operations = rig.network.board(0).chip().flash().operation_times().to_vec();
        Ok(Course { operations, end: rig.network.now() })
    }

    /// Runs a session for each of `cuts`; if `twice`, each is followed by sessions with a second cut in every flash
    /// operation.
    pub fn run(
        self,
        part: Part,
        image: &Image,
        cuts: &[Cut],
        random: &mut Random,
        twice: bool,
    ) -> anyhow::Result<Tally> {
        let mut tally = Tally::default();
        let (content, begin) = self.begin();
        for &cut in cuts {
            let mut expected = begin.clone();
            let rig = session(part, image, &content, Some(cut), &mut expected)?;
            tally.cuts += 1;
            let left = rig.settings_flash();
            if let Err(loss) = check(part, image, &left, expected.clone()) {
                tally.losses.push(format!("{cut:?}: {loss:#}"));
                continue;
            }
            if !twice {
                continue;
            }
            let operations = session(part, image, &left, None, &mut expected.clone())?.operations();
            for operation in 0..operations {
                let mut expected = expected.clone();
                let second = PowerCut { operation, seed: random.u64() };
                let rig = session(part, image, &left, Some(Cut::In(second)), &mut expected)?;
                tally.cuts += 1;
                if let Err(loss) = check(part, image, &rig.settings_flash(), expected) {
                    tally.losses.push(format!("{cut:?}, {second:?}: {loss:#}"));
                }
            }
        }
        Ok(tally)
    }
}

/// Power-on and both commissionings, until the power fails.
fn session(
    part: Part,
    image: &Image,
    content: &[u8],
    cut: Option<Cut>,
    expected: &mut Expected,
) -> anyhow::Result<Rig> {
    let mut rig = Rig::new(part, image, content);
    match cut {
        Some(Cut::In(cut)) => rig.network.board(0).chip().flash_mut().cut_power(cut),
        Some(Cut::At(time)) => rig.network.board_mut(0).cut_power_at(time),
        None => {}
    }
    let outcome = rig.commission_all(expected);
    let is_powered = rig.network.board(0).is_powered();
    if is_powered {
        outcome?;
    }
    ensure!(is_powered == cut.is_none(), "the power failed without a cut, or not at the cut");
    Ok(rig)
}

/// Checks after power returns: the board is reachable with legal settings, and can be commissioned.
fn check(part: Part, image: &Image, content: &[u8], mut expected: Expected) -> anyhow::Result<()> {
    let Expected { known, attempted } = expected;
    let mut rig = Rig::new(part, image, content);
    ensure!(rig.boot()?, "the power failed during the boot");
    let found = rig.found()?;
    ensure!(
        expected.admits(found),
        "{}, not {} or {}",
        Named(found),
        Named(known),
        Named(attempted)
    );
    rig.commission(LAST_COMMISSIONING)?;
    let mut rig = Rig::new(part, image, &rig.settings_flash());
    rig.boot()?;
    let found = rig.found()?;
    ensure!(found == Some(settings(LAST_COMMISSIONING)), "{} after the cut", Named(found));
    let findings = rig.network.board(0).findings();
    ensure!(findings.is_empty(), "{findings:?}");
    Ok(())
}

impl Rig {
    /// A board with this content of the settings' flash, just switched on.
    fn new(part: Part, image: &Image, content: &[u8]) -> Self {
        let mut board = boards::board(part, image, 0);
        board.set_flash(SETTINGS_OFFSET, content);
        let mut network = Network::new();
        network.add_board(board);
        let master = network.add_adapter(Adapter::new(bit_per_s(DEFAULT_BIT_RATE)));
        // It takes no part until it knows the bit rate: its errors would make the board search for another.
        network.adapter_mut(master).close();
        Self { network, master }
    }

    fn operations(&self) -> u64 {
        self.network.board(0).chip().flash().operations()
    }

    fn settings_flash(&self) -> Vec<u8> {
        let from = SETTINGS_OFFSET as usize;
        self.network.board(0).flash()[from..][..SETTINGS_LENGTH].to_vec()
    }

    /// Waits until the board is on the bus, and changes to its bit rate; `false` if the power fails before.
    fn boot(&mut self) -> anyhow::Result<bool> {
        while self.network.now() < BOOT {
            self.network.run_for(Time::from_ms(1));
            if !self.network.board(0).is_powered() {
                return Ok(false);
            }
            if has_joined(self.network.trace().iter()) {
                let rate = self.bit_rate()?;
                let master = self.network.adapter_mut(self.master);
                master.set_bit_rate(bit_per_s(rate));
                master.open();
                return Ok(true);
            }
        }
        bail!("the board does not join the bus")
    }

    /// The first bit rate that the board set.
    fn bit_rate(&self) -> anyhow::Result<BitRate> {
        let first = self.network.trace().iter().find_map(|event| match event.what {
            What::BitTiming { bit_rate, .. } => Some(bit_rate),
            _ => None,
        });
        let known = BitRate::ALL.into_iter().find(|rate| Some(bit_per_s(*rate)) == first);
        known.context("the board is at no bit rate of CiA 301")
    }

    /// The settings as the board reports them on the bus; `None`: the defaults. Leaves it in LSS configuration state.
    fn found(&mut self) -> anyhow::Result<Option<Settings>> {
        let rate = self.bit_rate()?;
        self.request(Request::SwitchToConfiguration);
        let answer = self.ask(Request::InquireNodeId)?;
        Ok(match answer[1] {
            0xFF if rate == DEFAULT_BIT_RATE => None,
            id => Some(settings((id, rate))),
        })
    }

    /// Power-on and all commissionings. A power failure is an error.
    fn commission_all(&mut self, expected: &mut Expected) -> anyhow::Result<()> {
        ensure!(self.boot()?, "the power failed during the boot");
        let found = self.found()?;
        ensure!(expected.admits(found), "the board has {} at power-on", Named(found));
        for commissioning in COMMISSIONINGS {
            expected.attempt(settings(commissioning));
            self.commission(commissioning)?;
            expected.acknowledge();
        }
        Ok(())
    }

    /// Stores a node-ID and a bit rate.
    fn commission(&mut self, (node_id, bit_rate): (u8, BitRate)) -> anyhow::Result<()> {
        let index = bit_rate.index();
        for request in [
            Request::ConfigureNodeId(node_id),
            Request::ConfigureBitTiming { table: 0, index },
            Request::StoreConfiguration,
        ] {
            let answer = self.ask(request)?;
            ensure!(answer[1] == 0, "{request:?} is refused: {answer:02X?}");
        }
        Ok(())
    }

    fn request(&mut self, request: Request) {
        let frame = Frame::data(Id::Standard(REQUEST_COB_ID), &request.to_bytes());
        self.network.send(self.master, frame);
    }

    /// Sends a request and returns its answer.
    fn ask(&mut self, request: Request) -> anyhow::Result<[u8; 8]> {
        self.request(request);
        while let Some((_, frame)) = self.network.run_until_received(self.master, PATIENCE) {
            if frame.id == Id::Standard(RESPONSE_COB_ID) {
                return Ok(frame.data);
            }
        }
        bail!("{request:?} has no answer")
    }
}

/// The longest time from the end of a store request to the end of its answer. The flash is as slow as the data sheet
/// allows, and the bus is full of frames that the node must examine and that have a lower priority than its answer.
pub fn worst_answer_time(part: Part, image: &Image) -> anyhow::Result<Time> {
    let stored = flash_with(&[settings(LAST_COMMISSIONING)]);
    let mut rig = Rig::new(part, image, &stored);
    ensure!(rig.boot()?, "the power failed during the boot");
    rig.network.board(0).chip().flash_mut().set_timing(Timing::Worst);
    rig.request(Request::SwitchToConfiguration);
    // It looks like an answer, with the COB-ID of requests: of lower priority than answers, examined and ignored.
    let ignored = Frame::data(Id::Standard(REQUEST_COB_ID), &[0x44; 8]);
    for number in 1..=MEASUREMENTS {
        rig.request(Request::ConfigureNodeId(number));
        rig.request(Request::StoreConfiguration);
        (0..FULL_BUS_FRAMES).for_each(|_| rig.network.send(rig.master, ignored));
        while rig.network.adapter_mut(rig.master).unsent() > 0 {
            rig.network.run_for(Time::from_ms(1));
        }
    }
    let mut answers = 0;
    let store = Request::StoreConfiguration.to_bytes();
    let mut asked = Time::ZERO;
    let mut worst = Time::ZERO;
    for event in rig.network.trace() {
        let What::Frame { frame, .. } = &event.what else { continue };
        match (frame.id, event.source) {
            (Id::Standard(REQUEST_COB_ID), _) if frame.data == store => asked = event.time,
            (Id::Standard(RESPONSE_COB_ID), Source::Board(_)) if frame.data[0] == store[0] => {
                worst = worst.max(event.time - asked);
                answers += 1;
            }
            _ => {}
        }
    }
    ensure!(answers == MEASUREMENTS, "{answers} answers to {MEASUREMENTS} requests");
    Ok(worst)
}
