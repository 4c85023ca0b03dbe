//! Power cuts in the settings log on a flash in memory of every program unit: all short histories, with one or two cuts
//! in any of their steps, and moves to the other bank in sectors as large as those of a chip.

use canopen_node::settings::Log;
use testkit::{
    flash::{BoardFlash, Flash},
    power_cut::{Expected, cut_while_moving},
    random::Random,
    settings::settings,
};

/// The greatest number of stores in a life.
const STORES: usize = 3;

/// The longest parameters, which take the space of two records.
const PACKED_LEN: usize = 40;

/// The first content of a flash: erased, or left by something else.
const BLANK: u8 = 0xFF;
const GARBAGE: u8 = 0xA5;

/// All histories of one kind.
pub struct Histories {
    /// The program unit of the flash in bytes.
    pub unit: usize,
    pub description: String,
    /// Runs them, panics if settings are lost, and returns the number of power cuts.
    pub run: Box<dyn Fn(&mut Random) -> u64>,
}

/// The histories that are tried, with at most these lives: those of settings, those of parameters.
pub fn all((lives, of_parameters): (usize, usize)) -> Vec<Histories> {
    let mut all = vec![
        // Eight places are kept for starts.
        histories::<0, 4, { 12 * 40 }>(lives, BLANK),
        histories::<0, 4, { 12 * 40 }>(lives - 1, GARBAGE),
        histories::<0, 4, { 16 * 40 }>(lives - 1, BLANK),
        histories::<PACKED_LEN, 4, { 16 * 40 }>(of_parameters, BLANK),
        histories::<PACKED_LEN, 4, { 20 * 40 }>(of_parameters, BLANK),
        // Units of a word are those of the board. Smaller ones have more steps.
        histories::<0, 1, { 12 * 40 }>(lives - 1, BLANK),
        histories::<0, 2, { 12 * 40 }>(lives - 1, BLANK),
        histories::<PACKED_LEN, 1, { 16 * 40 }>(of_parameters - 1, BLANK),
        histories::<PACKED_LEN, 2, { 16 * 40 }>(of_parameters - 1, BLANK),
        histories::<0, 8, { 12 * 48 }>(lives - 1, BLANK),
        histories::<0, 16, { 12 * 64 }>(lives - 1, BLANK),
        histories::<0, 32, { 12 * 96 }>(lives - 1, BLANK),
        histories::<0, 8, { 12 * 48 }>(lives - 1, GARBAGE),
        histories::<PACKED_LEN, 8, { 14 * 48 }>(of_parameters - 1, BLANK),
        histories::<PACKED_LEN, 16, { 14 * 64 }>(of_parameters - 1, BLANK),
        histories::<PACKED_LEN, 32, { 14 * 96 }>(of_parameters - 1, BLANK),
    ];
    all.extend(moves::<1>());
    all.extend(moves::<2>());
    all.extend(moves::<4>());
    all.extend(moves::<8>());
    all.extend(moves::<16>());
    all.extend(moves::<32>());
    all
}

/// Moves from one bank to the other in flash that is programmed in units of `W` bytes.
fn moves<const W: usize>() -> [Histories; 3] {
    let moves = |sectors: &str, run: fn(&mut Random) -> u64| Histories {
        unit: W,
        description: format!("{}, moves between banks of {sectors}", unit(W)),
        run: Box::new(run),
    };
    [
        moves("2 sectors of 2 KB", |random| cut_while_moving::<0, W, 0x800>(2, random)),
        moves("a sector of 16 KB", |random| cut_while_moving::<0, W, 0x4000>(1, random)),
        moves("2 sectors of 2 KB, parameters", |random| {
            cut_while_moving::<PACKED_LEN, W, 0x800>(2, random)
        }),
    ]
}

fn unit(bytes: usize) -> String {
    if bytes == 1 { "unit of 1 byte".to_owned() } else { format!("unit of {bytes} bytes") }
}

/// The histories of a device with room for `P` bytes of parameters and two banks of `E` bytes, programmed in units of
/// `W` bytes.
fn histories<const P: usize, const W: usize, const E: usize>(lives: usize, first: u8) -> Histories {
    let content = if first == BLANK { "blank" } else { "garbage" };
    let stored = if P > 0 { ", parameters" } else { "" };
    let places = E / (32 + 2 * W.max(4));
    let description = format!(
        "{}, {lives} power-ons, 2 banks of {places} places, {content} first{stored}",
        unit(W)
    );
    let run = move |random: &mut Random| {
        let flash = Flash::<W, E>::with_content(vec![first; 2 * E], 0);
        Device { flash, expected: Expected::<P>::nothing() }.go_on(lives, 2, random)
    };
    Histories { unit: W, description, run: Box::new(run) }
}

/// A device between two lives: its flash, and what it must find there.
struct Device<const P: usize, const W: usize, const E: usize> {
    flash: Flash<W, E>,
    expected: Expected<P>,
}

impl<const P: usize, const W: usize, const E: usize> Device<P, W, E> {
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
