//! The smallest port: an ESP32-C3 as a CANopen LSS slave, in a loop that polls the controller. The driver's own
//! interrupt drops the kind of an error, and while the flash is written no interrupt is served.

#![no_std]
#![no_main]

mod controller;

use core::{cell::RefCell, panic::PanicInfo};

use canopen_node::{
    BitRate, BitRateSetting, Device, Instant, Node, Settings,
    application::NoApplication,
    lss::Address,
    runner::{self, Runner, System},
    settings::Log,
};
use embassy_embedded_hal::flash::partition::BlockingPartition;
use embassy_sync::blocking_mutex::{Mutex, raw::NoopRawMutex};
use esp_hal::{
    efuse,
    gpio::{Level, Output, OutputConfig},
    system::software_reset,
    time::{self, Duration},
    timer::timg::{MwdtStage, TimerGroup},
};
use esp_println::println;
use esp_storage::FlashStorage;

use controller::Controller;

/// The settings: two sectors of the flash, at the start of the partition `nvs` of espflash's default table.
const SETTINGS_ADDRESS: u32 = 0x9000;
const SETTINGS_LEN: u32 = 2 * FlashStorage::SECTOR_SIZE;

const DEVICE: Device = Device::new(
    // Your company's vendor-ID, from CiA, and your numbers for this product.
    Address {
        vendor_id: 0,
        product_code: 0x4C53_5343,
        revision_number: 0x0001_0000,
        serial_number: 0,
    },
    port_esp32c3::BIT_RATES,
)
.with_defaults(Settings::new(BitRateSetting::Fixed(BitRate::Kbit125)))
.with_heartbeat_ms(1000)
.with_name("LSS slave")
.with_rescue(true);

esp_bootloader_esp_idf::esp_app_desc!();

#[esp_hal::main]
fn main() -> ! {
    let chip = esp_hal::init(esp_hal::Config::default());
    let flash = Mutex::<NoopRawMutex, _>::new(RefCell::new(FlashStorage::new(chip.FLASH)));
    let settings = BlockingPartition::new(&flash, SETTINGS_ADDRESS, SETTINGS_LEN);
    // It may erase, 0.4 s at most a sector, so the watchdog starts later.
    let (mut log, found) =
        Log::<_, { Node::<NoApplication>::STORED_LEN }>::open_with_parameters(settings);

    // The last four bytes of the MAC address.
    let mac = efuse::base_mac_address();
    let serial_number =
        mac.as_bytes().iter().fold(0, |number, byte| number << 8 | u32::from(*byte));
    let device = DEVICE.with_serial_number(serial_number);
    let mut node = Node::new(device, log.settings());
    println!("settings: {:?}", runner::restore(&mut node, &mut log, found));

    let can = Controller::new(chip.TWAI0, chip.GPIO3, chip.GPIO10);
    let mut runner = Runner::new(node, can, Chip);
    let mut run = Output::new(chip.GPIO4, Level::Low, OutputConfig::default());
    let mut error = Output::new(chip.GPIO5, Level::Low, OutputConfig::default());
    let mut watchdog = TimerGroup::new(chip.TIMG0).wdt;
    watchdog.set_timeout(MwdtStage::Stage0, Duration::from_millis(500));
    watchdog.enable();
    loop {
        if let Some(lit) = runner.poll(&mut log).lit {
            run.set_level(lit.run.into());
            error.set_level(lit.error.into());
            watchdog.feed();
        }
    }
}

/// The clock and the reset.
struct Chip;

impl System for Chip {
    fn now(&self) -> Instant {
        // The count of microseconds wraps.
        Instant::from_micros(time::Instant::now().duration_since_epoch().as_micros() as u32)
    }

    fn reset(&mut self) {
        software_reset();
    }
}

#[panic_handler]
fn panic(why: &PanicInfo) -> ! {
    println!("{why}");
    software_reset()
}
