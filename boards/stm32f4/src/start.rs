//! The first act of the image: the state that a reset leaves, whoever has started the image; and the waits of the start.
//!
//! A boot loader may leave interrupts, SysTick, the PLL and peripherals on. The one in ROM also leaves its own vector
//! table at address 0 while BOOT0 is high, as after `dfu-util ... :leave`.

use core::arch::naked_asm;

use canopen_node::emergency::RestartCause;
use cortex_m::{Peripherals, asm};
use stm32f4xx_hal::pac::{FLASH, RCC};

use crate::reset;

// SAFETY: cortex-m-rt defines it; only its address is used.
unsafe extern "C" {
    /// The vector table of the image.
    static __vector_table: u32;
}

/// Sets the vector table, and disables SysTick, MPU and all interrupts, none of which stays pending. RTIC enables
/// interrupts after `init`. Until `Reset` calls it, a loader's interrupt finds the loader's handler.
///
/// # Safety
/// Only `Reset` calls it, before anything else runs.
// SAFETY: the function that cortex-m-rt declares under this name; it uses neither variables nor the stack.
#[unsafe(naked)]
#[cfg_attr(feature = "handlers", unsafe(no_mangle))]
pub unsafe extern "C" fn __pre_init() {
    naked_asm!(
        "cpsid i",
        "ldr r0, =0xE000E000",   // the registers of the core
        "ldr r1, ={vectors}",
        "str r1, [r0, #0xD08]",  // VTOR
        "movs r1, #0",
        "msr basepri, r1",
        "msr faultmask, r1",
        "msr control, r1", // the main stack, which `Reset` has set
        "isb",
        "str r1, [r0, #0x010]",  // SYST_CSR
        "str r1, [r0, #0xD94]",  // MPU_CTRL
        "ldr r1, =0x0A000000",
        "str r1, [r0, #0xD04]",  // ICSR: PENDSTCLR, PENDSVCLR
        "mov r1, #-1",
        "movs r2, #8",
        "0: str r1, [r0, #0x180]", // NVIC_ICER
        "str r1, [r0, #0x280]",    // NVIC_ICPR
        "adds r0, #4",
        "subs r2, #1",
        "bne 0b",
        "bx lr",
        vectors = sym __vector_table,
    )
}

/// RCC_CR: crystal and PLL are ready.
const HSERDY_PLLRDY: u32 = 1 << 17 | 1 << 25;
/// The number of register reads after which a clock is not waited for any longer: 1 ms and more. It takes some
/// microseconds, and [`crystal::check`](crate::crystal::check) resets the chip if the clock is another in the end.
const READS: u32 = 50_000;

/// Restores the rest of the state after a reset, except the memory, the watchdog, the backup domain and the debugger's
/// bits.
pub fn restore(core: &Peripherals, rcc: &RCC, flash: &FLASH) {
    // SAFETY: no region of the MPU is in use, and no fault but the hard fault; WFI means sleep mode.
    unsafe {
        for region in 0..8 {
            core.MPU.rnr.write(region);
            core.MPU.rasr.write(0);
        }
        core.SCB.shcsr.write(0);
        core.SCB.scr.write(0);
    }
    restore_clocks(rcc, flash);
    reset_peripherals(rcc);
}

/// Lets the core run at the 16 MHz of HSI without wait states, caches, crystal and PLLs (RM0090, 7.3).
fn restore_clocks(rcc: &RCC, flash: &FLASH) {
    let wait = |is_reached: &dyn Fn() -> bool| (0..READS).any(|_| is_reached());
    rcc.cr().modify(|_, w| w.hsion().set_bit());
    wait(&|| rcc.cr().read().hsirdy().bit_is_set());
    rcc.cfgr().reset();
    wait(&|| rcc.cfgr().read().sws().is_hsi());
    rcc.cr().reset();
    wait(&|| rcc.cr().read().bits() & HSERDY_PLLRDY == 0);
    // HSEBYP stays while the crystal is on.
    rcc.cr().reset();
    rcc.pllcfgr().reset();
    rcc.cir().reset();
    flash.acr().reset();
    flash.acr().write(|w| w.icrst().set_bit().dcrst().set_bit());
    flash.acr().reset();
}

/// Waits at least 100 ms for `it_is_there`, with the core at 16 MHz; returns false on a timeout.
pub fn comes_in_100_ms(it_is_there: impl Fn() -> bool) -> bool {
    /// At five cycles each.
    const READS: u32 = 320_000;
    (0..READS).any(|_| it_is_there())
}

/// Resets the chip, after about 200 ms at 16 MHz in which a probe fetches the log.
pub fn give_up(cause: RestartCause, address: u32) -> ! {
    for _ in 0..2 {
        comes_in_100_ms(|| {
            asm::nop();
            false
        });
    }
    reset::end(cause, address);
}

/// Resets all peripherals and switches their clocks off.
fn reset_peripherals(rcc: &RCC) {
    // SAFETY: a 1 resets a peripheral; no bit has another effect.
    unsafe {
        rcc.ahb1rstr().write(|w| w.bits(u32::MAX));
        rcc.ahb2rstr().write(|w| w.bits(u32::MAX));
        rcc.ahb3rstr().write(|w| w.bits(u32::MAX));
        rcc.apb1rstr().write(|w| w.bits(u32::MAX));
        rcc.apb2rstr().write(|w| w.bits(u32::MAX));
    }
    rcc.ahb1rstr().reset();
    rcc.ahb2rstr().reset();
    rcc.ahb3rstr().reset();
    rcc.apb1rstr().reset();
    rcc.apb2rstr().reset();
    rcc.ahb1enr().reset();
    rcc.ahb2enr().reset();
    rcc.ahb3enr().reset();
    rcc.apb1enr().reset();
    rcc.apb2enr().reset();
}
