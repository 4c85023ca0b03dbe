//! The settings that make the firmware your product: identity, defaults and crystal. Edit this file first, then
//! `pins.rs` and `application.rs`. The chip is a feature of the build, such as `stm32f446`.

use canopen_node::{BitRate, BitRateSetting, BitRates, Device, Settings, lss::Address};
use canopen_stm32f4::chip::APB1_HZ;

/// Your company's name. Only the EDS contains it.
pub const VENDOR_NAME: &str = "Not registered";
/// The product in one line. Only the EDS contains it.
pub const DESCRIPTION: &str = "CANopen LSS slave on an STM32F4";

/// The device, but for its serial number: `main.rs` takes that from the chip's unique id.
pub const DEVICE: Device = Device::new(
    Address {
        // Your company's vendor-ID, from CiA.
        vendor_id: 0x0000_0000,
        // Your number for this product.
        product_code: 0x4C53_5334,
        // Major revision (changes in the behaviour on the bus) in the upper 16 bits, minor in the lower.
        revision_number: 0x0001_0000,
        serial_number: 0,
    },
    BIT_RATES,
)
.with_defaults(DEFAULTS)
// Milliseconds between heartbeats, object 1017h, until a master stores another time; 0 disables the heartbeat.
.with_heartbeat_ms(1000)
// Manufacturer device name, object 1008h.
.with_name("LSS slave")
// Manufacturer hardware and software version, objects 1009h and 100Ah.
.with_versions("1.0", env!("CARGO_PKG_VERSION"))
// Bit-rate supervision: a device whose rate no frame has proven since power-on searches for the rate of the others
// after an error. A proven rate is never left: docs/reference.md.
.with_rescue(true)
// LSS lock, which refuses LSS configuration while the node is NMT operational: docs/reference.md.
.with_lss_lock(false);

/// The settings of a new device, until an LSS master stores others.
pub const DEFAULTS: Settings = Settings::new(BitRateSetting::Fixed(BitRate::Kbit125))
    // `None`: not configured, the device waits for an LSS master. Otherwise `NodeId::new(5)`, for example.
    .with_node_id(None);

/// The bit rates that LSS may select. Without `with_automatic()`, index 9 (automatic detection) is rejected.
pub const BIT_RATES: BitRates = BitRates::possible(APB1_HZ).with_automatic();

const _: () =
    assert!(BIT_RATES.offers(DEFAULTS.bit_rate), "BIT_RATES does not offer DEFAULTS.bit_rate");

/// The crystal (HSE) in Hz: a whole number of MHz from 4 to 26. There is no operation without one
/// (docs/reference.md).
pub const CRYSTAL_HZ: u32 = 8_000_000;
/// Whether the clock is external (a Nucleo's ST-LINK, an oscillator) instead of a crystal. Otherwise a start takes 100 ms
/// longer, and the log says so.
pub const CRYSTAL_IS_EXTERNAL_CLOCK: bool = cfg!(feature = "nucleo-f446re");
