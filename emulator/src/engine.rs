//! The interface between a board and a CPU: running until a time, interrupts, sleep, and inspection.

pub mod clock;
pub mod rsemu;

use crate::{Time, chip::Access, coverage::Recorder};

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

/// A Cortex-M4F with the memories and peripherals of a [`Chip`](crate::chip::Chip).
///
/// Flash wait states cost nothing unless the chip's [`Readings`](crate::chip::Readings) state otherwise. DWT_CYCCNT also
/// counts during sleep.
pub trait Engine: Send {
    /// Restarts from the vector table at `now`, after the time `hold` in which nothing runs.
    fn reset(&mut self, now: Time, hold: Time);

    /// Restarts as [`reset`](Self::reset) does, but as a program that the boot loader in ROM starts: interrupts are
    /// enabled, SysTick runs, an interrupt of USB is pending, and the vector table is the one at address 0. The process
    /// stack is in use, as after a loader with an operating system.
    fn start_from_loader(&mut self, now: Time, hold: Time);

    /// Runs until [`now`](Self::now) is at or past `until`, overshooting by less than one instruction, or until a halt.
    fn run(&mut self, until: Time) -> Halt;

    /// Advances to `until`, earlier than [`wake_time`](Self::wake_time), if the CPU sleeps; returns whether it does.
    fn sleep(&mut self, until: Time) -> bool;

    /// The CPU's current time.
    fn now(&self) -> Time;

    /// The time of the CPU's next action without interrupts: now, or the end of its sleep or stall.
    fn wake_time(&self) -> Time;

    /// Core clock cycles since the engine was created, sleep and stalls included.
    fn cycles(&self) -> u64;

    /// Core clock cycles since the engine was created in which the CPU was not asleep.
    fn busy_cycles(&self) -> u64;

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

    /// Address of the next instruction.
    fn pc(&self) -> u32;

    /// The stack pointer in use.
    fn sp(&self) -> u32;

    /// The registers, before the next instruction.
    fn registers(&self) -> Registers;

    /// Records the branches of the program from now on.
    fn record(&mut self, recorder: Recorder);

    /// Registers `watcher` for every instruction from now on.
    fn watch(&mut self, watcher: Box<dyn Watcher>);
}

/// The core's registers, with a debugger's names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Registers {
    /// `r0..r15`: `r13` is the stack pointer in use, `r15` the address of the next instruction.
    pub r: [u32; 16],
    /// Flags, ITSTATE and the number of the current exception.
    pub xpsr: u32,
    /// `s0..s31`.
    pub s: [u32; 32],
    /// Status and control of the floating-point unit.
    pub fpscr: u32,
}

/// Follows a program instruction by instruction.
pub trait Watcher: Send {
    /// Called after each step, with the core's state after it.
    fn stepped(&mut self, step: &Step, core: &dyn Engine);

    /// Called when the flash changes to `bytes` at `offset`, before the next step.
    fn flash_changed(&mut self, offset: usize, bytes: &[u8], core: &dyn Engine);

    /// Called when the debug probe has written to RAM.
    fn ram_changed(&mut self, address: u32, bytes: &[u8], core: &dyn Engine);
}

/// An instruction, an exception entry, or the load of the first stack pointer and PC after a reset.
#[derive(Clone, Debug)]
pub struct Step {
    /// Whether this was the first step after a reset.
    pub from_reset: bool,
    /// The registers before the step.
    pub before: Registers,
    /// Levels of the interrupt lines before the step, bit n for interrupt n.
    pub irqs: u128,
    /// `SYST_CSR`, `SYST_RVR`, `SYST_CVR` and `SYST_CALIB` before the step.
    pub systick: [u32; 4],
    /// Whether SysTick was pending before the step.
    pub systick_pending: bool,
    /// Whether the step requested a reset with `AIRCR.SYSRESETREQ`.
    pub requests_reset: bool,
    /// Loads from the chip and stores to it, in order.
    pub transfers: Vec<Transfer>,
}

/// A load from the chip, or a store to it or to flash.
#[derive(Clone, Copy, Debug)]
pub struct Transfer {
    /// The address and width of the access.
    pub access: Access,
    /// Whether it was a store.
    pub is_store: bool,
    /// The value loaded or stored.
    pub value: u32,
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
