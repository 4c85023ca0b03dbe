//! Where every fault, panic and stack overflow ends: a word in the log, and a reset.

use core::arch::naked_asm;

use cortex_m::{
    asm,
    peripheral::{MPU, SCB},
};
use cortex_m_rt::ExceptionFrame;

unsafe extern "C" {
    /// First byte of the stack, and of the RAM (`memory.x`).
    static _stack_end: u8;
    /// First byte behind the stack.
    static _stack_start: u8;
}

/// The lowest part of the stack, which nobody may use: more than any function takes of it at once.
const GUARD_LEN: usize = 1024;

/// What reporting takes of the stack, at most.
const REPORT_LEN: usize = 512;

/// Makes every access to the guard a fault (ARM DDI 0403, B3.5): not all that lies below the RAM is one.
pub fn guard_stack(mpu: &MPU) {
    const VALID: u32 = 1 << 4;
    const EXECUTE_NEVER: u32 = 1 << 28;
    const SIZE: u32 = (GUARD_LEN.ilog2() - 1) << 1;
    const ENABLE: u32 = 1 << 0;
    const DEFAULT_MAP_ELSEWHERE: u32 = 1 << 2;
    // SAFETY: region 0, of a size and at an address that it can have, where nothing lives; no other region is used.
    unsafe {
        mpu.rbar.write(&raw const _stack_end as u32 | VALID);
        mpu.rasr.write(EXECUTE_NEVER | SIZE | ENABLE);
        mpu.ctrl.write(DEFAULT_MAP_ELSEWHERE | ENABLE);
    }
    asm::dsb();
    asm::isb();
}

/// The exception's entry. Where the stack has no room left for the report it begins the stack anew: nothing returns from here.
#[unsafe(naked)]
#[unsafe(no_mangle)]
unsafe extern "C" fn HardFault() -> ! {
    naked_asm!(
        "mrs r0, msp",
        "movw r1, #:lower16:({bottom} + {least})",
        "movt r1, #:upper16:({bottom} + {least})",
        "cmp r0, r1",
        "bhs {faulted}",
        "movw r1, #:lower16:{top}",
        "movt r1, #:upper16:{top}",
        "msr msp, r1",
        "b {overflowed}",
        bottom = sym _stack_end,
        top = sym _stack_start,
        least = const GUARD_LEN + REPORT_LEN,
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
