//! The LSS slave in a small node of one's own, which has a boot-up and a heartbeat. A master gives it a node-ID and a
//! bit rate, and both are there after a power cut. Time is simulated.

use embedded_storage::nor_flash::{ErrorType, NorFlash, ReadNorFlash};
use lss_slave::{
    BitRate, BitRates, BusEvent, Frame, Instant, NodeId, Settings,
    bit_rate::{self, Step},
    cob_id,
    lss::{self, Address, Reaction, Request, Response, Slave, StoreError},
    settings::Log,
};

const ADDRESS: Address =
    Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 4 };
/// Those that the CAN controller can produce from its clock.
const RATES: BitRates = BitRates::possible(40_000_000);
const HEARTBEAT_MICROS: u32 = 500_000;

/// The node: LSS, bit rate and settings are the library's, the rest is its own.
struct Node {
    lss: Slave,
    bit_rate: bit_rate::Control,
    log: Log<Flash>,
    is_boot_up_due: bool,
    heartbeat_at: Instant,
}

impl Node {
    /// The node after power-on.
    fn new(flash: Flash) -> Self {
        let (log, _) = Log::open(flash);
        let settings = log.settings().unwrap_or(Settings::new(BitRate::Kbit125.into()));
        let bit_rate = RATES.or_automatic(settings.bit_rate);
        Self {
            lss: Slave::new(ADDRESS, RATES, settings.node_id, bit_rate),
            bit_rate: bit_rate::Control::new(bit_rate, RATES).with_rescue(ADDRESS.serial_number),
            log,
            is_boot_up_due: true,
            heartbeat_at: Instant::from_micros(0),
        }
    }

    fn handle_frame(&mut self, frame: &Frame, now: Instant) {
        if !self.bit_rate.is_settled() && !self.bit_rate.handle_frame(frame, now) {
            return;
        }
        match (frame.cob_id(), frame.data()) {
            (lss::REQUEST_COB_ID, data) if !self.bit_rate.is_switching() => {
                if let Some(reaction) = data.try_into().ok().and_then(|data| self.lss.handle(data))
                {
                    self.react(reaction, now);
                }
            }
            // The node's own NMT: here only reset communication of all nodes.
            (cob_id::NMT_COMMAND, [0x82, 0]) => self.reset_communication(),
            _ => {}
        }
    }

    fn react(&mut self, reaction: Reaction, now: Instant) {
        match reaction {
            Reaction::Answer(answer) => self.send(answer, now),
            Reaction::ActivateBitTiming(delay_ms) => self.bit_rate.switch(delay_ms, now),
            Reaction::StoreConfiguration => {
                let settings = Settings::new(self.lss.pending_bit_rate())
                    .with_node_id(self.lss.pending_node_id());
                let outcome = self.log.store(settings).map_err(StoreError::from);
                self.send(Response::StoreConfiguration(outcome).to_frame(), now);
            }
            Reaction::ResetCommunication => self.reset_communication(),
        }
    }

    fn reset_communication(&mut self) {
        self.lss.reset_communication();
        self.is_boot_up_due = true;
    }

    /// Does what is due.
    fn poll(&mut self, now: Instant) {
        while let Some(next) = self.bit_rate.poll(self.lss.state(), now) {
            match next {
                bit_rate::Next::StopTransmitting => println!("  stops sending"),
                bit_rate::Next::Activate { silent_until } => {
                    let setting = self.lss.activate_bit_rate(self.bit_rate.active());
                    self.bit_rate.activate(setting, silent_until);
                }
                bit_rate::Next::EndSwitch => self.heartbeat_at = now,
                bit_rate::Next::Step(Step::TakePart(rate)) => {
                    println!("  takes part at {} kbit/s", rate.kbit_per_s());
                }
                bit_rate::Next::Step(Step::Listen(rate)) => {
                    println!("  listens at {} kbit/s", rate.kbit_per_s());
                    if !self.bit_rate.is_detecting() {
                        self.lss.discard_session();
                    }
                }
                bit_rate::Next::Step(Step::DropFrames) => println!("  drops its frames"),
                bit_rate::Next::ResumeTransmitting => println!("  sends again"),
                bit_rate::Next::KeepSilent => return,
                bit_rate::Next::Settled => println!("  the bit rate is proven"),
            }
        }
        let Some(node_id) = self.lss.active_node_id().filter(|_| self.bit_rate.may_send()) else {
            return;
        };
        let is_boot_up = std::mem::take(&mut self.is_boot_up_due);
        if is_boot_up || self.heartbeat_at.has_come(now) {
            self.heartbeat_at = now.plus_micros(HEARTBEAT_MICROS);
            let state = if is_boot_up { 0x00 } else { 0x7F };
            let cob_id = cob_id::ERROR_CONTROL + u16::from(node_id.get());
            self.send(Frame::new(cob_id, &[state]).expect("one byte"), now);
        }
    }

    /// Sends a frame, which another node acknowledges.
    fn send(&mut self, frame: Frame, now: Instant) {
        println!("  < {frame:?}");
        self.bit_rate.note_sent(now);
        self.bit_rate.handle_bus(BusEvent::Acknowledged, now);
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
    assert_eq!(node.lss.active_node_id(), NodeId::new(5));
    assert_eq!(node.bit_rate.in_use(), BitRate::Kbit500);
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
