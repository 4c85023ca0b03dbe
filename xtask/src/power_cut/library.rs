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
    settings::{open_with_parameters, parameters},
};

/// The greatest number of stores in a life, which fills a bank of four records.
const STORES: usize = 3;

/// The longest parameters, which take the space of two records.
const PARAMETERS: usize = 40;

/// All histories with a number of lives, in a flash of two banks of a number of records, initially blank or garbage.
pub struct Histories {
    lives: usize,
    records: usize,
    garbage: bool,
    parameters: bool,
}

/// Settings and packed parameters.
type Content = (Settings, Vec<u8>);

/// A device between two lives: its flash, and the settings that it must find there.
struct Device<const E: usize> {
    flash: Flash<4, E>,
    expected: Expected<Content>,
    /// The number of the next settings to store.
    next: u8,
    /// A description of its history.
    history: Vec<String>,
}

impl fmt::Display for Histories {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { lives, records, garbage, parameters } = self;
        let content = if *garbage { "garbage" } else { "blank" };
        let stored = if *parameters { ", parameters" } else { "" };
        write!(f, "{lives} power-ons, 2 banks of {records} records, {content} first{stored}")
    }
}

/// Different settings for each `number`.
fn settings(number: u8) -> Settings {
    Settings::new(BitRate::ALL[usize::from(number % 8)].into())
        .with_node_id(NodeId::new(number % 128))
        .with_heartbeat_ms(number.into())
}

/// The content after store `number`: of settings, of both, or of parameters alone; settings alone in a log without
/// parameters.
fn content<const P: usize>(number: u8, (settings_before, before): &Content) -> Content {
    match number % 4 {
        _ if P == 0 => (settings(number), Vec::new()),
        0 => (settings(number), before.clone()),
        1 => (settings(number), parameters(number.into(), 10)),
        2 => (*settings_before, parameters(number.into(), PARAMETERS - 6)),
        _ => (settings(number), parameters(number.into(), 30)),
    }
}

/// One life: power-on and a number of stores, until the power fails. Returns a description of any loss.
fn live<const P: usize, const W: usize, const E: usize>(
    flash: &Flash<W, E>,
    expected: &mut Expected<Content>,
    mut next: u8,
    stores: usize,
) -> Result<u8, String> {
    let (mut log, (settings_found, parameters_found), found) =
        open_with_parameters::<P, W, E>(flash);
    if !flash.is_powered() {
        return Ok(next);
    }
    let before = expected.clone();
    let read = settings_found.map(|settings| (settings, parameters_found));
    if !expected.admits(read.clone()) || matches!(found, Found::MediumFailed(_)) {
        let named = |content: &Option<Content>| {
            let (settings, parameters) = content.clone().unzip();
            format!("{} with {:02X?}", Named(settings), parameters.unwrap_or_default())
        };
        let Expected { known, attempted } = before;
        return Err(format!(
            "{found:?}: {}, not {} or {}",
            named(&read),
            named(&known),
            named(&attempted)
        ));
    }
    for _ in 0..stores {
        let before = expected.known.clone().unwrap_or((settings(0), Vec::new()));
        let new = content::<P>(next, &before);
        expected.attempt(new.clone());
        next += 1;
        match log.store_with_parameters(new.0, &new.1) {
            Ok(()) => expected.acknowledge(),
            Err(_) if !flash.is_powered() => break,
            // The bank is full until the next power-on.
            Err(_) => expected.attempted = None,
        }
    }
    Ok(next)
}

impl Histories {
    /// The histories that are tried, with at most these lives: those of settings, those of parameters.
    pub fn all((lives, lives_of_parameters): (usize, usize)) -> Vec<Self> {
        let settings =
            |lives, records, garbage| Self { lives, records, garbage, parameters: false };
        let parameters = |records| Self {
            lives: lives_of_parameters,
            records,
            garbage: false,
            parameters: true,
        };
        vec![
            settings(lives, 4, false),
            settings(lives, 3, false),
            settings(lives - 1, 4, true),
            settings(lives - 1, 8, false),
            parameters(6),
            parameters(8),
            parameters(16),
        ]
    }

    /// Runs all histories.
    pub fn run(&self, random: &mut Random) -> Tally {
        match (self.records, self.parameters) {
            (3, false) => self.run_in::<0, 96>(random),
            (4, false) => self.run_in::<0, 128>(random),
            (_, false) => self.run_in::<0, 256>(random),
            (6, true) => self.run_in::<PARAMETERS, 192>(random),
            (8, true) => self.run_in::<PARAMETERS, 256>(random),
            (_, true) => self.run_in::<PARAMETERS, 512>(random),
        }
    }

    fn run_in<const P: usize, const E: usize>(&self, random: &mut Random) -> Tally {
        let content = if self.garbage { vec![0xA5; 2 * E] } else { vec![0xFF; 2 * E] };
        let (expected, history) = (Expected::NOTHING, Vec::new());
        let mut tally = Tally::default();
        let flash = Flash::with_content(content, 0);
        let device = Device::<E> { flash, expected, next: 1, history };
        device.go_on::<P>(self.lives, 2, random, &mut tally);
        tally
    }
}

impl<const E: usize> Device<E> {
    /// Runs every continuation with this number of lives and at most this number of cuts, and a final power-on.
    fn go_on<const P: usize>(
        &self,
        lives: usize,
        cuts: usize,
        random: &mut Random,
        tally: &mut Tally,
    ) {
        if lives == 0 {
            self.then::<P>(&self.flash(random), 0, "power-on".to_owned(), tally);
            return;
        }
        let mut steps = 0;
        for stores in 0..=STORES {
            let flash = self.flash(random);
            let then = self.then::<P>(&flash, stores, format!("{stores} stores"), tally);
            let Some(device) = then else { continue };
            device.go_on::<P>(lives - 1, cuts, random, tally);
            steps = flash.writes() + flash.erases();
        }
        if cuts == 0 {
            return;
        }
        for step in 0..steps {
            let flash = self.flash(random);
            flash.cut_power_after(step);
            tally.cuts += 1;
            let life = format!("{STORES} stores, cut in step {step}");
            if let Some(device) = self.then::<P>(&flash, STORES, life, tally) {
                device.go_on::<P>(lives - 1, cuts - 1, random, tally);
            }
        }
    }

    /// The flash after a power-on: interrupted words may read differently.
    fn flash(&self, random: &mut Random) -> Flash<4, E> {
        self.flash.duplicate(random.u64())
    }

    /// The device after one more life, or `None` if it has lost its settings.
    fn then<const P: usize>(
        &self,
        flash: &Flash<4, E>,
        stores: usize,
        life: String,
        tally: &mut Tally,
    ) -> Option<Self> {
        let mut expected = self.expected.clone();
        let mut history = self.history.clone();
        history.push(life);
        match live::<P, 4, E>(flash, &mut expected, self.next, stores) {
            Ok(next) => Some(Self { flash: flash.clone(), expected, next, history }),
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
    // Two erases format the flash; each of the next two follows the move from a full bank.
    while flash.erases() < 4 {
        let (mut log, _) = Log::open(flash.clone());
        log.store(settings((stores % 100) as u8 + 1)).expect("an open makes room");
        stores += 1;
    }
    stores / 2
}
