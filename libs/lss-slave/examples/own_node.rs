//! The LSS slave in a small node of one's own, which has a boot-up and a heartbeat. A master gives it a node-ID and a
//! bit rate, and both are there after a power cut. Time is simulated.

use embedded_storage::nor_flash::{ErrorType, NorFlash, ReadNorFlash};
use lss_slave::{
    Action, BitRate, BitRates, BusEvent, Frame, Instant, NodeId, Settings, Slave, cob_id,
    lss::{Address, Request, StoreError},
    settings::Log,
};

const ADDRESS: Address =
    Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
/// Those that the CAN controller can produce from its clock.
const RATES: BitRates = BitRates::possible(40_000_000);
const HEARTBEAT_MICROS: u32 = 500_000;

/// The node: LSS, bit rate and settings are the library's, the rest is its own.
struct Node {
    slave: Slave,
    log: Log<Flash>,
    boot_up: Option<Frame>,
    heartbeat_at: Instant,
}

impl Node {
    /// The node after power-on.
    fn new(flash: Flash) -> Self {
        let (log, _) = Log::open(flash);
        let settings = log.settings().unwrap_or(Settings::new(BitRate::Kbit125.into()));
        let slave = Slave::new(ADDRESS, RATES, settings).with_rescue();
        Self { boot_up: slave.boot_up(), slave, log, heartbeat_at: Instant::from_micros(0) }
    }

    fn handle_frame(&mut self, frame: &Frame, now: Instant) {
        let is_served = !self.slave.bit_rate().is_listening();
        if let Some(action) = self.slave.handle_frame(frame, now) {
            self.act(action, now);
        }
        // The node's own NMT: here only reset communication of all nodes.
        if is_served && frame.cob_id() == cob_id::NMT_COMMAND && frame.data() == [0x82, 0] {
            self.reset_communication();
        }
        self.poll(now);
    }

    /// Does what is due.
    fn poll(&mut self, now: Instant) {
        while let Some(action) = self.slave.poll(now) {
            self.act(action, now);
        }
        let Some(node_id) = self.slave.lss().active_node_id().filter(|_| self.slave.may_send())
        else {
            return;
        };
        if let Some(boot_up) = self.boot_up.take() {
            self.send(boot_up, now);
        } else if self.heartbeat_at.has_come(now) && !self.slave.bit_rate().is_guest() {
            self.heartbeat_at = now.plus_micros(HEARTBEAT_MICROS);
            let cob_id = cob_id::ERROR_CONTROL + u16::from(node_id.get());
            self.send(Frame::new(cob_id, &[0x7F]).expect("one byte"), now);
        }
    }

    fn act(&mut self, action: Action, now: Instant) {
        match action {
            Action::Transmit(answer) => self.send(answer, now),
            Action::Store => {
                let outcome = self.log.store(self.slave.lss().pending());
                self.slave.handle_stored(outcome.map_err(StoreError::from));
            }
            Action::ResetCommunication => self.reset_communication(),
            Action::SetBitRate(rate) => println!("  takes part at {rate}"),
            Action::Listen(rate) => println!("  listens at {rate}"),
            Action::DropFrames => println!("  drops its frames"),
            Action::FilterFrames => println!("  the bit rate is proven"),
        }
    }

    fn reset_communication(&mut self) {
        self.slave.reset_communication();
        self.boot_up = self.slave.boot_up();
    }

    /// Sends a frame, which another node acknowledges.
    fn send(&mut self, frame: Frame, now: Instant) {
        println!("  < {frame:?}");
        self.slave.note_sent(now);
        self.slave.handle_bus_event(BusEvent::Acknowledged, now);
    }
}

fn main() {
    let mut node = Node::new(Flash([0xFF; 2 * Flash::ERASE_SIZE]));
    let mut now = Instant::from_micros(0);
    for request in [
        Request::SwitchToConfiguration,
        Request::ConfigureNodeId(5),
        Request::ConfigureBitTiming { table: 0, index: BitRate::Kbit500.index() },
        Request::StoreConfiguration,
        Request::ActivateBitTiming(10),
        Request::SwitchToWaiting,
    ] {
        println!("> {request:?}");
        node.handle_frame(&request.to_frame(), now);
        // Longer than both switch delays.
        for _ in 0..30 {
            node.poll(now);
            now = now.plus_micros(1_000);
        }
    }
    println!("A power cut");
    let mut node = Node::new(node.log.close());
    node.poll(now);
    assert_eq!(node.slave.lss().active_node_id(), NodeId::new(5));
    assert_eq!(node.slave.bit_rate().in_use(), BitRate::Kbit500);
}

/// Flash in RAM, of two sectors.
struct Flash([u8; 2 * Self::ERASE_SIZE]);

impl ErrorType for Flash {
    type Error = core::convert::Infallible;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Self::Error> {
        let offset = offset as usize;
        bytes.copy_from_slice(&self.0[offset..offset + bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.0.len()
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 1024;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Self::Error> {
        self.0[from as usize..to as usize].fill(0xFF);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Self::Error> {
        let offset = offset as usize;
        self.0[offset..offset + bytes.len()].copy_from_slice(bytes);
        Ok(())
    }
}
