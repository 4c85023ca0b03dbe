//! A small LSS master on the emulated bus, one request at a time.

use anyhow::{Context, ensure};
use emulator::{
    Time,
    board::Board,
    can::{Adapter, Frame, Id},
    network::{AdapterId, Network},
};
use lss_slave::{
    BitRate,
    lss::{self, FastscanStep, Request},
};
use testkit::image_rig::bit_per_s;

/// The longest time for which the master waits for an answer.
const TIMEOUT: Time = Time::from_ms(20);
/// The bit check of the first step of a Fastscan.
const BEGIN: u8 = 0x80;
/// The period with which the master looks for frames, and the time that it takes to read one.
const POLL: Time = Time::from_us(100);

/// The master, its bus and the boards.
pub struct Master {
    pub network: Network,
    adapter: AdapterId,
}

impl Master {
    /// A master at `bit_rate`, and boards that are switched on now.
    pub fn new(boards: impl IntoIterator<Item = Board>, bit_rate: BitRate) -> Self {
        let mut network = Network::new();
        for board in boards {
            network.add_board(board);
        }
        let adapter = network.add_adapter(Adapter::new(bit_per_s(bit_rate)));
        Self { network, adapter }
    }

    /// Lets time pass.
    pub fn pass(&mut self, span: Time) {
        let end = self.network.now() + span;
        self.network.run_until(end);
    }

    /// Changes the bit rate of the master.
    pub fn set_bit_rate(&mut self, bit_rate: BitRate) {
        self.network.adapter_mut(self.adapter).set_bit_rate(bit_per_s(bit_rate));
    }

    /// The next received frame.
    ///
    /// # Errors
    /// None comes within `timeout`.
    pub fn receive(&mut self, timeout: Time) -> anyhow::Result<Frame> {
        let end = self.network.now() + timeout;
        loop {
            let received = self.network.receive(self.adapter);
            self.pass(POLL);
            if let Some((_, frame)) = received {
                return Ok(frame);
            }
            ensure!(self.network.now() < end, "no frame came within {timeout} ms");
        }
    }

    /// Sends a request that has no answer, and returns when it has left.
    pub fn send(&mut self, request: Request) {
        while self.network.receive(self.adapter).is_some() {}
        let frame = Frame::data(Id::Standard(lss::REQUEST_COB_ID), &request.to_bytes());
        self.network.send(self.adapter, frame);
        while self.network.adapter_mut(self.adapter).unsent() > 0 {
            self.pass(POLL);
        }
    }

    /// Sends a request; its answer must have the same command specifier and the error code 0.
    pub fn request(&mut self, request: Request) -> anyhow::Result<()> {
        self.send(request);
        let answer = self.receive(TIMEOUT).with_context(|| format!("{request:?}"))?;
        ensure!(
            answer.id == Id::Standard(lss::RESPONSE_COB_ID)
                && answer.payload().starts_with(&[request.to_bytes()[0], 0]),
            "{request:?} was answered by {answer}"
        );
        Ok(())
    }

    /// Finds a node by LSS Fastscan (CiA 305) and returns its LSS address: vendor-ID, product code, revision number and
    /// serial number. The node is in LSS configuration state then.
    pub fn fast_scan(&mut self) -> anyhow::Result<[u32; 4]> {
        let step = |id_number, bit_check, sub, next| {
            Request::Fastscan(FastscanStep { id_number, bit_check, sub, next })
        };
        ensure!(self.is_answered(step(0, BEGIN, 0, 0)), "all nodes have a node-ID");
        let mut address = [0; 4];
        for (sub, next) in [(0, 1), (1, 2), (2, 3), (3, 0)] {
            let mut number = 0;
            for bit in (0..32).rev() {
                // Nodes whose number begins with the bits found so far and a 0 answer.
                if !self.is_answered(step(number, bit, sub, sub)) {
                    number |= 1 << bit;
                }
            }
            ensure!(self.is_answered(step(number, 0, sub, next)), "no node confirms {number:08X}");
            address[usize::from(sub)] = number;
        }
        Ok(address)
    }

    fn is_answered(&mut self, request: Request) -> bool {
        self.send(request);
        self.receive(TIMEOUT).is_ok()
    }
}
