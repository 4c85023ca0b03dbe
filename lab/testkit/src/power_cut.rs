//! Lives of a device with a settings log whose power fails in any program or erase step: nothing acknowledged is lost.

#[cfg(feature = "image")]
pub mod image;

use canopen_node::settings::{Found, Log};

use super::{
    flash::Flash,
    random::Random,
    settings::{Content, open_with_parameters, parameters, settings},
};

/// The starts in a row that may be cut while they format a flash.
pub const MOST_CUT_FORMATS: usize = 2;
/// The starts in a row that may be cut, or in which an operation may fail, after a start that was complete: each takes
/// one of the eight places that are kept for starts.
pub const MOST_CUT_STARTS: u32 = 7;

/// The number of stores in the lives after the first cut.
const LATER_STORES: usize = 4;

/// What the next power-on of a device may find. It has room for `P` bytes of parameters; for 0 bytes it stores settings
/// alone.
#[derive(Clone)]
pub struct Expected<const P: usize> {
    /// The content last stored or found.
    known: Content,
    /// The contents of later stores that the power cuts interrupted.
    attempted: Vec<Content>,
    /// The number of the next store.
    next: u16,
    /// A start was complete.
    pub is_formatted: bool,
}

impl<const P: usize> Expected<P> {
    /// Parameters take more of a bank.
    const STORES_A_POWER_ON: usize = if P == 0 { 3 } else { 2 };

    /// The expectation for a new device, or one full of garbage.
    pub fn nothing() -> Self {
        Self::of((None, Vec::new()))
    }

    /// The expectation for a device with this content.
    pub fn of(known: Content) -> Self {
        Self { known, attempted: Vec::new(), next: 1, is_formatted: false }
    }

    /// The content after the next store: of settings, of parameters, of both, or one without parameters.
    fn next(&mut self) -> Content {
        let n = self.next;
        self.next += 1;
        let old = self.attempted.last().unwrap_or(&self.known);
        match n % 5 {
            _ if P == 0 => (Some(settings(n)), Vec::new()),
            0 => (Some(settings(n)), Vec::new()),
            1 | 3 => (Some(settings(n)), parameters(n, 4 + usize::from(n % 31))),
            2 => (Some(settings(n)), old.1.clone()),
            _ => (old.0.or(Some(settings(n))), parameters(n, 20)),
        }
    }

    /// Lives of a device until its power fails: it is powered on, stores, and is powered on again, until it has made a
    /// number of stores. Panics if a power-on finds something else than expected, or a store erases.
    pub fn live<const W: usize, const E: usize>(&mut self, flash: &Flash<W, E>, stores: usize) {
        for made in (0..stores).step_by(Self::STORES_A_POWER_ON).chain([stores]) {
            flash.cycle_power();
            self.power_on(flash, if made < stores { Self::STORES_A_POWER_ON } else { 0 });
            if !flash.is_powered() {
                return;
            }
        }
    }

    /// A power-on and this number of stores, until the power fails. Returns whether the start was complete.
    pub fn power_on<const W: usize, const E: usize>(
        &mut self,
        flash: &Flash<W, E>,
        stores: usize,
    ) -> bool {
        let may_fail = flash.is_faulty();
        let (mut log, read, found) = open_with_parameters::<P, W, E>(flash);
        if !flash.is_powered() {
            return false;
        }
        assert!(
            read == self.known || self.attempted.contains(&read),
            "{found:?} {read:?}, but {:?} is known and {:?} were attempted",
            self.known,
            self.attempted
        );
        let is_complete = !matches!(found, Found::MediumFailed(_) | Found::OtherLayout);
        assert!(is_complete || may_fail, "{found:?}");
        if is_complete {
            self.attempted.clear();
        } else {
            // What was found could not be made certain.
            self.attempted.push(self.known.clone());
        }
        self.known = read;
        self.is_formatted |= is_complete;
        for _ in 0..stores {
            let new = self.next();
            let erases = flash.erases();
            let is_stored = store(&mut log, &new);
            assert_eq!(flash.erases(), erases, "only open erases");
            if is_stored {
                self.known = new;
                self.attempted.clear();
            } else if !flash.is_powered() {
                self.attempted.push(new);
                break;
            }
        }
        is_complete
    }

    /// Program and erase steps of a life without a power cut.
    pub fn steps<const W: usize, const E: usize>(
        &self,
        flash: &Flash<W, E>,
        stores: usize,
    ) -> usize {
        let flash = flash.duplicate(0);
        self.clone().live(&flash, stores);
        flash.writes() + flash.erases()
    }
}

/// Makes a content persistent by the call that a board would use; returns whether that was acknowledged.
pub fn store<const P: usize, const W: usize, const E: usize>(
    log: &mut Log<Flash<W, E>, P>,
    new: &Content,
) -> bool {
    let settings = new.0.expect("settings");
    if new.1 == log.parameters() {
        return log.store(settings).is_ok();
    }
    log.store_with_parameters(settings, &new.1).is_ok()
}

/// Runs a block with every kind of flash: with program units of `W` bytes and sectors of `E` bytes, which have room for
/// six places.
#[macro_export]
macro_rules! with_each_kind {
    (|$w:ident, $e:ident| $body:block) => {{
        fn run<const $w: usize, const $e: usize>() $body
        run::<1, 256>();
        run::<2, 256>();
        run::<4, 256>();
        run::<8, { 6 * 48 }>();
        run::<16, { 6 * 64 }>();
        run::<32, { 6 * 96 }>();
    }};
}

/// Cuts the power in each step of a life of a device with this content of its flash, and then in one of `every` steps
/// of the next life; a third life checks.
pub fn cut_twice<const P: usize, const W: usize, const E: usize>(
    content: &[u8],
    stores: usize,
    every: usize,
) {
    let mut random = Random::from_environment();
    let new = Flash::<W, E>::with_content(content.to_vec(), 0);
    for first in 0..Expected::<P>::nothing().steps(&new, stores) {
        let flash = new.duplicate(random.u64());
        let mut expected = Expected::<P>::nothing();
        flash.cut_power_after(first);
        expected.live(&flash, stores);
        assert!(!flash.is_powered(), "step {first}");
        let from = random.within(0..every as u64) as usize;
        for second in (from..expected.steps(&flash, LATER_STORES)).step_by(every) {
            let flash = flash.duplicate(random.u64());
            let mut expected = expected.clone();
            flash.cut_power_after(second);
            expected.live(&flash, LATER_STORES);
            flash.power_on();
            expected.live(&flash, LATER_STORES);
        }
    }
}

/// Cuts the power in each step, and then in one of the next life, while the log moves from a bank that is nearly full
/// to the other one, and erases the first. A bank has this number of sectors. Returns the number of cuts.
pub fn cut_while_moving<const P: usize, const W: usize, const E: usize>(
    sectors: usize,
    random: &mut Random,
) -> u64 {
    /// The stores in a life, of which at least one moves.
    const STORES: usize = 12;
    let flash = Flash::<W, E>::blank_with_sectors(sectors, 0);
    let mut expected = Expected::<P>::nothing();
    expected.power_on(&flash, 0);
    let formatted = flash.erases();
    let mut before = (flash.duplicate(0), expected.clone());
    let mut is_near = false;
    while flash.erases() == formatted {
        if is_near {
            before = (flash.duplicate(0), expected.clone());
        }
        is_near = !is_near;
        expected.power_on(&flash, STORES / 4);
    }
    let (flash, expected) = before;
    let steps = expected.steps(&flash, STORES);
    for cut in 0..steps {
        let flash = flash.duplicate(random.u64());
        let mut expected = expected.clone();
        flash.cut_power_after(cut);
        expected.live(&flash, STORES);
        flash.power_on();
        flash.cut_power_after(random.within(0..30) as usize);
        expected.live(&flash, STORES);
        flash.power_on();
        expected.live(&flash, STORES);
        assert_ne!(flash.erases(), 0, "it has moved");
    }
    2 * steps as u64
}

/// Cuts the power in any step of each life in this number of random histories, in banks of this number of sectors.
pub fn cut_at_random<const P: usize, const W: usize, const E: usize>(
    sectors: usize,
    histories: usize,
    most_steps: u64,
    most_stores: u64,
) {
    let mut random = Random::from_environment();
    for _ in 0..histories {
        let flash = Flash::<W, E>::blank_with_sectors(sectors, random.u64());
        let mut expected = Expected::<P>::nothing();
        for life in 0..20 {
            if life < MOST_CUT_FORMATS || expected.is_formatted {
                flash.cut_power_after(random.within(0..most_steps) as usize);
            }
            expected.live(&flash, random.within(0..most_stores) as usize);
            flash.power_on();
        }
        expected.live(&flash, LATER_STORES);
    }
}
