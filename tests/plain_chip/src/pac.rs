//! The registers of the peripherals that the drivers use. They keep what was written. Those of the flash react, each
//! time before the driver accesses them, to what it wrote before.

use std::{
    ops::Deref,
    sync::atomic::{AtomicU32, Ordering::Relaxed},
};

use stm32f4::{
    RawReg, Reg, RegisterSpec,
    stm32f405::{flash, gpioa, pwr, rcc, tim2},
};

pub use stm32f4::stm32f405::{Interrupt, can1};

use crate::memory::{self, Memory, SETTINGS_LEN};

/// The registers of a port, up to those of the next.
#[repr(C)]
struct Port {
    registers: gpioa::RegisterBlock,
    unused: [u8; 0x400 - size_of::<gpioa::RegisterBlock>()],
}

macro_rules! peripherals {
    ($($name:ident: $registers:ident in $memory:ty, $react:expr;)*) => {
        $(
            pub struct $name;

            impl $name {
                pub const fn ptr() -> *const $registers::RegisterBlock {
                    static MEMORY: Memory<$memory> = Memory::zeroed();
                    MEMORY.get().cast()
                }

                fn reset() {
                    // SAFETY: zeros are valid registers, and nobody has a reference to them.
                    unsafe { Self::ptr().cast::<$memory>().cast_mut().write_bytes(0, 1) };
                }

                /// # Safety
                /// As in the HAL: no other owner may be disturbed.
                // SAFETY: there is nothing to rely on.
                pub unsafe fn steal() -> Self {
                    Self
                }
            }

            impl Deref for $name {
                type Target = $registers::RegisterBlock;

                fn deref(&self) -> &Self::Target {
                    // SAFETY: static memory of this type.
                    let registers = unsafe { &*Self::ptr() };
                    $react(registers);
                    registers
                }
            }
        )*

        /// Clears all registers.
        pub fn reset() {
            $($name::reset();)*
            FLASH_STATUS.store(0, Relaxed);
        }
    };
}

peripherals! {
    CAN1: can1 in can1::RegisterBlock, |_| {};
    FLASH: flash in flash::RegisterBlock, react;
    GPIOA: gpioa in [Port; 9], |_| {};
    PWR: pwr in pwr::RegisterBlock, |_| {};
    RCC: rcc in rcc::RegisterBlock, |_| {};
    TIM2: tim2 in tim2::RegisterBlock, |_| {};
}

/// Sets a register as the hardware does, also one that the driver can only read.
pub fn set<REG: RegisterSpec<Ux: RawReg>>(register: &Reg<REG>, value: REG::Ux) {
    // SAFETY: registers are cells, and any number is a valid value.
    unsafe { register.as_ptr().write_volatile(value) };
}

/// What the flash shows in its status register, whatever the driver writes there.
pub static FLASH_STATUS: AtomicU32 = AtomicU32::new(0);

/// Erases the sector that the driver has asked for, shows its status, and unlocks after the second key (RM0090, 3.9).
fn react(flash: &flash::RegisterBlock) {
    let control = flash.cr().read();
    if control.strt().bit_is_set() && control.ser().bit_is_set() {
        let from = SETTINGS_LEN / 2 * (usize::from(control.snb().bits()) - 1);
        memory::erase(from..from + SETTINGS_LEN / 2);
        flash.cr().modify(|_, w| w.strt().clear_bit());
    }
    set(flash.sr(), FLASH_STATUS.load(Relaxed));
    // SAFETY: as in `set`; the driver can only write this register.
    if unsafe { flash.keyr().as_ptr().read_volatile() } == 0xCDEF_89AB {
        set(flash.keyr(), 0);
        flash.cr().modify(|_, w| w.lock().clear_bit());
    }
}
