//! The settings that make the firmware your product: identity, defaults and clock. Edit this file first, then
//! `pins.rs` and `application.rs`. The chip and its CAN controller are features of the build: `stm32f446`, or
//! `stm32f446,can2`.

use lss_slave::{BitRate, BitRateSetting, BitRates, Settings, bit_rate::BitTiming};

use crate::chip::{CHIP, Chip};

/// Your company's name. Only the EDS contains it.
pub const VENDOR_NAME: &str = "Not registered";
/// The product in one line. Only the EDS contains it.
pub const DESCRIPTION: &str = "CANopen LSS slave on an STM32F4";
/// Your company's vendor-ID, from CiA.
pub const VENDOR_ID: u32 = 0x0000_0000;
/// Your number for this product.
pub const PRODUCT_CODE: u32 = 0x4C53_5334;
/// Major revision (changes in the behaviour on the bus) in the upper 16 bits, minor in the lower.
pub const REVISION_NUMBER: u32 = 0x0001_0000;
/// Manufacturer device name, object 1008h.
pub const NAME: &str = "LSS slave";
/// Manufacturer hardware version, object 1009h.
pub const HARDWARE_VERSION: &str = "1.0";
/// Manufacturer software version, object 100Ah.
pub const SOFTWARE_VERSION: &str = env!("CARGO_PKG_VERSION");
// The serial number comes from the chip's unique id, see `board::serial_number`.

/// The settings of a new device, until an LSS master stores others.
pub const DEFAULTS: Settings = Settings::new(BitRateSetting::Fixed(BitRate::Kbit125))
    // `None`: not configured, the device waits for an LSS master. Otherwise `NodeId::new(5)`, for example. Switches
    // take precedence: `pins.rs`.
    .with_node_id(None)
    // Milliseconds between heartbeats; 0 disables the heartbeat.
    .with_heartbeat_ms(1000);

/// The crystal (HSE) in Hz: a whole number of MHz from 4 to 26. There is no operation without one: see
/// [`HSI_ERROR_PPM`].
pub const CRYSTAL_HZ: u32 = 8_000_000;
/// Whether the clock is external (a Nucleo's ST-LINK, an oscillator) instead of a crystal.
pub const CRYSTAL_IS_EXTERNAL_CLOCK: bool = false;

/// The core clock.
pub const SYSCLK_HZ: u32 = sysclk_hz(&CHIP);
/// The core clock of a chip, legal without over-drive and at the voltage scale that it has after a reset. Chips of
/// 100 MHz run at 80 MHz.
pub const fn sysclk_hz(chip: &Chip) -> u32 {
    if chip.max_sysclk_mhz < 160 { 80_000_000 } else { 160_000_000 }
}
/// The clock of the CAN controller: the only whole number of MHz up to 50 with which all eight bit rates are exact and
/// tolerate crystals that are 0.5 % off (docs/bit-rates.md).
pub const APB1_HZ: u32 = 40_000_000;

/// The bit rates that LSS may select. Without `with_automatic()`, index 9 (automatic detection) is rejected.
pub const BIT_RATES: BitRates = BitRates::possible(APB1_HZ).with_automatic();

/// Bit-rate supervision: a device that receives lasting errors and no valid frame searches for the rate of the others,
/// and returns to its own: docs/bit-rates.md.
pub const RESCUE: bool = true;

/// LSS lock, which refuses LSS configuration while the node is NMT operational: docs/threat-model.md.
pub const LSS_LOCK: bool = false;

/// The error of the chip's own oscillator (HSI) between -40 and 105 degrees, in ppm (data sheets, ACC_HSI).
pub const HSI_ERROR_PPM: u32 = 80_000;

/// No bit rate tolerates HSI, even if the clocks of all other nodes are exact: the firmware offers no operation with
/// it.
const _: () = {
    let mut i = 0;
    while i < BitRate::ALL.len() {
        if let Some(timing) = BitTiming::solve(BitRate::ALL[i], APB1_HZ) {
            assert!(2 * timing.crystal_tolerance_ppm() < HSI_ERROR_PPM);
        }
        i += 1;
    }
};

const _: () = {
    assert!(SYSCLK_HZ <= CHIP.max_sysclk_mhz * 1_000_000, "SYSCLK_HZ is too high for the chip");
    assert!(APB1_HZ <= CHIP.max_apb1_mhz * 1_000_000, "APB1_HZ is too high for the chip");
    assert!(
        matches!(SYSCLK_HZ / APB1_HZ, 2 | 4 | 8 | 16) && SYSCLK_HZ.is_multiple_of(APB1_HZ),
        "APB1_HZ must be SYSCLK_HZ / 2, 4, 8 or 16"
    );
    assert!(
        CRYSTAL_HZ > 0,
        "a crystal or an external clock is needed: the chip's own oscillator is too inaccurate for CAN"
    );
    assert!(CRYSTAL_HZ.is_multiple_of(1_000_000), "CRYSTAL_HZ must be a whole number of MHz");
    assert!(4_000_000 <= CRYSTAL_HZ && CRYSTAL_HZ <= 26_000_000, "CRYSTAL_HZ must be 4 to 26 MHz");
    assert!(BIT_RATES.offers(DEFAULTS.bit_rate), "BIT_RATES does not offer DEFAULTS.bit_rate");
};
