//! The CPU of a board, its clock, and the reasons why it stops.

pub mod clock;
pub mod rsemu;

/// The reason why a CPU stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Halt {
    /// The time was reached.
    Deadline,
    /// The program wrote to the chip's CAN controller.
    CanWritten,
    /// The program asked for a reset with `AIRCR.SYSRESETREQ`.
    ResetRequested,
    /// The time of the chip's next action by itself has changed.
    ChipWritten,
}

/// The fault registers of a core that locked up (ARM DDI 0403, B1.5.15).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lockup {
    /// Configurable Fault Status Register.
    pub cfsr: u32,
    /// HardFault Status Register.
    pub hfsr: u32,
    /// BusFault Address Register.
    pub bfar: u32,
}
