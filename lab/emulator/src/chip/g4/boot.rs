//! The memory that the core starts from (RM0440 2.6): PB8 is BOOT0, and is sampled at each reset.

use crate::{
    Time,
    can::Level,
    chip::{Access, Chip, FLASH_BASE, Pin, Problem, Width, part::Family},
};

const BOOT0: Pin = Pin('B', 8);
const WHY: &str = "PB8, which is BOOT0, was high at the reset: the boot loader in ROM runs instead of the program";

/// What BOOT0 has led to.
#[derive(Debug, Default)]
pub struct Boot {
    /// The board's transceiver drives the pin. Known once a program receives there.
    has_transceiver: bool,
    /// The reset before the transceiver was known is repeated.
    repeats: bool,
    /// The core runs the boot loader in ROM until the next reset.
    in_loader: bool,
}

impl Boot {
    pub fn in_loader(&self) -> bool {
        self.in_loader
    }

    pub fn repeats(&self) -> bool {
        self.repeats
    }
}

impl Chip {
    /// Learns that the board's transceiver is at BOOT0, as the program receives there.
    pub(in crate::chip) fn note_receive_pin(&mut self) {
        let receives = self.part.family() == Family::G4
            && self.gpio.alternate_function(BOOT0).is_some_and(|function| {
                let mut pins = self.part.can_pins(0).iter();
                pins.any(|[receive, _]| *receive == (BOOT0, function))
            });
        if receives && !self.boot.has_transceiver {
            self.boot.has_transceiver = true;
            self.boot.repeats = true;
        }
    }

    /// Samples the pin at a reset.
    pub(in crate::chip) fn sample_boot_pin(&mut self, now: Time) {
        self.boot.repeats = false;
        if self.part.family() != Family::G4 {
            return;
        }
        let is_recessive = self.cans[0].controller().wire_level() == Level::Recessive;
        let of_transceiver = self.boot.has_transceiver && is_recessive;
        let is_high = self.gpio.outside(BOOT0).unwrap_or(of_transceiver);
        self.boot.in_loader = self.flash.starts_loader(is_high);
        if self.boot.in_loader {
            let (width, pc) = (Width::Word, FLASH_BASE);
            self.report(Access { address: 0, width, now, pc }, None, Problem::Misuse(WHY));
        }
    }
}
