//! This project's node.

#![no_std]
#![no_main]

use bench::{IDENTITY, NOW, Place, Register, received_data, received_identifier, transmit};
use canopen_node::{
    Action, BitRate, BitRates, BusEvent, Device, Frame, Instant, Node, Receives, Settings,
    lss::Address,
};

const BIT_RATES: BitRates = BitRates::possible(40_000_000);

static NODE: Place<Node> = Place::empty();
/// The filter, which the chip has in its controller.
static RECEIVES: Place<Receives> = Place::empty();
/// The deadline of the timer; 0: off.
static TIMER: Register = Register::zero();

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn prepare() {
    let [vendor_id, product_code, revision_number, serial_number] = IDENTITY;
    let address = Address { vendor_id, product_code, revision_number, serial_number };
    let device = Device::new(address, BIT_RATES)
        .with_defaults(Settings::new(BitRate::Kbit125.into()))
        .with_name("Bench")
        .with_versions("1", "1")
        .with_rescue(true);
    let node = Node::new(device, None);
    RECEIVES.fill(node.receives());
    NODE.fill(node);
}

// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
extern "C" fn receive() {
    let cob_id = received_identifier();
    // SAFETY: `prepare` has filled it, and the reference ends here.
    if unsafe { RECEIVES.get() }.contains(cob_id) {
        receive_own(cob_id);
    }
}

fn receive_own(cob_id: u16) {
    // SAFETY: `prepare` has filled it, and the reference ends here.
    let node = unsafe { NODE.get() };
    let now = Instant::from_micros(NOW.read());
    let (length, data) = received_data();
    let Some(frame) = Frame::from_padded(cob_id, length, data) else {
        return;
    };
    if let Some(action) = node.handle_frame(&frame, now) {
        act(node, action);
    }
    if node.is_due(now) {
        act_until_nothing_is_due(node, now);
    }
}

#[inline(never)]
fn act_until_nothing_is_due(node: &mut Node, now: Instant) {
    while let Some(action) = node.poll(now) {
        act(node, action);
    }
    TIMER.write(node.poll_at().map_or(0, |deadline| deadline.as_micros() | 1));
}

#[inline(always)]
fn act(node: &mut Node, action: Action) {
    match action {
        Action::Transmit(frame) => {
            transmit(frame.cob_id(), frame.data().len(), frame.padded_data());
            // The firmware reports it in the transmit interrupt.
            node.handle_bus_event(BusEvent::Acknowledged, Instant::from_micros(0));
        }
        Action::SetNodeId(_) | Action::SetReceives => RECEIVES.fill(node.receives()),
        Action::Store(_) => node.handle_stored(Ok(())),
        Action::SetBitRate(_) | Action::ResumeTransmitting => {
            node.handle_bus_event(BusEvent::Acknowledged, Instant::from_micros(0));
        }
        _ => {}
    }
}
