//! A program without a panic handler that calls all of the node, its runner, the settings log, the indicators, the
//! LSS master and program updates with unknown values: it links only if the compiler has proved that none of these
//! calls panics.

#![no_std]
#![no_main]

mod master;
mod parameters;
mod runner;
mod update;

use core::{
    hint::{black_box, spin_loop},
    panic::PanicInfo,
};

use canopen_node::{
    Application, BitRate, BitRates, BusEvent, Device, Frame, Instant, Node, Settings,
    application::{Domain, Event, Integer24, OctetString, Text, Unsigned56},
    bit_rate::BitRateSetting,
    emergency::Fault,
    indicator::{BusState, Indicators},
    lss::{Address, StoreError},
    nmt, objects,
    pdo::{Rpdo, Tpdo},
    sdo::Abort,
    settings::{Log, parameters::Parameter},
};
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};

// SAFETY: a program that would call it cannot be linked.
unsafe extern "C" {
    /// A symbol without a definition.
    safe fn the_library_can_panic() -> !;
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    the_library_can_panic()
}

// SAFETY: the entry of the program, which has no other.
#[unsafe(no_mangle)]
extern "C" fn _start() -> ! {
    keep_settings();
    run_node();
    runner::drive();
    parameters::keep();
    indicate();
    master::command();
    update::install();
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
    let objects = any(Objects::new());
    drive(&mut ObjectsNode::with_application(device, any(Some(any_settings())), objects));
}

/// Calls all of a node. Between the calls it is in any state that its types allow.
fn drive<A: Application>(node: &mut Node<A>) {
    if let Some(frame) = Frame::from_padded(any(0), any(0), any([0; 8])) {
        black_box((frame.cob_id(), frame.data()));
        black_box(black_box(&mut *node).handle_frame(&any(frame), any_instant()));
    }
    black_box(&mut *node).handle_stored(any(Err(StoreError::MediumAccess)));
    black_box(&mut *node).handle_fault(any(Fault::Overrun));
    black_box(&mut *node).handle_bus_event(any(BusEvent::Error), any_instant());
    black_box(black_box(&mut *node).poll(any_instant()));
    black_box(&mut *node).report(any(0), any(0), any([0; 5]));
    black_box(&mut *node).end_report(any(0));
    black_box(black_box(&mut *node).application_mut());
    let (index, sub_index, data_type, value) = any((0, 0, 0, &[][..]));
    black_box(black_box(&mut *node).restore(&Parameter { index, sub_index, data_type, value }));
    let mut packed = [0; 1024];
    black_box(black_box(&mut *node).write_parameters(any(&[]), any(&mut packed)));
    let node = &*black_box(node);
    black_box(node.is_due(any_instant()));
    black_box((node.poll_at(), node.receives(), node.nmt_state(), node.node_id()));
    black_box((node.bit_rate(), node.is_listening(), node.lss().state()));
    black_box((node.active_bit_rate(), node.wants_to_send_more(), node.application()));
}

type ObjectsNode = Node<Objects>;

objects! {
    /// An object of each kind.
    struct Objects, values ObjectValue;

    0x2100 "Numbers" {
        1 "Boolean" boolean: bool = true, rw, stored;
        2 "8 bits" byte: u8 = 8, rw in 5..=250, mappable, stored;
        3 "16 bits" word: i16 = 16, ro, stored;
        4 "64 bits" long: u64 = 64, rw, stored;
        5 "Real" real: f64 = 0.5, rw in 0.0..=1.0, stored;
        6 "24 bits" short: Integer24 = -24, rw in -100..=100, mappable;
        7 "56 bits" large: Unsigned56 = 56, rw, stored;
        8..=10 "16 bits" words: [u16; 3] = [1; 3], rw in 1..=1000, mappable, stored;
    }
    0x2200 "Strings" {
        1 "Constant" constant: &'static str = "constant", constant;
        2 "Text" text: Text<20> = Text::EMPTY, rw, stored;
        3 "Octets" octets: OctetString<40> = OctetString::EMPTY, rw, stored;
        4 "Command" command: u16 = 0, wo;
    }
    0x2300 {
        0 "Domain" domain: Domain = Domain, rw;
    }
}

/// An application that answers arbitrarily.
impl Application for Objects {
    const TPDOS: &'static [Tpdo] = &[
        Tpdo::new(&[(0x2100, 2)]).with_event_timer(10),
        Tpdo::UNUSED,
        Tpdo::UNUSED,
        Tpdo::UNUSED,
    ];
    const RPDOS: &'static [Rpdo] = &[
        Rpdo::new(&[(0x2100, 2)]).with_transmission_type(0),
        Rpdo::UNUSED,
        Rpdo::UNUSED,
        Rpdo::UNUSED,
    ];
    const PRODUCERS: usize = 16;

    fn accept(&mut self, value: &ObjectValue) -> Result<(), Abort> {
        black_box(value);
        any(Ok(()))
    }

    fn handle(&mut self, event: Event) {
        black_box(event);
    }

    fn domain_len(&mut self, index: u16, sub_index: u8) -> Result<u32, Abort> {
        black_box((index, sub_index));
        any(Ok(any_number()))
    }

    fn read_domain(&self, index: u16, sub_index: u8, offset: u32, to: &mut [u8]) -> usize {
        black_box((index, sub_index, offset));
        to.fill_with(|| any(0));
        any(0)
    }

    fn begin_domain(
        &mut self,
        index: u16,
        sub_index: u8,
        announced: Option<u32>,
    ) -> Result<(), Abort> {
        black_box((index, sub_index, announced));
        any(Ok(()))
    }

    fn write_domain(
        &mut self,
        index: u16,
        sub_index: u8,
        offset: u32,
        bytes: &[u8],
    ) -> Result<(), Abort> {
        black_box((index, sub_index, offset, bytes));
        any(Ok(()))
    }

    fn end_domain(&mut self, index: u16, sub_index: u8, len: u32) -> Result<(), Abort> {
        black_box((index, sub_index, len));
        any(Ok(()))
    }

    fn abort_domain(&mut self, index: u16, sub_index: u8) {
        black_box((index, sub_index));
    }
}

fn indicate() {
    let mut indicators = any(Indicators::default());
    black_box(indicators.step(any(nmt::State::Stopped), any(true), any(BusState::Good)));
    black_box(any(BitRate::Kbit10).kbit_per_s());
}
