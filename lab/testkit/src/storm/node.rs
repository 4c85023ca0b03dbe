//! A storm of random frames against the node in the process.

use std::collections::VecDeque;

use canopen_node::{
    Action, Settings,
    application::NoApplication,
    lss::{self, State},
    sdo,
};
use emulator::can::Frame;
use example_io::application as io;

use super::{RATE, Stormed, Target, is_pdo, lss_data, next};
use crate::{
    flash::BoardFlash,
    image_rig::from_the_wire,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    random::Random,
};

/// The interval between frames in microseconds, on a full bus.
const FRAME_US: u64 = 130;
/// The last part of a silent period, in which the storm continues.
const STORMY_SILENCE_US: u64 = 5_000;
/// The number of frames between the slow checks.
const ROUND: u64 = 20_000;

/// A board in the process, and the frames sent to it.
pub struct NodeStorm<
    A: Stormed = NoApplication,
    const TPDOS: usize = 0,
    const RPDOS: usize = 0,
    const PRODUCERS: usize = 0,
> {
    board: NodeRig<A, TPDOS, RPDOS, PRODUCERS>,
    defaults: Settings,
    random: Random,
    /// The rest of a script.
    script: VecDeque<Frame>,
    /// The number of frames so far.
    pub frames: u64,
    /// The number of stores that the node requested.
    pub stores: u64,
    /// The number of PDOs that the node has sent.
    pub pdos: u64,
}

impl NodeStorm {
    pub fn new(seed: u64) -> Self {
        Self::with(NoApplication, seed)
    }
}

/// The storm against a node with the example `io`.
pub type ExampleNodeStorm =
    NodeStorm<io::Application, { io::TPDOS }, { io::RPDOS }, { io::PRODUCERS }>;

impl ExampleNodeStorm {
    pub fn with_example(seed: u64) -> Self {
        Self::with(io::Application::new(), seed)
    }
}

impl<A: Stormed, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    NodeStorm<A, TPDOS, RPDOS, PRODUCERS>
{
    fn with(application: A, seed: u64) -> Self {
        let defaults = defaults(0xFF).with_bit_rate(RATE.into());
        let device = device(ADDRESS).with_defaults(defaults);
        let board = NodeRig::with_application(device, BoardFlash::blank(0), 0, application);
        Self {
            board,
            defaults,
            random: Random::from_seed(seed),
            script: VecDeque::new(),
            frames: 0,
            stores: 0,
            pdos: 0,
        }
    }

    /// Sends this number of further frames. Panics if anything is stored or answered without a request, or the node no
    /// longer answers; the board itself checks that nothing is sent in a silent period.
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
        let target = Target { address: ADDRESS.into(), node_id };
        let frame = next::<A>(&mut self.random, &mut self.script, &target);
        self.board.pass_us(FRAME_US);
        if self.random.one_in(1_000) {
            self.board.pass_us(self.random.within(0..500_000));
        }
        let Some(delivered) = from_the_wire(&frame) else { return };
        let before = self.persistent();
        let writes = self.board.flash.writes();
        let parameters = self.board.stored_parameters().to_vec();
        let is_store = lss_data(&frame).is_some_and(|data| data[0] == 0x17)
            && self.board.node.lss().state() == State::Configuration;
        let is_sdo = delivered.cob_id() == sdo::REQUEST_COB_ID + u16::from(node_id);
        self.check_actions(None);
        self.board.receive(&delivered);
        let actions = self.check_actions(Some(&delivered));
        if actions.contains(&Action::StopTransmitting) {
            // Only the end of a long silence is stormy; otherwise most frames would fall into one.
            let [low, high] = [delivered.data()[1], delivered.data()[2]];
            let silence_us = 2_000 * u64::from(u16::from_le_bytes([low, high]));
            self.board.pass_us(silence_us.saturating_sub(STORMY_SILENCE_US));
        }
        let after = self.persistent();
        let is_kept = self.board.stored_parameters() == parameters;
        assert!(is_kept || is_sdo, "{frame} after {} frames changes parameters", self.frames);
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

    /// Takes the actions after the given frame, or in the time without one; checks that each answer and each store was
    /// asked for. Of itself an SDO server may only end a transfer, or confirm the part of a block that it has.
    fn check_actions(&mut self, request: Option<&canopen_node::Frame>) -> Vec<Action> {
        let actions = self.board.take_actions();
        let cob_id = request.map(|request| request.cob_id());
        let is_lss = cob_id == Some(lss::REQUEST_COB_ID);
        let is_sdo = cob_id.is_some_and(|id| id & !0x7F == sdo::REQUEST_COB_ID);
        for action in &actions {
            let is_right = match action {
                Action::Store(_) => is_lss || is_sdo,
                Action::Transmit(sent) => match sent.cob_id() {
                    lss::RESPONSE_COB_ID => is_lss,
                    0x580..0x600 => is_sdo || matches!(sent.data()[0], 0x80 | 0xA2),
                    _ => !is_pdo(sent) || TPDOS > 0,
                },
                _ => true,
            };
            assert!(is_right, "{action:?} after {} frames, the last {request:?}", self.frames);
            match action {
                Action::Store(_) => self.stores += 1,
                Action::Transmit(sent) if is_pdo(sent) => self.pdos += 1,
                _ => {}
            }
        }
        actions
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
        self.board.take_actions();
    }
}
