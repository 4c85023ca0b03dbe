//! Hard faults, where every fault, panic and stack overflow ends: a word in the log, and a reset.

use core::arch::naked_asm;

use cortex_m::peripheral::SCB;
use cortex_m_rt::ExceptionFrame;

unsafe extern "C" {
    /// First byte of the stack, and of the RAM (`memory.x`).
    static _stack_end: u8;
    /// First byte behind the stack.
    static _stack_start: u8;
}

/// What reporting takes of the stack, at most.
const REPORT_LEN: usize = 512;

/// The exception's entry. Where the stack has no room left for the report it begins the stack anew: nothing returns from here.
#[unsafe(naked)]
#[unsafe(no_mangle)]
unsafe extern "C" fn HardFault() -> ! {
    naked_asm!(
        "mrs r0, msp",
        "movw r1, #:lower16:({bottom} + {report_len})",
        "movt r1, #:upper16:({bottom} + {report_len})",
        "cmp r0, r1",
        "bhs {faulted}",
        "movw r1, #:lower16:{top}",
        "movt r1, #:upper16:{top}",
        "msr msp, r1",
        "b {overflowed}",
        bottom = sym _stack_end,
        top = sym _stack_start,
        report_len = const REPORT_LEN,
        faulted = sym faulted,
        overflowed = sym overflowed,
    )
}

extern "C" fn faulted(frame: &ExceptionFrame) -> ! {
    defmt::error!("hard fault at {=u32:#x}, resetting", frame.pc());
    SCB::sys_reset();
}

extern "C" fn overflowed() -> ! {
    defmt::error!("stack overflow, resetting");
    SCB::sys_reset();
}
