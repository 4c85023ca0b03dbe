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

/// The reset flags of RCC_CSR: window and independent watchdog, and software.
const FAILURES: u32 = 1 << 30 | 1 << 29 | 1 << 28;

/// Starts the program, or says why the loader stays.
pub fn start_or_stay(core: &cortex_m::Peripherals) -> Why {
    // SAFETY: nothing else runs yet.
    let (rcc, flash, power) = unsafe { (RCC::steal(), FLASH::steal(), PWR::steal()) };
    restore(core, &rcc, &flash);
    start_watchdog();
    Supply::wait(power);
    // The check of 100 KB takes 2 ms, not 19.
    pll::run_from(pll::FROM_HSI, &rcc);
    let is_failure = rcc.csr().read().bits() & FAILURES != 0;
    let cause = if is_failure { Cause::Failure } else { Cause::Other };
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
        Start::Loader(why) => why,
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

/// What the program of a loader has beside its tasks: a panic that resets, and the compiler's memory functions in 100
/// bytes instead of 1,400.
#[macro_export]
macro_rules! loader {
    () => {
        #[panic_handler]
        fn panic(_: &core::panic::PanicInfo) -> ! {
            cortex_m::peripheral::SCB::sys_reset();
        }

        core::arch::global_asm!(
            ".macro function name",
            ".global \\name",
            ".type \\name, %function",
            ".thumb_func",
            "\\name:",
            ".endm",
            ".section .text.memory, \"ax\"",
            // Destination, source, length.
            "function memcpy",
            "function __aeabi_memcpy",
            "function __aeabi_memcpy4",
            "function __aeabi_memcpy8",
            "mov r12, r0",
            "0: subs r2, #4",
            "ittt pl",
            "ldrpl r3, [r1], #4",
            "strpl r3, [r12], #4",
            "bpl 0b",
            "adds r2, #4",
            "0: subs r2, #1",
            "ittt pl",
            "ldrbpl r3, [r1], #1",
            "strbpl r3, [r12], #1",
            "bpl 0b",
            "bx lr",
            // Destination, length.
            "function __aeabi_memclr",
            "function __aeabi_memclr4",
            "function __aeabi_memclr8",
            "movs r2, #0",
            // Destination, length, value.
            "function __aeabi_memset",
            "function __aeabi_memset4",
            "function __aeabi_memset8",
            "mov r12, r1",
            "mov r1, r2",
            "mov r2, r12",
            // Destination, value, length.
            "function memset",
            "mov r12, r0",
            "uxtb r1, r1",
            "orr r1, r1, r1, lsl #8",
            "orr r1, r1, r1, lsl #16",
            "0: subs r2, #4",
            "itt pl",
            "strpl r1, [r12], #4",
            "bpl 0b",
            "adds r2, #4",
            "0: subs r2, #1",
            "itt pl",
            "strbpl r1, [r12], #1",
            "bpl 0b",
            "bx lr",
            // Two places, length.
            "function memcmp",
            "function bcmp",
            "push {{r4, lr}}",
            "mov r4, r0",
            "movs r0, #0",
            "0: subs r2, #1",
            "bmi 1f",
            "ldrb r3, [r4], #1",
            "ldrb r12, [r1], #1",
            "subs r0, r3, r12",
            "beq 0b",
            "1: pop {{r4, pc}}",
        );
    };
}
