//! Power cuts in the release image on an emulated board: in every flash operation of a commissioning by LSS or a store
//! of parameters by 1010h, in every pause between two of them, and at any instant.

use std::{iter, ops::Range};

use anyhow::{Context, ensure};
use canopen_node::{
    BitRate, Settings,
    lss::{REQUEST_COB_ID, RESPONSE_COB_ID},
    settings::{
        Log,
        parameters::{HEADER, Packer, Parameter},
    },
};
use emulator::{Time, chip::PowerCut};

use crate::{
    boards::Variant,
    flash::BoardFlash,
    frames::of_master,
    image_rig::{
        DEFAULT_BIT_RATE, ImageRig, SETTINGS_LENGTH, SETTINGS_OFFSET, flash_with, settings,
    },
    random::Random,
};

/// The time-out for an answer; a store takes 1 ms.
const PATIENCE: Time = Time::from_ms(20);
/// The number of places in a half of the flash that stores use.
const PLACES: u16 = 409 - 8;
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

/// The persistent settings, and the values of the parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Content {
    settings: Settings,
    values: [u8; 2],
}

/// The content expected at the next power-on.
#[derive(Clone)]
struct Expected {
    /// The content last stored or found; `None`: the defaults.
    known: Option<Content>,
    /// The content of a later store that the power cut interrupted.
    attempted: Option<Content>,
}

impl Expected {
    /// Whether `found` is possible; if so, it is the expected content from now on.
    fn admits(&mut self, found: Option<Content>) -> bool {
        let admits = found == self.known || found.is_some() && found == self.attempted;
        *self = Self { known: found, attempted: None };
        admits
    }
}

impl Content {
    /// The settings' flash of a board that has stored until this number of places were written; the last store was of
    /// this content.
    fn in_use_until(self, last: u16, has_parameters: bool) -> Vec<u8> {
        let (mut log, _) = Log::<_, PACKED>::open_with_parameters(BoardFlash::blank(0));
        // The records of the defaults.
        let mut places = 3;
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
                // The heartbeat time of a blank board is stored together with the LSS settings.
                settings: settings(node_id, bit_rate).with_heartbeat_ms(1000),
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

/// A board and a master on one bus.
struct Rig {
    rig: ImageRig,
    /// The node-ID of the board, once it is known.
    node_id: u8,
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
    fn begin(self) -> (Vec<u8>, Expected) {
        let known = |content| Expected { known: Some(content), attempted: None };
        let first = Store::Settings(5, DEFAULT_BIT_RATE).after(None);
        match self {
            Self::Blank => (vec![0xFF; SETTINGS_LENGTH], Expected { known: None, attempted: None }),
            Self::Example => (flash_with(&[first.settings]), known(first)),
            Self::Full | Self::Moved | Self::FullExample | Self::MovedExample => {
                let is_full = matches!(self, Self::Full | Self::FullExample);
                let last = if is_full { PLACES - 1 } else { PLACES + 1 };
                (first.in_use_until(last, self.has_parameters()), known(first))
            }
        }
    }

    /// The session without a cut, which fails if it does not end as expected.
    pub fn course(self, variant: &Variant) -> anyhow::Result<Course> {
        let (content, mut expected) = self.begin();
        let Rig { rig, .. } = self.live(variant, &content, None, &mut expected)?;
        let operations = rig.network.board(0).chip().flash().operation_times().to_vec();
        Ok(Course { operations, end: rig.network.now() })
    }

    /// Runs a session for each of `cuts`; if `twice`, each is followed by sessions with a second cut in every flash
    /// operation. Returns the number of cuts; fails if what was stored is lost.
    pub fn run(
        self,
        variant: &Variant,
        cuts: &[Cut],
        random: &mut Random,
        twice: bool,
    ) -> anyhow::Result<u64> {
        let mut count = 0;
        let (content, begin) = self.begin();
        for &cut in cuts {
            let mut expected = begin.clone();
            let rig = self.live(variant, &content, Some(cut), &mut expected)?;
            let left = rig.settings_flash();
            self.check(rig, expected.clone()).with_context(|| format!("{cut:?}"))?;
            count += 1;
            if !twice {
                continue;
            }
            let rig = self.live(variant, &left, None, &mut expected.clone())?.rig;
            for operation in 0..rig.network.board(0).chip().flash().operations() {
                let mut expected = expected.clone();
                let second = Cut::In(PowerCut { operation, seed: random.u64() });
                let rig = self.live(variant, &left, Some(second), &mut expected)?;
                self.check(rig, expected).with_context(|| format!("{cut:?}, {second:?}"))?;
                count += 1;
            }
        }
        Ok(count)
    }

    /// Power-on and all stores, until the power fails.
    fn live(
        self,
        variant: &Variant,
        content: &[u8],
        cut: Option<Cut>,
        expected: &mut Expected,
    ) -> anyhow::Result<Rig> {
        let mut rig = Rig::new(variant, content);
        let network = &mut rig.rig.network;
        match cut {
            Some(Cut::In(cut)) => network.board(0).chip().flash_mut().cut_power(cut),
            Some(Cut::At(time)) => network.board_mut(0).cut_power_at(time),
            None => {}
        }
        let outcome = self.store_all(&mut rig, expected);
        let is_powered = rig.rig.network.board(0).is_powered();
        if is_powered {
            outcome?;
        }
        ensure!(is_powered == cut.is_none(), "the power failed without a cut, or not at the cut");
        Ok(rig)
    }

    /// Power-on and all stores. A power failure is an error.
    fn store_all(self, rig: &mut Rig, expected: &mut Expected) -> anyhow::Result<()> {
        let mut content = self.found(rig)?;
        ensure!(expected.admits(content), "the board has {content:?} at power-on");
        for store in self.stores().0 {
            let new = store.after(content);
            expected.attempted = Some(new);
            rig.store(*store)?;
            *expected = Expected { known: Some(new), attempted: None };
            content = Some(new);
        }
        Ok(())
    }

    /// Checks after power returns: the board is reachable with legal content, also at another power-on, and can store.
    fn check(self, mut rig: Rig, mut expected: Expected) -> anyhow::Result<()> {
        let Expected { known, attempted } = expected;
        rig.rig.restart_unattended();
        let found = self.found(&mut rig)?;
        ensure!(expected.admits(found), "{found:?}, not {known:?} or {attempted:?}");
        rig.rig.restart_unattended();
        let again = self.found(&mut rig)?;
        ensure!(again == found, "{found:?} at one power-on, {again:?} at the next");
        let (_, last) = self.stores();
        rig.store(last)?;
        rig.rig.restart_unattended();
        let found_then = self.found(&mut rig)?;
        ensure!(found_then == Some(last.after(found)), "{found_then:?} after the cut");
        Ok(())
    }

    /// Waits until the board is on the bus, and reads its content there; `None`: the defaults. Leaves the board in LSS
    /// configuration state.
    fn found(self, rig: &mut Rig) -> anyhow::Result<Option<Content>> {
        let rate = rig.rig.join().context("the power failed during the start")?;
        rig.rig.send("04 01");
        let node_id = rig.ask("5E")?[1];
        if node_id == 0xFF && rate == DEFAULT_BIT_RATE {
            return Ok(None);
        }
        rig.node_id = node_id;
        let mut content = Store::Settings(node_id, rate).after(None);
        if self.has_parameters() {
            for (value, (index, sub_index, _)) in content.values.iter_mut().zip(PARAMETERS) {
                let answer = rig.ask(&rig.sdo(0x40, index, sub_index, "00 00 00 00"))?;
                ensure!(answer[0] == 0x4F, "{index:04X}h is not read: {answer:02X?}");
                *value = answer[4];
            }
        }
        Ok(Some(content))
    }
}

impl Rig {
    /// A board with this content of the settings' flash, just switched on.
    fn new(variant: &Variant, content: &[u8]) -> Self {
        let mut board = variant.board(0, None);
        board.set_flash(SETTINGS_OFFSET, content);
        Self { rig: ImageRig::unattended(board), node_id: 0xFF }
    }

    fn settings_flash(&self) -> Vec<u8> {
        let from = SETTINGS_OFFSET as usize;
        self.rig.network.board(0).flash()[from..][..SETTINGS_LENGTH].to_vec()
    }

    /// Makes settings or parameters persistent.
    fn store(&mut self, store: Store) -> anyhow::Result<()> {
        match store {
            Store::Settings(node_id, bit_rate) => {
                let index = bit_rate.index();
                let requests = [&format!("11 {node_id:02X}"), &format!("13 00 {index:02X}"), "17"];
                for request in requests {
                    let answer = self.ask(request)?;
                    ensure!(answer[1] == 0, "{request} is refused: {answer:02X?}");
                }
            }
            Store::Parameters(save, values) => {
                for ((index, sub_index, _), value) in PARAMETERS.into_iter().zip(values) {
                    self.write(0x2F, index, sub_index, &format!("{value:02X} 00 00 00"))?;
                }
                self.write(0x23, 0x1010, save, "73 61 76 65")?;
            }
        }
        Ok(())
    }

    fn write(&mut self, command: u8, index: u16, sub: u8, data: &str) -> anyhow::Result<()> {
        let answer = self.ask(&self.sdo(command, index, sub, data))?;
        ensure!(answer[0] == 0x60, "{index:04X}h is refused: {answer:02X?}");
        Ok(())
    }

    /// Sends a request of the LSS master, or of the SDO client with its COB-ID, and returns the answer.
    fn ask(&mut self, request: &str) -> anyhow::Result<[u8; 8]> {
        let frame = of_master(request);
        self.rig.queue(&frame);
        let cob_id = match frame.cob_id() {
            REQUEST_COB_ID => RESPONSE_COB_ID,
            sdo => sdo - 0x80,
        };
        let answer = self.rig.wait_for(PATIENCE, |frame| frame.cob_id() == cob_id);
        let (_, answer) = answer.with_context(|| format!("{request} has no answer"))?;
        Ok(answer.padded_data())
    }

    /// An SDO request to the board: `command`, an index and sub-index, and four bytes.
    fn sdo(&self, command: u8, index: u16, sub_index: u8, data: &str) -> String {
        let ([low, high], cob_id) = (index.to_le_bytes(), 0x600 + u16::from(self.node_id));
        format!("{cob_id:03X}: {command:02X} {low:02X} {high:02X} {sub_index:02X} {data}")
    }
}
