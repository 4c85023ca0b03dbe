//! A node on a bus within the process: channels carry the frames, and an LSS master assigns a node-ID.

use std::{sync::mpsc, thread, time::Duration};

use canopen_node::{
    Action, BitRate, BitRates, BusEvent, Device, Frame, Instant, Node, Services, Settings,
    lss::Address,
};

fn main() {
    let (to_node, received) = mpsc::channel();
    let (transmitted, from_node) = mpsc::channel();
    thread::spawn(move || run(received, transmitted));
    for request in [
        [0x4C, 0, 0, 0, 0, 0, 0, 0], // Asks for slaves without a node-ID.
        [0x04, 1, 0, 0, 0, 0, 0, 0], // Switches to LSS configuration state.
        [0x11, 5, 0, 0, 0, 0, 0, 0], // Sets node-ID 5.
        [0x17, 0, 0, 0, 0, 0, 0, 0], // Stores it.
        [0x04, 0, 0, 0, 0, 0, 0, 0], // Switches to LSS waiting state: the node boots up.
    ] {
        println!("> 7E5 {request:02X?}");
        to_node.send(Frame::new(0x7E5, &request).unwrap()).unwrap();
        while let Ok(frame) = from_node.recv_timeout(Duration::from_millis(50)) {
            println!("< {:03X} {:02X?}", frame.cob_id(), frame.data());
        }
    }
}

/// The board, which carries out the node's actions until the process ends.
fn run(received: mpsc::Receiver<Frame>, transmitted: mpsc::Sender<Frame>) {
    let address = Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
    let device = Device::new(address, BitRates::possible(40_000_000))
        .with_defaults(Settings::new(BitRate::Kbit125.into()))
        .with_name("Example");
    let mut node = Node::new(device, None);
    let start = std::time::Instant::now();
    let now = || Instant::from_micros(start.elapsed().as_micros() as u32);
    let mut first = None;
    loop {
        while let Some(action) = first.take().or_else(|| node.poll(now())) {
            match action {
                Action::Transmit(frame, service) => {
                    transmitted.send(frame).unwrap();
                    node.handle_sent(Services::of(service), now());
                    if node.wants_to_send_more() {
                        node.handle_bus_event(BusEvent::NonePending, now());
                    }
                }
                Action::Store(_settings) => node.handle_stored(Ok(&[])),
                other => println!("  {other:?}"),
            }
        }
        let wait = node.poll_at().map_or(u32::MAX, |at| at.micros_after(now()));
        let frame = received.recv_timeout(Duration::from_micros(wait.into())).ok();
        first = frame.and_then(|frame| node.handle_frame(&frame, now()));
    }
}
