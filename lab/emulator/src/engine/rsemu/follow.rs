//! Synchronisation of the core with the chip's interrupts, clock and flash.

use std::sync::{Arc, atomic::Ordering::Relaxed};

use rsemu::cpu::arm::v7m::sys::Exception;

use super::{Halt, Rsemu, lock};
use crate::{Time, chip::Chip};

impl Rsemu {
    /// Sets the interrupt inputs to the chip's current levels.
    pub(super) fn sync_irqs(&mut self, chip: &Chip) {
        let chip_irqs = chip.irqs() | self.fall_late(self.irqs & !chip.irqs());
        if chip.nmi() {
            self.cpu.with_sys(|sys| {
                if !sys.is_active(Exception::NMI) {
                    sys.set_pending(Exception::NMI, true);
                }
            });
        }
        let mut changed = self.irqs ^ chip_irqs;
        if changed != 0 || chip.nmi() {
            self.settled = None;
        }
        while changed != 0 {
            let irq = changed.trailing_zeros();
            changed &= changed - 1;
            self.cpu.set_irq(irq as u16, chip_irqs >> irq & 1 == 1);
        }
        self.irqs = chip_irqs;
    }

    /// The lines among those that have fallen at the chip that the core still sees.
    fn fall_late(&mut self, fallen: u128) -> u128 {
        let fall_at = match fallen {
            0 => None,
            _ => Some(self.fall_at.unwrap_or(self.cycles + self.late_lines)),
        };
        self.fall_at = fall_at.filter(|fall| self.cycles < *fall);
        if self.fall_at.is_some() { fallen } else { 0 }
    }

    /// Updates the core to the chip's interrupts and clock.
    pub(super) fn sync(&mut self, chip: &Chip) {
        self.sync_irqs(chip);
        let hclk = chip.clocks().hclk;
        if hclk != self.clock.clock() {
            self.clock.change(hclk, self.cycles);
            self.link.set_clock(self.clock);
        }
        self.space.put_at_zero(chip.at_zero());
        if self.flash_waits {
            self.link.accelerator().configure(chip.flash().access_control());
        }
        if chip.is_stopped() {
            self.stalled_until = u64::MAX;
        }
    }

    /// Updates the core after the program wrote to the chip.
    pub(super) fn after_write(&mut self, until: Time) -> Option<Halt> {
        let chip = Arc::clone(&self.chip);
        let mut chip = lock(&chip);
        self.sync(&chip);
        self.take_flash(&mut chip);
        self.link.flash_busy.store(chip.flash().operation_end().is_some(), Relaxed);
        if chip.take_can_written() {
            Some(Halt::CanWritten)
        } else if chip.next_event() < until {
            Some(Halt::ChipWritten)
        } else {
            None
        }
    }
}
