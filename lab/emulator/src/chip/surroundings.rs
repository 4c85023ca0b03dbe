//! The chip's external circuit: the supply and the crystal.

use super::{Access, Chip, Width};
use crate::Time;

/// FLASH_ACR, which limits the supply.
const FLASH_ACR: u32 = 0x4002_3C00;

impl Chip {
    /// Sets the supply in mV. It affects only the voltage detector and the checks of legal settings; a reset at low
    /// supply is left to the board.
    pub fn set_supply(&mut self, mv: u32) {
        self.pwr.set_supply(mv);
        self.flash.set_supply(mv);
    }

    /// Reports that the supply has become too low for the clock of a chip that runs.
    pub fn check_supply(&mut self, now: Time) {
        if let Err(problem) = self.check_latency() {
            let access = Access { address: FLASH_ACR, width: Width::Word, now, pc: 0 };
            self.report(access, None, problem);
        }
    }

    /// Whether the supply is too low to leave the reset, if `was_low`, or to stay out of it.
    pub fn supply_is_too_low(&self, was_low: bool) -> bool {
        self.variant.thresholds.reset(self.flash.bor_lev(), self.pwr.supply(), was_low)
    }

    pub fn stop_crystal(&mut self, now: Time) {
        self.rcc.stop_crystal(now);
        self.follow_clocks(now);
        if self.is_stopped() {
            // The controllers have no clock and their pins are constant; they are assumed to be recessive.
            self.cans.iter_mut().for_each(|can| can.reset());
            self.share_filters();
        }
    }

    /// Allows the crystal to oscillate again from `now` on.
    pub fn start_crystal(&mut self, now: Time) {
        self.rcc.start_crystal(now);
    }

    /// Whether SYSCLK has stopped, until a reset.
    pub fn is_stopped(&self) -> bool {
        self.rcc.is_stopped()
    }

    /// Raises the non-maskable interrupt of an STM32G4 for an error of the parity of its SRAM.
    pub fn fail_parity(&mut self) {
        self.syscfg.fail_parity();
    }

    /// The level of the non-maskable interrupt.
    pub fn nmi(&self) -> bool {
        self.rcc.nmi() || self.flash.nmi() || self.syscfg.nmi()
    }
}
