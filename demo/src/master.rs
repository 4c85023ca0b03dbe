//! The LSS master on the emulated bus.

use anyhow::Context;
use emulator::{
    Time,
    board::Board,
    can::{Adapter, Frame},
    network::{AdapterId, Network},
};
use lss_master::{Master as Lss, Procedure};
use lss_slave::BitRate;
use testkit::{
    image_rig::bit_per_s,
    lss_session::{carry_out, timing},
};

/// The time from the reception of a frame to its record.
const TO_THE_END: Time = Time::from_us(100);

/// The master, its bus and the boards.
pub struct Master {
    pub network: Network,
    adapter: AdapterId,
    lss: Lss,
}

impl Master {
    /// A master at `bit_rate`, and boards that are switched on now.
    pub fn new(boards: impl IntoIterator<Item = Board>, bit_rate: BitRate) -> Self {
        let mut network = Network::new();
        for board in boards {
            network.add_board(board);
        }
        let adapter = network.add_adapter(Adapter::new(bit_per_s(bit_rate)));
        Self { network, adapter, lss: Lss::new(timing(bit_rate)) }
    }

    /// Lets time pass.
    pub fn pass(&mut self, span: Time) {
        self.network.run_for(span);
    }

    /// Changes the bit rate of the master.
    pub fn set_bit_rate(&mut self, bit_rate: BitRate) {
        self.network.adapter_mut(self.adapter).set_bit_rate(bit_per_s(bit_rate));
        self.lss = Lss::new(timing(bit_rate));
    }

    /// The next received frame.
    ///
    /// # Errors
    /// None comes within `timeout`.
    pub fn receive(&mut self, timeout: Time) -> anyhow::Result<Frame> {
        let received = self.network.run_until_received(self.adapter, timeout);
        let (_, frame) = received.with_context(|| format!("no frame came within {timeout} ms"))?;
        self.pass(TO_THE_END);
        Ok(frame)
    }

    /// Carries out a procedure of the LSS master.
    pub fn carry_out<P: Procedure>(&mut self, procedure: P) -> anyhow::Result<P::Output> {
        let output = carry_out(&mut self.network, self.adapter, &mut self.lss, procedure)?;
        self.pass(TO_THE_END);
        Ok(output)
    }
}
