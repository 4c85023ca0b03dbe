//! What a board needs of a CPU: to run until a time, to be interrupted, to sleep, to be looked into.

pub mod clock;
pub mod rsemu;

use crate::{Time, chip::Access};

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
/// Flash wait states cost nothing (the accelerator hides them) unless the chip's
/// [`Readings`](crate::chip::Readings) say otherwise, and DWT_CYCCNT counts through sleep.
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

    /// The registers, before the next instruction.
    fn registers(&self) -> Registers;

    /// Has `watcher` told of every instruction from now on.
    fn watch(&mut self, watcher: Box<dyn Watcher>);
}

/// The core's registers, as a debugger names them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Registers {
    /// `r0..r15`: `r13` is the stack pointer in use, `r15` the address of the next instruction.
    pub r: [u32; 16],
    /// Flags, ITSTATE and the number of the exception that is being handled.
    pub xpsr: u32,
    /// `s0..s31`.
    pub s: [u32; 32],
    /// Status and control of the floating-point unit.
    pub fpscr: u32,
}

/// Follows a program instruction by instruction.
pub trait Watcher: Send {
    /// The core, as it is now, has made a step.
    fn stepped(&mut self, step: &Step, core: &dyn Engine);

    /// From the next step on the flash holds `bytes`, `offset` from its start.
    fn flash_changed(&mut self, offset: usize, bytes: &[u8], core: &dyn Engine);

    /// The debug probe has written to RAM.
    fn ram_changed(&mut self, address: u32, bytes: &[u8], core: &dyn Engine);
}

/// An instruction, an exception entry, or the load of the first stack pointer and PC after a reset.
#[derive(Clone, Debug)]
pub struct Step {
    /// It was the one after a reset.
    pub from_reset: bool,
    /// The registers before it.
    pub before: Registers,
    /// Levels of the interrupt lines before it, bit n for interrupt n.
    pub irqs: u128,
    /// `SYST_CSR`, `SYST_RVR`, `SYST_CVR` and `SYST_CALIB` before it.
    pub systick: [u32; 4],
    /// SysTick was pending before it.
    pub systick_pending: bool,
    /// It asked for a reset, with `AIRCR.SYSRESETREQ`.
    pub requests_reset: bool,
    /// Loads from the chip and stores to it, in order.
    pub transfers: Vec<Transfer>,
}

/// A load from the chip, or a store to it or to flash.
#[derive(Clone, Copy, Debug)]
pub struct Transfer {
    /// What was accessed.
    pub access: Access,
    /// Whether it was a store.
    pub is_store: bool,
    /// What was loaded or stored.
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
