//! What a chip needs of its board: the supply and the crystal.

use super::Chip;
use crate::Time;

impl Chip {
    /// Sets the supply in mV. It has no effect but on the voltage detector and on what is legal; a reset at too low a supply
    /// is the board's.
    pub fn set_supply(&mut self, mv: u32) {
        self.pwr.set_supply(mv);
        self.flash.set_supply(mv);
    }

    /// The crystal stops at `now`.
    pub fn stop_crystal(&mut self, now: Time) {
        self.rcc.stop_crystal(now);
        self.follow_clocks(now);
        if self.is_stopped() {
            // No clock moves its pin any more; taken as recessive.
            self.can1.reset();
        }
    }

    /// The crystal can swing again from `now` on.
    pub fn start_crystal(&mut self, now: Time) {
        self.rcc.start_crystal(now);
    }

    /// Whether SYSCLK has stopped, until a reset.
    pub fn is_stopped(&self) -> bool {
        self.rcc.is_stopped()
    }

    /// Level of the non-maskable interrupt.
    pub fn nmi(&self) -> bool {
        self.rcc.nmi()
    }
}
