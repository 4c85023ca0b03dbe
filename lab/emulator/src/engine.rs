//! The interface between a board and a CPU: running until a time, interrupts, sleep, and inspection.

pub mod clock;
pub mod rsemu;

use crate::Time;

/// The reason why a CPU stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Halt {
    Deadline,
    /// The program wrote to the chip's CAN controller.
    CanWritten,
    /// The program asked for a reset with `AIRCR.SYSRESETREQ`.
    ResetRequested,
    /// The time of the chip's next action by itself has changed.
    ChipWritten,
}

/// A Cortex-M4F with the memories and peripherals of a [`Chip`](crate::chip::Chip).
///
/// Flash wait states cost nothing unless the chip's [`ChipVariant`](crate::chip::ChipVariant) states otherwise.
/// DWT_CYCCNT also counts during sleep.
pub trait Engine: Send {
    /// Restarts from the vector table at `now`, after the time `hold` in which nothing runs; never, if the chip stays in
    /// its boot loader.
    fn reset(&mut self, now: Time, hold: Time);

    /// Halts the core as a debugger does, or lets it go on.
    fn set_halted(&mut self, is_halted: bool);

    /// Restarts as [`reset`](Self::reset) does, but as a program that the boot loader in ROM starts: interrupts are
    /// enabled, SysTick runs, an interrupt of USB is pending, and the vector table is the one at address 0. The process
    /// stack is in use, as after a loader with an operating system.
    fn start_from_loader(&mut self, now: Time, hold: Time);

    /// Runs until [`now`](Self::now) is at or past `until`, overshooting by less than one instruction, or until a halt.
    fn run(&mut self, until: Time) -> Halt;

    /// Advances to `until`, earlier than [`wake_time`](Self::wake_time), if the CPU sleeps; returns whether it does.
    fn sleep(&mut self, until: Time) -> bool;

    fn now(&self) -> Time;

    /// The time of the CPU's next action without interrupts: now, or the end of its sleep or stall.
    fn wake_time(&self) -> Time;

    /// Core clock cycles since the engine was created, sleep and stalls included.
    fn cycles(&self) -> u64;

    /// Core clock cycles since the engine was created in which the CPU was not asleep.
    fn busy_cycles(&self) -> u64;

    /// The number of times that the CPU has waited for a bank of the flash that was busy.
    fn stalls(&self) -> u64;

    /// Copies out of RAM or flash; outside of them, returns false and copies nothing.
    fn read_memory(&self, address: u32, bytes: &mut [u8]) -> bool;

    /// Copies into RAM; outside of it, returns false and copies nothing.
    fn write_memory(&mut self, address: u32, bytes: &[u8]) -> bool;

    /// Takes over changes of the chip's flash from outside of a run.
    fn sync_flash(&mut self);

    /// Fills RAM and core-coupled memory with random content from `seed`, as after a power-on.
    fn scramble_ram(&mut self, seed: u64);

    /// The fault registers, if the core is locked up.
    fn lockup(&self) -> Option<Lockup>;

    fn pc(&self) -> u32;

    /// The stack pointer in use.
    fn sp(&self) -> u32;
}

/// The fault registers of a core that locked up (ARM DDI 0403, B1.5.15).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lockup {
    pub cfsr: u32,
    pub hfsr: u32,
    pub bfar: u32,
}
