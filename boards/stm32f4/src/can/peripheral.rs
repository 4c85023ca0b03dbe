//! The CAN controllers of the chips.

use core::ops::Deref;

use stm32f4xx_hal::{
    can,
    gpio::{PinPull, PinSpeed},
    pac::{self, Interrupt, can1::RegisterBlock},
    rcc::{Enable, Rcc},
};

/// A CAN controller: CAN1, CAN2, or CAN3 where the chip has it.
pub trait Peripheral:
    Sized + can::Instance<Tx: PinSpeed, Rx: PinPull> + Deref<Target = RegisterBlock>
{
    /// The controller with its pins, as `bxcan` drives it.
    type Connected: bxcan::Instance;
    /// The controller with the filter registers.
    type Filters: Enable + Deref<Target = RegisterBlock>;
    /// Its number: 1 for CAN1.
    const NUMBER: u32;
    /// The first filter bank.
    const FIRST_BANK: usize;
    /// Its interrupts, to which `main.rs` binds the tasks of reception, of transmission and of its status.
    const INTERRUPTS: [Interrupt; 3];

    /// The controller with its receive pin, after a reset.
    fn connect(self, receive: Self::Rx, rcc: &mut Rcc) -> Self::Connected;

    /// The driver of the controller, which it puts to sleep. The controller must be in initialisation mode: `bxcan` waits
    /// for it without limit.
    fn driver(can: Self::Connected) -> bxcan::Can<Self::Connected> {
        bxcan::Can::builder(can).leave_disabled()
    }

    /// Other handles of the controller and of its filters, for registers that `bxcan` does not offer.
    ///
    /// # Safety
    /// They must have one owner, together with the controller itself.
    unsafe fn steal() -> (Self, Self::Filters);

    /// Gives the controller its clock. CAN2 also needs that of CAN1, which has its memory (RM0090, 32.2).
    fn enable_clock(rcc: &mut Rcc) {
        Self::enable(rcc);
        Self::Filters::enable(rcc);
    }
}

macro_rules! peripheral {
    ($Can:ident $number:literal, $interrupts:tt, filters of $Filters:ident from bank $first:literal) => {
        impl Peripheral for pac::$Can {
            type Connected = can::Can<Self>;
            type Filters = pac::$Filters;
            const NUMBER: u32 = $number;
            const FIRST_BANK: usize = $first;
            const INTERRUPTS: [Interrupt; 3] = {
                use Interrupt::*;
                $interrupts
            };

            fn connect(self, receive: Self::Rx, rcc: &mut Rcc) -> Self::Connected {
                can::Can::rx(self, receive, rcc)
            }

            // SAFETY: the caller sees to it.
            unsafe fn steal() -> (Self, Self::Filters) {
                // SAFETY: as above.
                unsafe { (Self::steal(), pac::$Filters::steal()) }
            }
        }
    };
}

peripheral!(CAN1 1, [CAN1_RX0, CAN1_TX, CAN1_SCE], filters of CAN1 from bank 0);
// CAN2 has no filters, and uses banks of CAN1 (RM0090, 32.9.4). After a reset those from 14 on belong to it (CAN2SB).
peripheral!(CAN2 2, [CAN2_RX0, CAN2_TX, CAN2_SCE], filters of CAN1 from bank 14);
#[cfg(any(feature = "stm32f413", feature = "stm32f423"))]
peripheral!(CAN3 3, [CAN3_RX0, CAN3_TX, CAN3_SCE], filters of CAN3 from bank 0);
