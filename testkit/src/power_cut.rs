//! Lives of a device with a settings log whose power fails in any program or erase step: nothing acknowledged is lost.

#[cfg(feature = "image")]
pub mod image;

use canopen_node::settings::{Found, Log};

use super::{
    flash::Flash,
    random::Random,
    settings::{Content, open_with_parameters, parameters, settings},
};

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
        Self { known, attempted: Vec::new(), next: 1 }
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
        assert!(!matches!(found, Found::MediumFailed(_)), "{found:?}");
        self.known = read;
        self.attempted.clear();
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
        true
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

/// Cuts the power in any step of each life in this number of random histories, in banks of 256 bytes.
pub fn cut_at_random<const P: usize>(histories: usize, most_steps: u64, most_stores: u64) {
    let mut random = Random::from_environment();
    for _ in 0..histories {
        let flash = Flash::<4, 256>::blank(random.u64());
        let mut expected = Expected::<P>::nothing();
        for _ in 0..20 {
            flash.cut_power_after(random.within(0..most_steps) as usize);
            expected.live(&flash, random.within(0..most_stores) as usize);
            flash.power_on();
        }
        expected.live(&flash, LATER_STORES);
    }
}
