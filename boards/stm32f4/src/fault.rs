//! The end of every fault, panic and stack overflow: a note for the next start, and a reset.

use core::arch::naked_asm;

use canopen_node::emergency::RestartCause;
use cortex_m::{asm, peripheral::MPU};
use cortex_m_rt::ExceptionFrame;

use crate::{panic, reset};

// SAFETY: the linker scripts define them; only their addresses are used.
unsafe extern "C" {
    /// The first byte of the stack and of the RAM (`memory.x`).
    static _stack_end: u8;
    /// The first byte behind the stack.
    static _stack_start: u8;
    /// The first byte of the code, and the first one behind it (cortex-m-rt).
    static __stext: u8;
    static __etext: u8;
}

/// The size of the guard at the bottom of the stack: more than the largest stack frame.
const GUARD_LEN: usize = 1024;

/// The most stack that a report takes.
const REPORT_LEN: usize = 512;

/// Turns every access to the guard into a fault (ARM DDI 0403, B3.5), since some addresses below the RAM cause none.
pub fn guard_stack(mpu: &MPU) {
    const VALID: u32 = 1 << 4;
    const EXECUTE_NEVER: u32 = 1 << 28;
    const SIZE: u32 = (GUARD_LEN.ilog2() - 1) << 1;
    const ENABLE: u32 = 1 << 0;
    const DEFAULT_MAP_ELSEWHERE: u32 = 1 << 2;
    // SAFETY: region 0 has a valid size and address, and nothing lives there; no other region is used.
    unsafe {
        mpu.rbar.write(&raw const _stack_end as u32 | VALID);
        mpu.rasr.write(EXECUTE_NEVER | SIZE | ENABLE);
        mpu.ctrl.write(DEFAULT_MAP_ELSEWHERE | ENABLE);
    }
    asm::dsb();
    asm::isb();
}

/// The entry of the exception. Without room for the report it resets the stack pointer: nothing returns from here.
///
/// # Safety
/// Only the exception, or a handler of it that has changed neither the stack nor the registers, jumps here.
// SAFETY: the handler that cortex-m-rt declares under this name; it does not return, so it may use every register.
#[unsafe(naked)]
#[cfg_attr(feature = "handlers", unsafe(no_mangle))]
#[allow(non_snake_case, reason = "the name of cortex-m-rt")]
pub unsafe extern "C" fn HardFault() -> ! {
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
    if let Some((line, file)) = panic::on_the_stack(&raw const *frame as usize) {
        reset::end_by_panic(line, file);
    }
    reset::end(RestartCause::Fault, frame.pc());
}

/// The exception frame of an overflow is lost in the guard. The deepest return address that the stack still holds names
/// the function.
extern "C" fn overflowed(sp: usize) -> ! {
    let code = &raw const __stext as u32..&raw const __etext as u32;
    let mut at = sp.max(&raw const _stack_end as usize + GUARD_LEN).next_multiple_of(4);
    let mut caller = 0;
    while caller == 0 && at < &raw const _stack_start as usize {
        // SAFETY: the word is aligned and belongs to the stack above its guard.
        let word = unsafe { (at as *const u32).read_volatile() };
        // Bit 0 of a return address is the instruction set.
        if word & 1 == 1 && code.contains(&word) {
            caller = word - 1;
        }
        at += 4;
    }
    reset::end(RestartCause::StackOverflow, caller);
}
