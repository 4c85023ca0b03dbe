//! Why the chip was reset: words in RAM that no start clears, which the next start takes, logs, and tells the node.
//!
//! A log line right before a reset is lost, as the start clears the buffer before a probe has fetched it, and it would lock
//! up the core if the fault was within another line. So nothing is logged at the end.

use canopen_node::emergency::{Restart, RestartCause};
use cortex_m::peripheral::SCB;
use stm32f4xx_hal::pac::RCC;

use crate::{panic, task};

/// The place, which `image.x` and `program.x` keep free; the loader uses other RAM.
const PLACE: *mut [u32; 5] = 0x2000_4000 as *mut _;

/// The reset flags of RCC_CSR (RM0090, 7.3.21): software, and both watchdogs. They stay until a start clears them.
const SOFTWARE: u32 = 1 << 28;
const WATCHDOGS: u32 = 0b11 << 29;

/// In the place of a [`RestartCause`]: NMT reset node, or what loader and program have agreed on.
const COMMANDED: u32 = 0xFF;

/// The words. The upper half of the first is a [`RestartCause`], or 0 while the program runs; the lower half has a bit for each
/// task that has missed the latest roll call. The second is the address. The others are the address and the length of the
/// name of a file, after a panic.
type Left = [u32; 4];

/// A word that fits the others. After power-on it does not: RAM is random then.
fn check([kind, address, start, length]: Left) -> u32 {
    !kind.wrapping_add(address).wrapping_add(start).wrapping_add(length)
}

fn write(left: Left) {
    let [kind, address, start, length] = left;
    // SAFETY: no variable and no stack has this RAM.
    unsafe { PLACE.write_volatile([kind, address, start, length, check(left)]) };
}

fn read() -> Option<Left> {
    // SAFETY: as above, and any content is a number.
    let [kind, address, start, length, word] = unsafe { PLACE.read_volatile() };
    let left = [kind, address, start, length];
    (word == check(left)).then_some(left)
}

/// Resets the chip, since it has failed; the next start finds the cause and its address. It takes no lock.
pub fn end(cause: RestartCause, address: u32) -> ! {
    write([(cause as u32) << 16, address, 0, 0]);
    SCB::sys_reset();
}

/// Resets the chip, which is no failure.
pub fn end_by_command() -> ! {
    write([COMMANDED << 16, 0, 0, 0]);
    SCB::sys_reset();
}

/// The same for a panic in this line, in a file whose name is a text in the flash: its address and its length.
pub fn end_by_panic(line: u32, [start, length]: [u32; 2]) -> ! {
    write([(RestartCause::Panic as u32) << 16, line, start, length]);
    SCB::sys_reset();
}

/// The same for a panic of a loader, which has no room for where it was.
#[cfg(feature = "update")]
pub fn end_by_panic_of_loader() -> ! {
    end(RestartCause::Panic, 0)
}

/// Notes the tasks that have missed the latest roll call, a bit for each.
pub fn note_silent(tasks: u16) {
    write([tasks.into(), 0, 0, 0]);
}

/// The tasks that were [noted](note_silent).
#[cfg(feature = "update")]
pub fn silent() -> u16 {
    read().map_or(0, |[kind, ..]| kind as u16)
}

/// What has reset the chip.
#[derive(Clone, Copy)]
pub struct Reset {
    left: Left,
    /// The flags in RCC_CSR.
    flags: u32,
    /// Why the firmware has failed, if it has.
    pub failure: Option<Restart>,
}

impl Reset {
    /// What has reset the chip; it stays to be taken.
    pub fn read(rcc: &RCC) -> Self {
        let flags = rcc.csr().read().bits();
        let left = read().filter(|_| flags & (SOFTWARE | WATCHDOGS) != 0).unwrap_or_default();
        let [kind, address, ..] = left;
        let failure = if flags & WATCHDOGS != 0 {
            Some(Restart { cause: RestartCause::Watchdog, address: kind & 0xFFFF })
        } else {
            RestartCause::from_number(kind >> 16).map(|cause| Restart { cause, address })
        };
        Self { left, flags, failure }
    }

    /// The same, for the last time.
    pub fn take(rcc: &RCC) -> Self {
        let reset = Self::read(rcc);
        Self::end(rcc);
        reset
    }

    /// The start has taken it: the next reset has another cause.
    pub fn end(rcc: &RCC) {
        note_silent(0);
        rcc.csr().modify(|_, w| w.rmvf().set_bit());
    }

    /// The number of a [`RestartCause`], [`COMMANDED`] or 0.
    fn cause(&self) -> u32 {
        self.left[0] >> 16
    }

    /// Whether a debugger has reset the chip: it does so as the firmware does, and leaves nothing.
    #[cfg(feature = "update")]
    pub fn is_by_debugger(&self) -> bool {
        self.flags & SOFTWARE != 0 && self.cause() == 0
    }

    /// Logs it.
    pub fn log(&self) {
        let [tasks, address, start, length] = self.left;
        match self.failure.map(|restart| restart.cause) {
            Some(RestartCause::Watchdog) => task::log_reset(tasks as u16),
            Some(RestartCause::Fault) => {
                defmt::error!("reset by a hard fault at {=u32:#x}", address)
            }
            Some(RestartCause::Panic) => {
                let file = panic::file([start, length]);
                defmt::error!("reset by a panic at {=str}:{=u32}", file, address);
            }
            Some(RestartCause::StackOverflow) => {
                defmt::error!("reset by a stack overflow below the call before {=u32:#x}", address)
            }
            Some(RestartCause::CrystalStopped) => {
                defmt::error!("reset because the crystal stopped");
            }
            Some(RestartCause::NoCrystal) => {
                defmt::error!("reset because the crystal did not start");
            }
            Some(RestartCause::WrongCrystal) => {
                defmt::error!("reset because the crystal had {=u32} kHz", address);
            }
            Some(RestartCause::OtherClock) => defmt::error!(
                "reset because the clock was not that of the crystal: RCC_PLLCFGR {=u32:#x}",
                address
            ),
            None if self.cause() == COMMANDED => defmt::info!("reset by NMT or by the firmware"),
            None if self.flags & SOFTWARE != 0 => defmt::info!("reset by a debugger"),
            None => defmt::info!("power-on, or reset by the pin"),
        }
    }
}
