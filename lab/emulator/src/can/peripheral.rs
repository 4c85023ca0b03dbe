//! What chip, board and network need of a CAN peripheral, whatever its registers are.

use std::{
    fmt,
    ops::{Deref, DerefMut},
};

use super::{Bxcan, Clock, Fdcan, Frame, Pins, Station, bxcan::CanVariant};
use crate::Time;

/// An access by the program, or a change that it can see, that belongs in a trace of the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Note {
    /// The program requested the transmission of this mailbox or transmit buffer, 0..=2.
    Requested { mailbox: usize, frame: Frame },
    /// The program emptied this mailbox, whose frame was not sent.
    Aborted { mailbox: usize, frame: Frame },
    /// A new value was written to BTR or NBTP.
    BitTiming(u32),
    /// INAK or INIT was set.
    InitializationEntered,
    /// INAK or INIT was cleared.
    InitializationLeft,
}

/// The registers of a CAN peripheral over a protocol controller.
pub trait Peripheral: Station + fmt::Debug + Send {
    /// Selects the variant of a bxCAN, nominal at first; others have none.
    fn set_variant(&mut self, _: CanVariant) {}

    /// Resets every register. The clock stays, and a frame under way is cut off.
    fn reset(&mut self);

    /// Sets the clock in which the time quanta are counted.
    fn set_clock(&mut self, clock: Clock);

    /// Connects its pins to the transceiver, or disconnects them, from `from` on. Both are connected at first.
    fn connect(&mut self, pins: Pins, from: Time) {
        self.controller().connect(pins, from);
    }

    /// Levels of the interrupt lines as of the program's latest write or [`update_irq`](Self::update_irq).
    fn irq(&self) -> u8;

    /// The levels that the state of the bus asks for.
    ///
    /// The bus runs ahead of a sleeping CPU. The lines change only when the CPU has slept until that time.
    fn interrupts(&self) -> u8;

    /// Updates the interrupt lines to the state of the bus.
    fn update_irq(&mut self);

    /// Whether [`update_irq`](Self::update_irq) would change a line.
    fn irq_changes(&self) -> bool {
        self.interrupts() != self.irq()
    }

    /// Whether the program uses it.
    fn is_in_use(&self) -> bool;

    /// The nominal bit rate in bit/s, from bit timing and clock.
    fn bit_rate(&self) -> u32;

    fn is_silent(&self) -> bool;

    /// Whether this write lets it take part in the bus.
    fn is_start(&self, offset: u32, value: u32) -> bool;

    /// The word at `offset` from the base address; `None` where the reference manual has no register.
    fn read(&self, offset: u32, now: Time) -> Option<u32>;

    /// The same, read by the program, which may have an effect.
    fn load(&mut self, offset: u32, now: Time) -> Option<u32> {
        self.read(offset, now)
    }

    /// Writes a word at `offset` from the base address.
    ///
    /// Returns false where there is no register, or if what is written is not modelled.
    fn write(&mut self, offset: u32, value: u32, now: Time) -> bool;

    /// The notes since the last call, in order of time.
    fn take_notes(&mut self) -> Vec<(Time, Note)>;
}

/// A CAN peripheral of a chip.
#[derive(Debug)]
pub enum Can {
    Bxcan(Bxcan),
    Fdcan(Fdcan),
}

impl Deref for Can {
    type Target = dyn Peripheral;

    fn deref(&self) -> &Self::Target {
        match self {
            Self::Bxcan(bxcan) => bxcan,
            Self::Fdcan(fdcan) => fdcan,
        }
    }
}

impl DerefMut for Can {
    fn deref_mut(&mut self) -> &mut Self::Target {
        match self {
            Self::Bxcan(bxcan) => bxcan,
            Self::Fdcan(fdcan) => fdcan,
        }
    }
}
