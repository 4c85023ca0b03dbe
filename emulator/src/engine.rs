//! What a board needs of a CPU: to run until a time, to be interrupted, to sleep, to be looked into.

pub mod clock;
pub mod rsemu;

use crate::Time;

/// Why a CPU stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Halt {
    /// The time was reached.
    Deadline,
    /// The program wrote to the chip's CAN controller.
    CanWritten,
    /// The program asked for a reset with `AIRCR.SYSRESETREQ`.
    ResetRequested,
    /// The chip changed what it will do next by itself.
    ChipWritten,
}

/// A Cortex-M4F with the memories and peripherals of a [`Chip`](crate::chip::Chip).
///
/// Flash wait states cost nothing (the accelerator hides them), and DWT_CYCCNT counts through sleep.
pub trait Engine: Send {
    /// Starts over from the vector table at `now`, after the span `hold` in which nothing runs.
    fn reset(&mut self, now: Time, hold: Time);

    /// Runs until [`now`](Self::now) is at or past `until`, by less than one instruction, or until a halt.
    fn run(&mut self, until: Time) -> Halt;

    /// The time that the CPU has reached.
    fn now(&self) -> Time;

    /// When the CPU has something to do if nothing interrupts it: now, or the end of its sleep or stall.
    fn wake_time(&self) -> Time;

    /// Core clock cycles since the engine was made, sleep and stalls included.
    fn cycles(&self) -> u64;

    /// Core clock cycles since the engine was made in which the CPU was not asleep.
    fn busy_cycles(&self) -> u64;

    /// Copies out of RAM or flash. False, and nothing copied, outside of them.
    fn read_memory(&self, address: u32, bytes: &mut [u8]) -> bool;

    /// Copies into RAM. False, and nothing copied, outside of it.
    fn write_memory(&mut self, address: u32, bytes: &[u8]) -> bool;

    /// Takes over what changed in the chip's flash from outside of a run.
    fn sync_flash(&mut self);

    /// Fills RAM and core-coupled memory with what a power-on leaves: anything, made from `seed`.
    fn scramble_ram(&mut self, seed: u64);

    /// What stopped the program for good, if the core is locked up.
    fn lockup(&self) -> Option<Lockup>;

    /// Address of the next instruction.
    fn pc(&self) -> u32;

    /// The stack pointer in use.
    fn sp(&self) -> u32;
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
