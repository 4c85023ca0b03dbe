//! A storm of random frames against the node in the process.

use lss_slave::{
    Action, Settings,
    lss::{Address, State},
};

use super::{RATE, Target, delivered, frame, lss_data};
use crate::{
    node_rig::{ADDRESS, NodeRig, defaults},
    random::Random,
};

/// The interval between frames in microseconds, on a full bus.
const FRAME_US: u64 = 130;
/// The last part of a silent period, in which the storm continues.
const STORMY_SILENCE_US: u64 = 5_000;
/// The number of frames between the slow checks.
const ROUND: u64 = 20_000;

/// A board in the process, and the frames sent to it.
pub struct NodeStorm {
    board: NodeRig,
    defaults: Settings,
    random: Random,
    /// The number of frames so far.
    pub frames: u64,
    /// The number of stores that the node requested.
    pub stores: u64,
}

impl NodeStorm {
    pub fn new(seed: u64) -> Self {
        let defaults = defaults(0xFF).with_bit_rate(RATE.into());
        let board = NodeRig::with_defaults(defaults);
        Self { board, defaults, random: Random::from_seed(seed), frames: 0, stores: 0 }
    }

    /// Sends this number of further frames. The board itself checks that nothing is sent in a silent period.
    ///
    /// # Panics
    /// If anything was stored without a request, or the node no longer answers.
    pub fn rage(&mut self, frames: u64) {
        for _ in 0..frames {
            self.one_more();
            self.frames += 1;
            if self.frames.is_multiple_of(ROUND) {
                self.check_that_it_answers();
            }
        }
        self.check_that_it_answers();
    }

    fn one_more(&mut self) {
        let node_id = self.board.node.node_id().map_or(0, |id| id.get());
        let frame = frame(&mut self.random, &target(node_id));
        self.board.pass_us(FRAME_US);
        if self.random.one_in(1_000) {
            self.board.pass_us(self.random.within(0..500_000));
        }
        let Some(delivered) = delivered(&frame) else { return };
        let before = self.persistent();
        let writes = self.board.flash.writes();
        let is_store = lss_data(&frame).is_some_and(|data| data[0] == 0x17)
            && self.board.node.lss().state() == State::Configuration;
        let is_sdo = delivered.cob_id() == 0x600 + u16::from(node_id);
        self.board.take_actions();
        self.board.receive(&delivered);
        let actions = self.board.take_actions();
        let stores = actions.iter().filter(|action| matches!(action, Action::Store(_))).count();
        self.stores += stores as u64;
        if actions.contains(&Action::StopTransmitting) {
            // Only the end of a long silence is stormy; otherwise most frames would fall into one.
            let [low, high] = [delivered.data()[1], delivered.data()[2]];
            let silence_us = 2_000 * u64::from(u16::from_le_bytes([low, high]));
            self.board.pass_us(silence_us.saturating_sub(STORMY_SILENCE_US));
        }
        let after = self.persistent();
        if !is_store {
            assert!(
                (before.node_id, before.bit_rate) == (after.node_id, after.bit_rate),
                "{frame} after {} frames turns {before:?} into {after:?}",
                self.frames
            );
            let is_reset = actions.contains(&Action::ResetDevice);
            let is_untouched = self.board.flash.writes() == writes;
            assert!(is_untouched || is_sdo || is_reset, "{frame} after {} frames", self.frames);
        }
    }

    fn persistent(&self) -> Settings {
        self.board.stored().unwrap_or(self.defaults)
    }

    fn check_that_it_answers(&mut self) {
        self.board.pass_ms(200_000);
        self.board.lss("04 01");
        assert!(self.board.is_in_configuration_state(), "silent after {} frames", self.frames);
        self.board.nmt("81 00");
        assert_eq!(self.board.lss("5E").0, [], "waiting after {} frames", self.frames);
    }
}

fn target(node_id: u8) -> Target {
    let Address { vendor_id, product_code, revision_number, serial_number } = ADDRESS;
    Target { address: [vendor_id, product_code, revision_number, serial_number], node_id }
}
