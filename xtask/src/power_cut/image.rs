//! Power cuts in the release image on an emulated board: in every flash operation of a commissioning by LSS or a store
//! of parameters by 1010h, in every pause between two of them, and at any instant.

use std::{fmt, iter, ops::Range};

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
    settings::{
        Log,
        parameters::{HEADER, Packer, Parameter},
    },
};

use super::{Expected, Named, Tally};
use testkit::{
    boards,
    flash::BoardFlash,
    image_rig::{
        BOOT, DEFAULT_BIT_RATE, SETTINGS_LENGTH, SETTINGS_OFFSET, bit_per_s, flash_with, has_joined,
    },
    random::Random,
};

/// The time-out for an answer; a store takes 1 ms.
const PATIENCE: Time = Time::from_ms(20);
/// The number of places in a half of the flash.
const PLACES: u16 = 512;
/// What a master stores in the default image, one after the other.
const COMMISSIONINGS: [Store; 2] =
    [Store::Settings(5, BitRate::Kbit500), Store::Settings(6, BitRate::Kbit250)];
/// What it stores after the cuts.
const LAST_COMMISSIONING: Store = Store::Settings(7, BitRate::Kbit1000);
/// The same with the example: all parameters, settings, and the parameters of the application.
const STORES: [Store; 3] = [
    Store::Parameters(1, [5, 1]),
    Store::Settings(6, BitRate::Kbit250),
    Store::Parameters(3, [7, 1]),
];
const LAST_STORE: Store = Store::Parameters(1, [8, 2]);
/// The length of the packed parameters.
const PACKED: usize = PARAMETERS.len() * (HEADER + 1);
/// The parameters of the example: index, sub-index, and value of a new device. They are the filter constant and the error
/// behaviour.
const PARAMETERS: [(u16, u8, u8); 2] = [(0x2100, 0, 3), (0x1029, 1, 0)];
/// The number of requests whose answer time is measured.
const MEASUREMENTS: u8 = 40;
/// The number of frames behind each of them: 5 ms at 1 Mbit/s.
const FULL_BUS_FRAMES: usize = 40;

/// The image, and the content of the flash before the session.
#[derive(Clone, Copy, PartialEq)]
pub enum Session {
    Blank,
    /// A half of the flash is full during the session.
    Full,
    /// A half of the flash was full before the session, which begins with its erase.
    Moved,
    /// The example `io`, with stored settings.
    Example,
    FullExample,
    MovedExample,
}

/// What a session makes persistent at a time.
#[derive(Clone, Copy, Debug)]
enum Store {
    /// Node-ID and bit rate, by LSS.
    Settings(u8, BitRate),
    /// The values of [`PARAMETERS`], by this sub-index of 1010h.
    Parameters(u8, [u8; 2]),
}

/// The persistent settings, and the values of [`PARAMETERS`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Content {
    settings: Settings,
    values: [u8; 2],
}

/// `node-ID 5, 500 kbit/s, [3, 0]` or `the defaults`.
struct Shown(Option<Content>);

impl fmt::Display for Shown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Named(self.0.map(|content| content.settings)).fmt(f)?;
        self.0.map_or(Ok(()), |content| write!(f, ", {:?}", content.values))
    }
}

impl Content {
    /// The settings' flash of a board that has stored until this number of places were written; the last store was of
    /// this content.
    fn in_use_until(self, last: u16, has_parameters: bool) -> Vec<u8> {
        let (mut log, _) = Log::<_, PACKED>::open_with_parameters(BoardFlash::blank(0));
        // The mark and the record of the defaults.
        let mut places = 2;
        if has_parameters {
            let mut packed = [0; PACKED];
            let mut packer = Packer::new(&mut packed);
            for ((index, sub_index, _), value) in PARAMETERS.into_iter().zip(self.values) {
                packer.put(&Parameter { index, sub_index, data_type: 0x05, value: &[value] });
            }
            log.store_with_parameters(self.settings, &packed).expect("the flash works");
            places += 2;
        }
        for place in places..last {
            let heartbeat_ms = self.settings.heartbeat_ms + last - 1 - place;
            let settings = self.settings.with_heartbeat_ms(heartbeat_ms);
            log.store(settings).expect("the flash works");
        }
        log.close().content()
    }
}

impl Store {
    /// The content after this store.
    fn after(self, before: Option<Content>) -> Content {
        match (self, before) {
            (Self::Settings(node_id, bit_rate), _) => Content {
                settings: settings((node_id, bit_rate)),
                values: before.map_or(PARAMETERS.map(|(.., new)| new), |content| content.values),
            },
            (Self::Parameters(_, values), Some(before)) => Content { values, ..before },
            (Self::Parameters(..), None) => unreachable!("parameters need a node-ID"),
        }
    }
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
    /// The node-ID of the board, once it is known.
    node_id: u8,
}

fn settings((node_id, bit_rate): (u8, BitRate)) -> Settings {
    // The heartbeat time of a blank board is stored together with the LSS settings.
    Settings::new(bit_rate.into()).with_node_id(NodeId::new(node_id)).with_heartbeat_ms(1000)
}

impl Session {
    /// The sessions with the default image.
    pub const DEFAULT: [Self; 3] = [Self::Blank, Self::Full, Self::Moved];
    /// The sessions with the example.
    pub const EXAMPLE: [Self; 3] = [Self::Example, Self::FullExample, Self::MovedExample];

    pub const fn name(self) -> &'static str {
        match self {
            Self::Blank => "blank flash, two commissionings",
            Self::Full => "one half nearly full, two commissionings",
            Self::Moved => "one half to be erased, two commissionings",
            Self::Example => "settings stored, parameters twice",
            Self::FullExample => "one half nearly full, parameters twice",
            Self::MovedExample => "one half to be erased, parameters twice",
        }
    }

    const fn has_parameters(self) -> bool {
        matches!(self, Self::Example | Self::FullExample | Self::MovedExample)
    }

    /// What the session stores, and what is stored after the cuts.
    const fn stores(self) -> (&'static [Store], Store) {
        if self.has_parameters() {
            (&STORES, LAST_STORE)
        } else {
            (&COMMISSIONINGS, LAST_COMMISSIONING)
        }
    }

    /// The content of the settings' flash, and its meaning.
    fn begin(self) -> (Vec<u8>, Expected<Content>) {
        let known = |content| Expected { known: Some(content), attempted: None };
        let first = Store::Settings(5, DEFAULT_BIT_RATE).after(None);
        match self {
            Self::Blank => (vec![0xFF; SETTINGS_LENGTH], Expected::NOTHING),
            Self::Example => (flash_with(&[first.settings]), known(first)),
            Self::Full | Self::Moved | Self::FullExample | Self::MovedExample => {
                let is_full = matches!(self, Self::Full | Self::FullExample);
                let last = if is_full { PLACES - 2 } else { PLACES + 1 };
                (first.in_use_until(last, self.has_parameters()), known(first))
            }
        }
    }

    /// The session without a cut.
    pub fn course(self, part: Part, image: &Image) -> anyhow::Result<Course> {
        let (content, mut expected) = self.begin();
        let rig = self.live(part, image, &content, None, &mut expected)?;
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
            let rig = self.live(part, image, &content, Some(cut), &mut expected)?;
            tally.cuts += 1;
            let left = rig.settings_flash();
            if let Err(loss) = self.check(part, image, &left, expected.clone()) {
                tally.losses.push(format!("{cut:?}: {loss:#}"));
                continue;
            }
            if !twice {
                continue;
            }
            let operations =
                self.live(part, image, &left, None, &mut expected.clone())?.operations();
            for operation in 0..operations {
                let mut expected = expected.clone();
                let second = PowerCut { operation, seed: random.u64() };
                let rig = self.live(part, image, &left, Some(Cut::In(second)), &mut expected)?;
                tally.cuts += 1;
                if let Err(loss) = self.check(part, image, &rig.settings_flash(), expected) {
                    tally.losses.push(format!("{cut:?}, {second:?}: {loss:#}"));
                }
            }
        }
        Ok(tally)
    }

    /// Power-on and all stores, until the power fails.
    fn live(
        self,
        part: Part,
        image: &Image,
        content: &[u8],
        cut: Option<Cut>,
        expected: &mut Expected<Content>,
    ) -> anyhow::Result<Rig> {
        let mut rig = Rig::new(part, image, content);
        match cut {
            Some(Cut::In(cut)) => rig.network.board(0).chip().flash_mut().cut_power(cut),
            Some(Cut::At(time)) => rig.network.board_mut(0).cut_power_at(time),
            None => {}
        }
        let outcome = self.store_all(&mut rig, expected);
        let is_powered = rig.network.board(0).is_powered();
        if is_powered {
            outcome?;
        }
        ensure!(is_powered == cut.is_none(), "the power failed without a cut, or not at the cut");
        Ok(rig)
    }

    /// Power-on and all stores. A power failure is an error.
    fn store_all(self, rig: &mut Rig, expected: &mut Expected<Content>) -> anyhow::Result<()> {
        ensure!(rig.boot()?, "the power failed during the boot");
        let mut content = self.found(rig)?;
        ensure!(expected.admits(content), "the board has {} at power-on", Shown(content));
        for store in self.stores().0 {
            let new = store.after(content);
            expected.attempt(new);
            rig.store(*store)?;
            expected.acknowledge();
            content = Some(new);
        }
        Ok(())
    }

    /// Checks after power returns: the board is reachable with legal content, and can store.
    fn check(
        self,
        part: Part,
        image: &Image,
        flash: &[u8],
        mut expected: Expected<Content>,
    ) -> anyhow::Result<()> {
        let Expected { known, attempted } = expected;
        let mut rig = Rig::new(part, image, flash);
        ensure!(rig.boot()?, "the power failed during the boot");
        let found = self.found(&mut rig)?;
        ensure!(
            expected.admits(found),
            "{}, not {} or {}",
            Shown(found),
            Shown(known),
            Shown(attempted)
        );
        let (_, last) = self.stores();
        rig.store(last)?;
        let mut rig = Rig::new(part, image, &rig.settings_flash());
        rig.boot()?;
        let found_then = self.found(&mut rig)?;
        ensure!(found_then == Some(last.after(found)), "{} after the cut", Shown(found_then));
        let findings = rig.network.board(0).findings();
        ensure!(findings.is_empty(), "{findings:?}");
        Ok(())
    }

    /// The content as the board reports it on the bus; `None`: the defaults. Leaves it in LSS configuration state.
    fn found(self, rig: &mut Rig) -> anyhow::Result<Option<Content>> {
        let rate = rig.bit_rate()?;
        rig.request(Request::SwitchToConfiguration);
        let node_id = rig.ask(Request::InquireNodeId)?[1];
        if node_id == 0xFF && rate == DEFAULT_BIT_RATE {
            return Ok(None);
        }
        rig.node_id = node_id;
        let mut content = Store::Settings(node_id, rate).after(None);
        if self.has_parameters() {
            for (value, (index, sub_index, _)) in content.values.iter_mut().zip(PARAMETERS) {
                let [i0, i1] = index.to_le_bytes();
                let answer = rig.ask_sdo([0x40, i0, i1, sub_index, 0, 0, 0, 0])?;
                ensure!(answer[0] == 0x4F, "{index:04X}h is not read: {answer:02X?}");
                *value = answer[4];
            }
        }
        Ok(Some(content))
    }
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
        Self { network, master, node_id: 0xFF }
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

    /// Makes settings or parameters persistent.
    fn store(&mut self, store: Store) -> anyhow::Result<()> {
        match store {
            Store::Settings(node_id, bit_rate) => {
                let index = bit_rate.index();
                for request in [
                    Request::ConfigureNodeId(node_id),
                    Request::ConfigureBitTiming { table: 0, index },
                    Request::StoreConfiguration,
                ] {
                    let answer = self.ask(request)?;
                    ensure!(answer[1] == 0, "{request:?} is refused: {answer:02X?}");
                }
            }
            Store::Parameters(save, values) => {
                for ((index, sub_index, _), value) in PARAMETERS.into_iter().zip(values) {
                    let [i0, i1] = index.to_le_bytes();
                    self.write([0x2F, i0, i1, sub_index, value, 0, 0, 0])?;
                }
                self.write([0x23, 0x10, 0x10, save, b's', b'a', b'v', b'e'])?;
            }
        }
        Ok(())
    }

    fn write(&mut self, request: [u8; 8]) -> anyhow::Result<()> {
        let answer = self.ask_sdo(request)?;
        ensure!(answer[0] == 0x60, "{request:02X?} is refused: {answer:02X?}");
        Ok(())
    }

    fn request(&mut self, request: Request) {
        let frame = Frame::data(Id::Standard(REQUEST_COB_ID), &request.to_bytes());
        self.network.send(self.master, frame);
    }

    /// Sends a request and returns its answer.
    fn ask(&mut self, request: Request) -> anyhow::Result<[u8; 8]> {
        self.request(request);
        self.answer(RESPONSE_COB_ID).with_context(|| format!("{request:?} has no answer"))
    }

    /// Sends a request to the SDO server of the board and returns its answer.
    fn ask_sdo(&mut self, request: [u8; 8]) -> anyhow::Result<[u8; 8]> {
        let node_id = u16::from(self.node_id);
        let frame = Frame::data(Id::Standard(0x600 + node_id), &request);
        self.network.send(self.master, frame);
        self.answer(0x580 + node_id).with_context(|| format!("{request:02X?} has no answer"))
    }

    /// The next frame with this COB-ID.
    fn answer(&mut self, cob_id: u16) -> Option<[u8; 8]> {
        loop {
            let (_, frame) = self.network.run_until_received(self.master, PATIENCE)?;
            if frame.id == Id::Standard(cob_id) {
                return Some(frame.data);
            }
        }
    }
}

/// The longest time from the end of a store request to the end of its answer. The flash is as slow as the data sheet
/// allows, and the bus is full of frames that the node must examine and that have a lower priority than its answer.
pub fn worst_answer_time(part: Part, image: &Image) -> anyhow::Result<Time> {
    let stored = flash_with(&[settings((7, BitRate::Kbit1000))]);
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
