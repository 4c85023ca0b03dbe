//! The independent watchdog, which is fed only if all tasks have answered a roll call.

use canopen_node::indicator;
use cortex_m::peripheral::NVIC;
use stm32f4xx_hal::{
    pac::{DBGMCU, IWDG, Interrupt},
    watchdog::IndependentWatchdog,
};

pub use crate::task::Task;
use crate::{can::Peripheral, reset, task};

/// The timeout in ms at 32 kHz; the oscillator runs at 17 to 47 kHz. The longest pause of a healthy board is the erase
/// of a 16 KB sector: 800 ms by bytes, 500 ms by words. A new board erases two; should the watchdog end that, the next
/// start goes on.
const TIMEOUT_MS: u32 = 2_000;

/// The steps of the indicators between two roll calls: four a second.
const STEPS: u8 = 250 / indicator::STEP_MS as u8;

/// The interrupt of the task that stores: that of the clocks. It has no other user, since the board has the clocks.
pub(crate) const STORE: Interrupt = Interrupt::RCC;

/// Whether all tasks have answered the latest roll call that is over.
#[cfg(feature = "update")]
pub(crate) fn all_have_answered() -> bool {
    reset::silent() == 0
}

/// The watchdog.
pub struct Watchdog {
    hardware: IndependentWatchdog,
    debug: DBGMCU,
    /// A bit for each task.
    expected: u16,
    steps: u8,
    /// Those of the CAN controller.
    interrupts: &'static [Interrupt],
}

impl Watchdog {
    /// Starts the watchdog, which resets the chip after 1.4 to 3.8 s without a feeding. It stops while a debugger has
    /// halted the core.
    pub(crate) fn start(hardware: IWDG, debug: DBGMCU) -> Self {
        let mut hardware = IndependentWatchdog::new(hardware);
        hardware.start(fugit::MillisDurationU32::from_ticks(TIMEOUT_MS));
        hardware.stop_on_debug(&debug, true);
        let mut watchdog = Self { hardware, debug, expected: Task::ALL, steps: 0, interrupts: &[] };
        watchdog.feed();
        watchdog
    }

    /// Triggers the tasks of this controller in each roll call.
    pub(crate) fn call<C: Peripheral>(&mut self) {
        self.interrupts = const { &C::INTERRUPTS };
    }

    /// Also waits for a task of the product, which must [answer](Task::answer) at least four times a second.
    pub fn expect(&mut self, task: Task) {
        self.expected |= task.bit();
    }

    /// Feeds the watchdog without a roll call: in the start, and in a program that is one loop. Also keeps RTT and the
    /// debug port on while the core sleeps, which a debugger switches off as it leaves.
    pub fn feed(&mut self) {
        self.hardware.feed();
        self.debug.cr().modify(|_, w| w.dbg_sleep().set_bit());
    }

    /// Counts a step of the indicators. Four times a second, feeds the watchdog if all tasks have answered, begins the
    /// next roll call, and triggers the tasks that do not run by themselves.
    pub fn step(&mut self) {
        self.steps = (self.steps + 1) % STEPS;
        if self.steps != 0 {
            return;
        }
        let missing = task::call_roll() & self.expected;
        reset::note_silent(missing);
        if missing == 0 {
            self.feed();
        }
        self.interrupts.iter().copied().for_each(NVIC::pend);
        NVIC::pend(STORE);
    }
}
