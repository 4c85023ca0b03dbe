//! The chip on its board: the features choose it.

#[cfg(feature = "stm32f105")]
mod stm32f105;
#[cfg(feature = "stm32f407")]
mod stm32f407;
#[cfg(feature = "stm32f767")]
mod stm32f767;
#[cfg(feature = "stm32g431")]
mod stm32g431;
#[cfg(feature = "stm32l476")]
mod stm32l476;

#[cfg(feature = "stm32f105")]
pub use stm32f105::*;
#[cfg(feature = "stm32f407")]
pub use stm32f407::*;
#[cfg(feature = "stm32f767")]
pub use stm32f767::*;
#[cfg(feature = "stm32g431")]
pub use stm32g431::*;
#[cfg(feature = "stm32l476")]
pub use stm32l476::*;
