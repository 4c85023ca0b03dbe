//! Power cuts in the settings log on a flash in memory: all short histories, with one or two cuts in any of their
//! steps.

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

/// The first content of a flash: erased, or left by something else.
const BLANK: u8 = 0xFF;
const GARBAGE: u8 = 0xA5;

/// All histories of one kind: their description, and what runs them, panics if settings are lost, and returns the number
/// of power cuts.
pub type Histories = (String, Box<dyn Fn(&mut Random) -> u64>);

/// The histories that are tried, with at most these lives: those of settings, those of parameters.
pub fn all((lives, of_parameters): (usize, usize)) -> [Histories; 11] {
    [
        histories::<0, 4, 128>(lives, BLANK),
        histories::<0, 4, 96>(lives, BLANK),
        histories::<0, 4, 128>(lives - 1, GARBAGE),
        histories::<0, 4, 256>(lives - 1, BLANK),
        histories::<PACKED_LEN, 4, 192>(of_parameters, BLANK),
        histories::<PACKED_LEN, 4, 256>(of_parameters, BLANK),
        histories::<PACKED_LEN, 4, 512>(of_parameters, BLANK),
        // Units of a word are those of the board. Smaller ones have more steps.
        histories::<0, 1, 128>(lives - 1, BLANK),
        histories::<0, 2, 128>(lives - 1, BLANK),
        histories::<PACKED_LEN, 1, 256>(of_parameters - 1, BLANK),
        histories::<PACKED_LEN, 2, 256>(of_parameters - 1, BLANK),
    ]
}

/// The histories of a device with room for `P` bytes of parameters and two banks of `E` bytes, programmed in units of
/// `W` bytes.
fn histories<const P: usize, const W: usize, const E: usize>(lives: usize, first: u8) -> Histories {
    let content = if first == BLANK { "blank" } else { "garbage" };
    let stored = if P > 0 { ", parameters" } else { "" };
    let records = E / 32;
    let unit = if W == 1 { "1 byte".to_owned() } else { format!("{W} bytes") };
    let name = format!(
        "unit of {unit}, {lives} power-ons, 2 banks of {records} records, {content} first{stored}"
    );
    let run = move |random: &mut Random| {
        let flash = Flash::<W, E>::with_content(vec![first; 2 * E], 0);
        Device { flash, expected: Expected::<P>::nothing() }.go_on(lives, 2, random)
    };
    (name, Box::new(run))
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
