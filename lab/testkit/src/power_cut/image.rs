//! Power cuts in the release image on an emulated board, in every flash operation of its start and of two commissionings
//! by LSS.

use anyhow::{Context, ensure};
use canopen_node::{BitRate, Settings, lss::RESPONSE_COB_ID, settings::Log};
use emulator::{Time, chip::PowerCut};

use crate::{
    boards::Variant,
    flash::BoardFlash,
    frames::of_master,
    image_rig::{DEFAULT_BIT_RATE, ImageRig, SETTINGS_LENGTH, SETTINGS_OFFSET, settings},
    random::Random,
};

/// The time-out for an answer; a store takes 1 ms.
const PATIENCE: Time = Time::from_ms(20);
/// The number of places in a half of the flash that stores use.
const PLACES: u16 = 409 - 8;
/// What a master stores, one after the other.
const COMMISSIONINGS: [(u8, BitRate); 2] = [(5, BitRate::Kbit500), (6, BitRate::Kbit250)];
/// What it stores after the cuts.
const LAST_COMMISSIONING: (u8, BitRate) = (7, BitRate::Kbit1000);

/// The content of the flash before the session.
#[derive(Clone, Copy)]
pub enum Session {
    Blank,
    /// A half of the flash is full during the session.
    Full,
    /// A half of the flash was full before the session, which begins with its erase.
    Moved,
}

/// The settings expected at the next power-on.
#[derive(Clone)]
struct Expected {
    /// Those last stored or found; `None`: the defaults.
    known: Option<Settings>,
    /// Those of a later store that the power cut interrupted.
    attempted: Option<Settings>,
}

impl Expected {
    /// Whether `found` is possible; if so, it is what is expected from now on.
    fn admits(&mut self, found: Option<Settings>) -> bool {
        let admits = found == self.known || found.is_some() && found == self.attempted;
        *self = Self { known: found, attempted: None };
        admits
    }
}

/// The settings after this store.
fn stored((node_id, bit_rate): (u8, BitRate)) -> Settings {
    settings(node_id, bit_rate).settings
}

/// The settings' flash of a board that has stored until this number of places were written, at last these settings.
fn in_use_until(last: u16, settings: Settings) -> Vec<u8> {
    let (mut log, _) = Log::open(BoardFlash::blank(0));
    // The records of the defaults come first.
    for place in 2..last {
        let node_id = if (last - place) % 2 == 1 { settings.node_id } else { None };
        log.store(settings.with_node_id(node_id)).expect("the flash works");
    }
    log.close().content()
}

/// A board and a master on one bus.
struct Rig(ImageRig);

impl Session {
    /// The content of the settings' flash, and its meaning.
    fn begin(self) -> (Vec<u8>, Expected) {
        let first = stored((5, DEFAULT_BIT_RATE));
        let (content, known) = match self {
            Self::Blank => (vec![0xFF; SETTINGS_LENGTH], None),
            Self::Full => (in_use_until(PLACES - 1, first), Some(first)),
            Self::Moved => (in_use_until(PLACES + 1, first), Some(first)),
        };
        (content, Expected { known, attempted: None })
    }

    /// Runs the session with a cut in each of its flash operations. Returns the number of cuts; fails if what was stored
    /// is lost.
    pub fn run(self, variant: &Variant, random: &mut Random) -> anyhow::Result<u64> {
        let (content, begin) = self.begin();
        let Rig(uncut) = live(variant, &content, None, &mut begin.clone())?;
        let operations = uncut.network.board(0).chip().flash().operations();
        for operation in 0..operations {
            let cut = PowerCut { operation, seed: random.u64() };
            let mut expected = begin.clone();
            let rig = live(variant, &content, Some(cut), &mut expected)?;
            rig.check(expected).with_context(|| format!("{cut:?}"))?;
        }
        Ok(operations)
    }
}

/// Power-on and all stores, until the power fails.
fn live(
    variant: &Variant,
    content: &[u8],
    cut: Option<PowerCut>,
    expected: &mut Expected,
) -> anyhow::Result<Rig> {
    let mut board = variant.board(0, None);
    board.set_flash(SETTINGS_OFFSET, content);
    let mut rig = Rig(ImageRig::unattended(board));
    if let Some(cut) = cut {
        rig.0.network.board(0).chip().flash_mut().cut_power(cut);
    }
    let outcome = rig.store_all(expected);
    let is_powered = rig.0.network.board(0).is_powered();
    if is_powered {
        outcome?;
    }
    ensure!(is_powered == cut.is_none(), "the power failed without a cut, or not at the cut");
    Ok(rig)
}

impl Rig {
    /// Power-on and all stores. A power failure is an error.
    fn store_all(&mut self, expected: &mut Expected) -> anyhow::Result<()> {
        let found = self.found()?;
        ensure!(expected.admits(found), "the board has {found:?} at power-on");
        for new in COMMISSIONINGS {
            expected.attempted = Some(stored(new));
            self.store(new)?;
            *expected = Expected { known: Some(stored(new)), attempted: None };
        }
        Ok(())
    }

    /// Checks after power returns: the board is reachable with legal settings, also at another power-on, and can store.
    fn check(mut self, mut expected: Expected) -> anyhow::Result<()> {
        let Expected { known, attempted } = expected;
        self.0.restart_unattended();
        let found = self.found()?;
        ensure!(expected.admits(found), "{found:?}, not {known:?} or {attempted:?}");
        self.0.restart_unattended();
        let again = self.found()?;
        ensure!(again == found, "{found:?} at one power-on, {again:?} at the next");
        self.store(LAST_COMMISSIONING)?;
        self.0.restart_unattended();
        let found_then = self.found()?;
        ensure!(found_then == Some(stored(LAST_COMMISSIONING)), "{found_then:?} after the cut");
        Ok(())
    }

    /// Waits until the board is on the bus, and reads its settings there; `None`: the defaults. Leaves the board in LSS
    /// configuration state.
    fn found(&mut self) -> anyhow::Result<Option<Settings>> {
        let rate = self.0.join().context("the power failed during the start")?;
        self.0.send("04 01");
        let node_id = self.ask("5E")?[1];
        let has_defaults = node_id == 0xFF && rate == DEFAULT_BIT_RATE;
        Ok((!has_defaults).then(|| stored((node_id, rate))))
    }

    /// Makes settings persistent.
    fn store(&mut self, (node_id, bit_rate): (u8, BitRate)) -> anyhow::Result<()> {
        let index = bit_rate.index();
        for request in [&format!("11 {node_id:02X}"), &format!("13 00 {index:02X}"), "17"] {
            let answer = self.ask(request)?;
            ensure!(answer[1] == 0, "{request} is refused: {answer:02X?}");
        }
        Ok(())
    }

    /// Sends a request of the LSS master, and returns the answer.
    fn ask(&mut self, request: &str) -> anyhow::Result<[u8; 8]> {
        self.0.queue(&of_master(request));
        let answer = self.0.wait_for(PATIENCE, |frame| frame.cob_id() == RESPONSE_COB_ID);
        let (_, answer) = answer.with_context(|| format!("{request} has no answer"))?;
        Ok(answer.padded_data())
    }
}
