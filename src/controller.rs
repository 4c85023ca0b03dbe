//! The CAN controller of this build: CAN1, or by the features `can2` and `can3` another. The build script checks that
//! the chip has it.

use stm32f4xx_hal::{
    gpio::alt::CanCommon,
    rcc::{Enable, Rcc},
};

#[cfg(not(any(feature = "can2", feature = "can3")))]
pub use stm32f4xx_hal::pac::CAN1 as Can;
#[cfg(feature = "can2")]
pub use stm32f4xx_hal::pac::CAN2 as Can;
#[cfg(feature = "can3")]
pub use stm32f4xx_hal::pac::CAN3 as Can;

/// The controller with the filter registers. CAN2 has none, and uses banks of CAN1 (RM0090, 32.9.4).
#[cfg(not(feature = "can2"))]
pub use Can as Filters;
#[cfg(feature = "can2")]
pub use stm32f4xx_hal::pac::CAN1 as Filters;

/// The controller with its pins.
pub type Connected = stm32f4xx_hal::can::Can<Can>;
/// The same, as `bxcan` knows it.
pub type Driver = bxcan::Can<Connected>;

/// The first filter bank. After a reset the banks from 14 on belong to CAN2 (CAN2SB).
pub const FIRST_BANK: usize = if cfg!(feature = "can2") { 14 } else { 0 };

/// The transmit pins of the controller.
pub type Tx = <Can as CanCommon>::Tx;
/// The receive pins of the controller.
pub type Rx = <Can as CanCommon>::Rx;

/// Gives the controller its clock. CAN2 also needs that of CAN1, which has its memory (RM0090, 32.2).
pub fn enable(rcc: &mut Rcc) {
    Can::enable(rcc);
    Filters::enable(rcc);
}

/// The driver of a controller, which it puts to sleep. The controller must be in initialisation mode: `bxcan` waits for
/// it without limit.
pub fn driver(can: Connected) -> Driver {
    bxcan::Can::builder(can).leave_disabled()
}
