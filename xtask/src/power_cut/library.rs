//! Power cuts in the settings log on a flash in memory: all short histories, with one or two cuts in any of their
//! steps.

use std::fmt;

use lss_slave::{
    BitRate, NodeId, Settings,
    settings::{Found, Log},
};

use super::{Expected, Named, Tally};
use testkit::{
    flash::{BoardFlash, Flash},
    random::Random,
};

/// The greatest number of stores in a life, which fills a bank of four records.
const STORES: usize = 3;

/// All histories with a number of lives, in a flash of two banks of a number of records, initially blank or garbage.
pub struct Histories {
    lives: usize,
    records: usize,
    garbage: bool,
}

/// A device between two lives: the content of its flash, and the settings that it must find there.
struct Device {
    content: Vec<u8>,
    expected: Expected,
    /// The number of the next settings to store.
    next: u8,
    /// A description of its history.
    history: Vec<String>,
}

impl fmt::Display for Histories {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { lives, records, garbage } = self;
        let content = if *garbage { "garbage" } else { "blank" };
        write!(f, "{lives} power-ons, 2 banks of {records} records, {content} first")
    }
}

/// Different settings for each `number`.
fn settings(number: u8) -> Settings {
    Settings::new(BitRate::ALL[usize::from(number % 8)].into())
        .with_node_id(NodeId::new(number % 128))
        .with_heartbeat_ms(number.into())
}

/// One life: power-on and a number of stores, until the power fails. Returns a description of any loss.
fn live<const W: usize, const E: usize>(
    flash: &Flash<W, E>,
    expected: &mut Expected,
    mut next: u8,
    stores: usize,
) -> Result<u8, String> {
    let (mut log, found) = Log::open(flash.clone());
    if !flash.is_powered() {
        return Ok(next);
    }
    let before = expected.clone();
    if !expected.admits(log.settings()) || matches!(found, Found::MediumFailed(_)) {
        let Expected { known, attempted } = before;
        return Err(format!(
            "{found:?}: {}, not {} or {}",
            Named(log.settings()),
            Named(known),
            Named(attempted)
        ));
    }
    for _ in 0..stores {
        expected.attempt(settings(next));
        next += 1;
        match log.store(settings(next - 1)) {
            Ok(()) => expected.acknowledge(),
            Err(_) if !flash.is_powered() => break,
            // The bank is full until the next power-on.
            Err(_) => expected.attempted = None,
        }
    }
    Ok(next)
}

impl Histories {
    /// The histories that are tried.
    pub fn all(long: bool) -> Vec<Self> {
        let lives = if long { 6 } else { 4 };
        vec![
            Self { lives, records: 4, garbage: false },
            Self { lives, records: 2, garbage: false },
            Self { lives: lives - 1, records: 4, garbage: true },
            Self { lives: lives - 1, records: 8, garbage: false },
        ]
    }

    /// Runs all histories.
    pub fn run(&self, random: &mut Random) -> Tally {
        match self.records {
            2 => self.run_in::<64>(random),
            4 => self.run_in::<128>(random),
            _ => self.run_in::<256>(random),
        }
    }

    fn run_in<const E: usize>(&self, random: &mut Random) -> Tally {
        let content = if self.garbage { vec![0xA5; 2 * E] } else { vec![0xFF; 2 * E] };
        let (expected, history) = (Expected::NOTHING, Vec::new());
        let mut tally = Tally::default();
        let device = Device { content, expected, next: 1, history };
        device.go_on::<E>(self.lives, 2, random, &mut tally);
        tally
    }
}

impl Device {
    /// Runs every continuation with this number of lives and at most this number of cuts, and a final power-on.
    fn go_on<const E: usize>(
        &self,
        lives: usize,
        cuts: usize,
        random: &mut Random,
        tally: &mut Tally,
    ) {
        if lives == 0 {
            self.then(&self.flash::<E>(random), 0, "power-on".to_owned(), tally);
            return;
        }
        let mut steps = 0;
        for stores in 0..=STORES {
            let flash = self.flash::<E>(random);
            let then = self.then(&flash, stores, format!("{stores} stores"), tally);
            let Some(device) = then else { continue };
            device.go_on::<E>(lives - 1, cuts, random, tally);
            steps = flash.writes() + flash.erases();
        }
        if cuts == 0 {
            return;
        }
        for step in 0..steps {
            let flash = self.flash::<E>(random);
            flash.cut_power_after(step);
            tally.cuts += 1;
            let life = format!("{STORES} stores, cut in step {step}");
            if let Some(device) = self.then(&flash, STORES, life, tally) {
                device.go_on::<E>(lives - 1, cuts - 1, random, tally);
            }
        }
    }

    fn flash<const E: usize>(&self, random: &mut Random) -> Flash<4, E> {
        Flash::with_content(self.content.clone(), random.u64())
    }

    /// The device after one more life, or `None` if it has lost its settings.
    fn then<const E: usize>(
        &self,
        flash: &Flash<4, E>,
        stores: usize,
        life: String,
        tally: &mut Tally,
    ) -> Option<Self> {
        let mut expected = self.expected.clone();
        let mut history = self.history.clone();
        history.push(life);
        match live(flash, &mut expected, self.next, stores) {
            Ok(next) => Some(Self { content: flash.content(), expected, next, history }),
            Err(loss) => {
                tally.losses.push(format!("{}: {loss}", history.join("; ")));
                None
            }
        }
    }
}

/// The number of stores between two erases of the board's flash, with a power cycle after each store.
pub fn stores_an_erase() -> u64 {
    let flash = BoardFlash::blank(0);
    let mut stores = 0;
    // The first erase formats; each of the next two comes when a bank is three quarters full.
    while flash.erases() < 3 {
        let (mut log, _) = Log::open(flash.clone());
        log.store(settings((stores % 100) as u8 + 1)).expect("an open makes room");
        stores += 1;
    }
    stores / 2
}
