//! This project's node in the harness, with any application.

use canopen_node::{
    Action, Application, BitRate, BitRates, BusEvent, Device, Frame, Instant, Node, Receives,
    Services, Settings, lss::Address,
};

use crate::{DEVICE_NAME, IDENTITY, NOW, Register, received_data, received_identifier, transmit};

const BIT_RATES: BitRates = BitRates::possible(40_000_000);

/// The deadline of the timer; 0: off.
static TIMER: Register = Register::zero();

/// The node, and the filter, which the chip has in its controller.
pub struct Own<A: Application> {
    node: Node<A>,
    receives: Receives<A::Numbers>,
}

impl<A: Application> Own<A> {
    /// A node after power-on.
    pub fn new(application: A) -> Self {
        let [vendor_id, product_code, revision_number, serial_number] = IDENTITY;
        let address = Address { vendor_id, product_code, revision_number, serial_number };
        let device = Device::new(address, BIT_RATES)
            .with_defaults(Settings::new(BitRate::Kbit125.into()))
            .with_name(DEVICE_NAME)
            .with_versions("1", "1")
            .with_rescue(true);
        let node = Node::with_application(device, None, application);
        Self { receives: node.receives(), node }
    }

    /// Handles the received frame, as the board's interrupt does.
    #[inline(always)]
    pub fn receive(&mut self) {
        let cob_id = received_identifier();
        if self.receives.contains(cob_id) {
            self.receive_own(cob_id);
        }
    }

    fn receive_own(&mut self, cob_id: u16) {
        let now = Instant::from_micros(NOW.read());
        let (length, data) = received_data();
        let Some(frame) = Frame::from_padded(cob_id, length, data) else {
            return;
        };
        if let Some(action) = self.node.handle_frame(&frame, now) {
            self.act(action);
        }
        if self.node.is_due(now) {
            self.act_until_nothing_is_due(now);
        }
    }

    #[inline(never)]
    fn act_until_nothing_is_due(&mut self, now: Instant) {
        while let Some(action) = self.node.poll(now) {
            self.act(action);
        }
        TIMER.write(self.node.poll_at().map_or(0, |deadline| deadline.as_micros() | 1));
    }

    #[inline(always)]
    fn act(&mut self, action: Action) {
        match action {
            Action::Transmit(frame, service) => {
                transmit(frame.cob_id(), frame.data().len(), frame.padded_data());
                // The firmware reports it in the transmit interrupt.
                self.node.handle_sent(Services::of(service), Instant::from_micros(0));
            }
            Action::SetNodeId(_) | Action::SetReceives => self.receives = self.node.receives(),
            Action::Store(_) => self.node.handle_stored(Ok(&[])),
            Action::SetBitRate(_) => {
                self.node.handle_bus_event(BusEvent::Acknowledged, Instant::from_micros(0));
            }
            _ => {}
        }
    }
}
