//! Power cuts in the settings log on a flash in memory: all short histories, with one or two cuts in any of their
//! steps.

use std::fmt;

use canopen_node::settings::Log;
use testkit::{
    flash::{BoardFlash, Flash},
    power_cut::Expected,
    random::Random,
    settings::settings,
};

/// The greatest number of stores in a life, which fills a bank of four records.
const STORES: usize = 3;

/// The longest parameters, which take the space of two records.
const PACKED_LEN: usize = 40;

/// All histories with a number of lives, in a flash of two banks of a number of records, initially blank or garbage.
pub struct Histories {
    lives: usize,
    records: usize,
    garbage: bool,
    parameters: bool,
}

/// A device between two lives: its flash, and what it must find there.
struct Device<const P: usize, const E: usize> {
    flash: Flash<4, E>,
    expected: Expected<P>,
}

impl fmt::Display for Histories {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { lives, records, garbage, parameters } = self;
        let content = if *garbage { "garbage" } else { "blank" };
        let stored = if *parameters { ", parameters" } else { "" };
        write!(f, "{lives} power-ons, 2 banks of {records} records, {content} first{stored}")
    }
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

    /// Runs all histories; returns the number of power cuts.
    ///
    /// # Panics
    /// If settings are lost.
    pub fn run(&self, random: &mut Random) -> u64 {
        match (self.records, self.parameters) {
            (3, false) => self.run_in::<0, 96>(random),
            (4, false) => self.run_in::<0, 128>(random),
            (_, false) => self.run_in::<0, 256>(random),
            (6, true) => self.run_in::<PACKED_LEN, 192>(random),
            (8, true) => self.run_in::<PACKED_LEN, 256>(random),
            (_, true) => self.run_in::<PACKED_LEN, 512>(random),
        }
    }

    fn run_in<const P: usize, const E: usize>(&self, random: &mut Random) -> u64 {
        let content = if self.garbage { vec![0xA5; 2 * E] } else { vec![0xFF; 2 * E] };
        let flash = Flash::<4, E>::with_content(content, 0);
        Device { flash, expected: Expected::<P>::nothing() }.go_on(self.lives, 2, random)
    }
}

impl<const P: usize, const E: usize> Device<P, E> {
    /// Runs every continuation with this number of lives and at most this number of cuts, and a final power-on; returns
    /// the number of cuts.
    fn go_on(&self, lives: usize, cuts: usize, random: &mut Random) -> u64 {
        if lives == 0 {
            self.live(0, None, random);
            return 0;
        }
        let (mut count, mut steps) = (0, 0);
        for stores in 0..=STORES {
            let device = self.live(stores, None, random);
            count += device.go_on(lives - 1, cuts, random);
            steps = device.flash.writes() + device.flash.erases();
        }
        if cuts > 0 {
            for step in 0..steps {
                let device = self.live(STORES, Some(step), random);
                count += 1 + device.go_on(lives - 1, cuts - 1, random);
            }
        }
        count
    }

    /// The device after one more life, in which interrupted words may read differently.
    fn live(&self, stores: usize, cut: Option<usize>, random: &mut Random) -> Self {
        let flash = self.flash.duplicate(random.u64());
        cut.into_iter().for_each(|step| flash.cut_power_after(step));
        let mut expected = self.expected.clone();
        expected.power_on(&flash, stores);
        Self { flash, expected }
    }
}

/// The number of stores between two erases of the board's flash, with a power cycle after each store.
pub fn stores_an_erase() -> u64 {
    let flash = BoardFlash::blank(0);
    let mut stores = 0;
    // Two erases format the flash; each of the next two follows the move from a full bank.
    while flash.erases() < 4 {
        let (mut log, _) = Log::open(flash.clone());
        log.store(settings((stores % 100) as u16 + 1)).expect("an open makes room");
        stores += 1;
    }
    stores / 2
}
