//! A program without a panic handler that calls all of the node, the settings log and the indicators with unknown
//! values: it links only if the compiler has proved that none of these calls panics.

#![no_std]
#![no_main]

mod parameters;

use core::{
    hint::{black_box, spin_loop},
    panic::PanicInfo,
};

use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};
use lss_slave::{
    Application, BitRate, BitRates, BusEvent, Device, Frame, Instant, Node, Settings,
    bit_rate::BitRateSetting,
    emergency::Fault,
    indicator::{BusState, Indicators},
    lss::{Address, StoreError},
    nmt, objects,
    process_data::{Rpdo, Tpdo},
    settings::Log,
};

objects! {
    /// A product with process data.
    struct Machine, values MachineValue;

    0x6000 "Inputs" {
        1 "8 bits" short: u8 = 0, rw, 0..=100, mappable;
        2 "64 bits" long: u64 = 0, rw, mappable;
    }
}

impl Application for Machine {
    const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 1)]).with_event_timer(10)];
    const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x6000, 2)]).with_transmission_type(0)];
}

unsafe extern "C" {
    /// A symbol without a definition.
    safe fn the_library_can_panic() -> !;
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    the_library_can_panic()
}

#[unsafe(no_mangle)]
extern "C" fn _start() -> ! {
    keep_settings();
    run_node();
    parameters::keep();
    indicate();
    #[cfg(feature = "panic")]
    assert_ne!(black_box(1), 2);
    loop {
        spin_loop();
    }
}

/// A value of which the compiler knows only the type.
fn any<T>(value: T) -> T {
    black_box(value)
}

fn any_number() -> u32 {
    any(0)
}

fn any_settings() -> Settings {
    any(Settings::new(BitRateSetting::Automatic))
}

fn any_instant() -> Instant {
    Instant::from_micros(any_number())
}

/// A flash of any size, with any content, whose operations fail arbitrarily.
struct Flash;

impl ErrorType for Flash {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 4;

    fn read(&mut self, _: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        bytes.fill_with(|| any(0));
        any(Ok(()))
    }

    fn capacity(&self) -> usize {
        any_number() as usize
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 0x4000;

    fn erase(&mut self, _: u32, _: u32) -> Result<(), NorFlashErrorKind> {
        any(Ok(()))
    }

    fn write(&mut self, _: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        black_box(bytes);
        any(Ok(()))
    }
}

fn keep_settings() {
    let (mut log, found) = any(Log::open(Flash));
    black_box((found, log.settings()));
    // After any calls, with the log in any state.
    black_box(&mut log);
    black_box(log.store(any_settings())).ok();
    black_box(log.close());
}

fn any_device() -> Device {
    let address = Address {
        vendor_id: any_number(),
        product_code: any_number(),
        revision_number: any_number(),
        serial_number: Address::serial_number_of(&any([0; 12])),
    };
    // The bit timing solver is for constants.
    let bit_rates = any(const { BitRates::possible(40_000_000) });
    Device::new(address, bit_rates)
        .with_defaults(any_settings())
        .with_name(any(""))
        .with_versions(any(""), any(""))
        .with_rescue(any(true))
        .with_lss_lock(any(true))
}

fn run_node() {
    let device = any_device();
    black_box(Frame::new(any(0), any(&[])));
    drive(&mut Node::new(device, any(Some(any_settings()))));
    let machine = Machine::new();
    let mut node: Node<Machine, 4, 4, 16> =
        Node::with_application(device, any(Some(any_settings())), machine);
    black_box(&mut node).report(any(0), any(0), any([0; 5]));
    black_box(&mut node).end_report(any(0));
    black_box(&mut node).application_mut().short = any(0);
    drive(&mut node);
}

/// Between the calls the node is in any state that its types allow.
fn drive<A: Application, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>(
    node: &mut Node<A, TPDOS, RPDOS, PRODUCERS>,
) {
    if let Some(frame) = Frame::from_padded(any(0), any(0), any([0; 8])) {
        black_box((frame.cob_id(), frame.data()));
        black_box(black_box(&mut *node).handle_frame(&any(frame), any_instant()));
    }
    black_box(&mut *node).handle_stored(any(Err(StoreError::MediumAccess)));
    black_box(&mut *node).handle_fault(any(Fault::Overrun));
    black_box(&mut *node).handle_bus(any(BusEvent::Error), any_instant());
    black_box(black_box(&mut *node).poll(any_instant()));
    let node = &*black_box(node);
    black_box(node.is_due(any_instant()));
    black_box((node.poll_at(), node.receives(), node.nmt_state(), node.node_id()));
    black_box((node.bit_rate(), node.is_listening(), node.lss().state()));
}

fn indicate() {
    let mut indicators = any(Indicators::default());
    black_box(indicators.step(any(nmt::State::Stopped), any(true), any(BusState::Good)));
    black_box(any(BitRate::Kbit10).kbit_per_s());
}
