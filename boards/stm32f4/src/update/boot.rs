//! The first instructions of the loader, in the flash, and the start of the program.

use core::{
    arch::{asm, naked_asm},
    sync::atomic::{AtomicU32, Ordering},
};

use cortex_m_rt as _;
use program_update::start::{self, Cause, Start, Why};
use stm32f4xx_hal::pac::{FLASH, IWDG, PWR, RCC};

use super::areas::Areas;
use crate::{
    chip::RUN,
    mailbox, pll,
    reset::Reset,
    start::{comes_in_100_ms, restore},
    supply::Supply,
};

/// The program's vector table, behind its header.
const VECTORS: u32 = RUN.address + 0x200;

// SAFETY: loader.x defines them.
unsafe extern "C" {
    static __boot_end: u32;
    static __loader: u32;
    static __loader_sector3: u32;
    static __loader_end: u32;
}

/// Copies the loader from sectors 0 and 3 to the RAM and starts it there: 1 ms. A boot loader in ROM may have left its
/// vector table and the security system of the crystal.
// SAFETY: the entry after a reset; it uses no stack.
#[unsafe(naked)]
#[unsafe(no_mangle)]
#[unsafe(link_section = ".boot")]
unsafe extern "C" fn Boot() -> ! {
    naked_asm!(
        "cpsid i",
        "mov r0, #0x08000000",
        "ldr r1, =0xE000ED08", // VTOR
        "str r0, [r1]",
        "ldr r0, ={boot_end}",
        "ldr r1, ={loader}",
        "ldr r2, ={loader_sector3}",
        "0: ldmia r0!, {{r3-r10}}",
        "stmia r1!, {{r3-r10}}",
        "cmp r1, r2",
        "blo 0b",
        "ldr r0, ={sector3}",
        "ldr r2, ={loader_end}",
        "0: ldmia r0!, {{r3-r10}}",
        "stmia r1!, {{r3-r10}}",
        "cmp r1, r2",
        "blo 0b",
        "ldr r0, =Reset",
        "dsb",
        "isb",
        "bx r0",
        ".ltorg",
        boot_end = sym __boot_end,
        loader = sym __loader,
        loader_sector3 = sym __loader_sector3,
        sector3 = const 0x0800_C000,
        loader_end = sym __loader_end,
    )
}

/// Resets the chip after a fault of `Boot`, or a failure of the crystal meanwhile.
// SAFETY: an exception that does not return; it uses no stack.
#[unsafe(naked)]
#[unsafe(no_mangle)]
#[unsafe(link_section = ".boot")]
unsafe extern "C" fn BootFault() -> ! {
    naked_asm!(
        "ldr r0, =0xE000ED0C", // AIRCR
        "ldr r1, =0x05FA0004", // SYSRESETREQ
        "str r1, [r0]",
        "b .",
        ".ltorg",
    )
}

/// The loader stays: only [`start_or_stay`] makes one, so a loader's node starts at most once.
pub struct Stay {
    pub(super) why: Why,
    pub(super) reset: Reset,
}

/// Starts the program, or says why the loader stays.
///
/// # Safety
/// It is the first act of the loader, while nothing else has or uses a peripheral.
pub unsafe fn start_or_stay(core: &cortex_m::Peripherals) -> Stay {
    // SAFETY: the caller sees to it.
    let (rcc, flash, power) = unsafe { (RCC::steal(), FLASH::steal(), PWR::steal()) };
    restore(core, &rcc, &flash);
    start_watchdog();
    Supply::wait(power);
    // The check of 100 KB takes 2 ms, not 19.
    pll::run_from(pll::FROM_HSI, &rcc);
    let reset = Reset::read(&rcc);
    let cause = match reset.failure {
        Some(_) => Cause::Failure,
        None if reset.is_by_debugger() => Cause::Debugger,
        None => Cause::Other,
    };
    let mut areas = Areas::new(polls);
    let (start, mailbox) = start::decide(&mut areas, mailbox::read(), cause);
    mailbox::write(&mailbox);
    wait_for_watchdog();
    match start {
        Start::Program => {
            restore(core, &rcc, &flash);
            // SAFETY: the program there is whole.
            unsafe { jump() }
        }
        Start::Loader(why) => {
            Reset::end(&rcc);
            Stay { why, reset }
        }
    }
}

/// The number of calls, of which a wait for the flash makes one to three in a microsecond.
fn polls() -> u32 {
    static POLLS: AtomicU32 = AtomicU32::new(0);
    let polls = POLLS.load(Ordering::Relaxed);
    POLLS.store(polls.wrapping_add(1), Ordering::Relaxed);
    polls
}

/// Starts the watchdog for what comes next: 1.4 s at least.
fn start_watchdog() {
    // SAFETY: it has no other user yet.
    let watchdog = unsafe { IWDG::steal() };
    // SAFETY: keys of RM0090, 21.4.1.
    unsafe {
        watchdog.kr().write(|w| w.bits(0xCCCC));
        watchdog.kr().write(|w| w.bits(0x5555));
        // A tick of 0.5 ms at 32 kHz.
        watchdog.pr().write(|w| w.bits(2));
        watchdog.rlr().write(|w| w.bits(0xFFF));
        watchdog.kr().write(|w| w.bits(0xAAAA));
    }
}

/// Waits until the watchdog has taken its settings, some periods of its oscillator: it must be left in peace by then.
fn wait_for_watchdog() {
    // SAFETY: reading the state has no effect.
    let watchdog = unsafe { IWDG::steal() };
    comes_in_100_ms(|| watchdog.sr().read().bits() == 0);
}

/// Starts the program as a reset would.
unsafe fn jump() -> ! {
    // SAFETY: the vector table of a valid program.
    unsafe {
        asm!(
            "ldr r1, =0xE000ED08",
            "str r0, [r1]",
            "ldm r0, {{r1, r2}}",
            "msr msp, r1",
            "mov lr, #-1",
            "dsb",
            "isb",
            "cpsie i",
            "bx r2",
            in("r0") VECTORS,
            options(noreturn)
        )
    }
}

/// What the program of a loader has beside its tasks: a panic that resets.
#[macro_export]
macro_rules! loader {
    () => {
        #[panic_handler]
        fn panic(_: &core::panic::PanicInfo) -> ! {
            $crate::reset::end_by_panic_of_loader();
        }
    };
}
