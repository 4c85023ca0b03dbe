//! A storm of random frames against the release image, back to back at 1 Mbit/s, with a node in the process as its
//! model: both must send the same frames and leave the same content in their flash.

use std::collections::VecDeque;

use canopen_node::{
    Action, BitRate, Device, Services,
    application::NoApplication,
    lss::{self, Address},
    nmt,
};
use emulator::{
    Time, board::Board as Emulated, can::Frame, chip::ResetCause, image::Image, network::Recording,
};
use example_io::{
    application::{self as io, Filter, Sample},
    device::DEVICE,
};
use lss_master::InquireAddress;

use super::{NODE_ID, RATE, Stormed, Target, is_pdo, lss_data, next};
use crate::{
    flash::BoardFlash,
    frames::{self, Frames},
    image_rig::{ImageRig, SETTINGS_OFFSET, flash_with, settings},
    node_rig::NodeRig,
    random::Random,
    sdo::Client,
    settings::Stored,
    stack,
    wire::{from_the_wire, on_the_wire},
};

/// The most frames without a pause; then answers and flash are compared.
const BURST: usize = 200;
/// The number of frames sent into a silent period.
const FRAMES_IN_SILENCE: u64 = 6;
/// The longest time from a request to its answer, that of a store.
const PATIENCE: Time = Time::from_ms(20);
/// The number of latest frames in a failure report.
const LAST_FRAMES: usize = 12;

/// An emulated board with the release image, the node in the process as its model, and the frames sent to both.
pub struct ImageStorm<A: Stormed = NoApplication> {
    rig: ImageRig,
    model: NodeRig<A>,
    /// Gives the model the inputs that the board samples, which never change.
    sample: Box<dyn Fn(&mut A)>,
    random: Random,
    /// The rest of a script.
    script: VecDeque<Frame>,
    /// Requests that come before all others.
    first: VecDeque<Frame>,
    address: Address,
    /// The frames that the model has sent and the board still has to send.
    expected: Vec<canopen_node::Frame>,
    burst: Vec<Frame>,
    rate: BitRate,
    /// The number of frames so far.
    pub frames: u64,
    /// The number of stores, resets, bit rate switches and PDOs of the board so far.
    pub stores: u64,
    pub resets: u64,
    pub switches: u64,
    pub pdos: u64,
}

/// The storm against the image with the example `io`.
pub type ExampleStorm = ImageStorm<io::Application>;

impl ImageStorm {
    /// A board with this device and stored settings: no node-ID, 1 Mbit/s.
    pub fn new(board: Emulated, image: &Image, device: Device, seed: u64) -> Self {
        let settings = settings(0xFF, RATE);
        let rig = rig(board, image, settings);
        Self::with(rig, device, settings, seed, NoApplication, Box::new(|_| {}))
    }
}

impl ExampleStorm {
    /// A board with the example and stored settings: a node-ID, 1 Mbit/s.
    pub fn with_example(board: Emulated, image: &Image, seed: u64) -> Self {
        let settings = settings(NODE_ID, RATE);
        let mut rig = rig(board, image, settings);
        rig.collect(io::Application::FIRST_SAMPLE);
        let temperature = rig.sdo_client(NODE_ID).number(0x6401, 1) as i16;
        let sample = Sample { is_pressed: false, temperature };
        let sample = Box::new(move |io: &mut io::Application| {
            io.step(sample, &mut Filter::default());
        });
        let application = io::Application::new();
        let mut storm = Self::with(rig, DEVICE, settings, seed, application, sample);
        storm.first.extend(io::Application::end_times(NODE_ID));
        storm
    }
}

/// A board with stored settings, and a master at the rate of the storm.
fn rig(mut board: Emulated, image: &Image, settings: Stored) -> ImageRig {
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings]));
    stack::paint(&mut board, image);
    let mut rig = ImageRig::new(RATE, [board]);
    rig.network.record(Recording::Latest(2_000));
    rig
}

impl<A: Stormed> ImageStorm<A> {
    fn with(
        mut rig: ImageRig,
        device: Device,
        stored: Stored,
        seed: u64,
        application: A,
        sample: Box<dyn Fn(&mut A)>,
    ) -> Self {
        rig.lss("04 01");
        let address = rig.carry_out(InquireAddress::new());
        rig.lss("04 00");
        let device = device.with_serial_number(address.serial_number);
        let flash = BoardFlash::with_content(flash_with(&[stored]), 0);
        let mut model = NodeRig::with_application(device, flash, 0, application);
        model.take_actions();
        sample(model.node.application_mut());
        Self {
            rig,
            model,
            sample,
            random: Random::from_seed(seed),
            script: VecDeque::new(),
            first: VecDeque::new(),
            address,
            expected: Vec::new(),
            burst: Vec::new(),
            rate: RATE,
            frames: 0,
            stores: 0,
            resets: 0,
            switches: 0,
            pdos: 0,
        }
    }

    /// Sends this number of further frames. Panics if the board sends or stores something different from the model, or
    /// no longer answers.
    pub fn rage(&mut self, frames: u64) {
        let until = self.frames + frames;
        while self.frames < until {
            let frame = self.next_frame();
            self.put(frame);
            if self.burst.len() >= BURST {
                self.settle();
            }
        }
        self.settle();
        self.put_request("04 01");
        self.put_request("5A");
        self.settle();
        assert_eq!(self.rig.network.board(0).lockup(), None);
        let findings = self.rig.network.board(0).findings();
        assert!(findings.is_empty(), "{findings:?}");
    }

    /// The number of stack bytes used since power-on.
    pub fn stack_depth(&self, image: &Image) -> usize {
        stack::deepest(self.rig.network.board(0), image)
    }

    /// Virtual time since power-on.
    pub fn now(&self) -> Time {
        self.rig.network.now()
    }

    fn next_frame(&mut self) -> Frame {
        let node_id = self.model.node.node_id().map_or(0, |id| id.get());
        let target = Target { address: self.address.into(), node_id };
        let frame = next::<A>(&mut self.random, &mut self.script, &target);
        let mut frame = A::without_time(&mut self.random, frame, node_id);
        if let Some(data) = lss_data(&frame) {
            match data[0] {
                // The model has no bit-rate detection.
                0x13 if data[1..3] == [0, 9] => frame.data[2] = 10,
                // Long enough for the master to follow to another bit rate.
                0x15 => {
                    let stays = self.model.node.lss().pending_bit_rate() == self.rate.into();
                    let shortest = if stays { 0 } else { 2 };
                    frame.data[1] = self.random.pick(&[shortest, 2, 3]);
                    frame.data[2] = 0;
                }
                _ => {}
            }
        }
        frame
    }

    fn put_request(&mut self, text: &str) {
        self.put(on_the_wire(&frames::request(text)));
    }

    /// Sends a frame to the model and to the board, after those that come first.
    fn put(&mut self, frame: Frame) {
        while let Some(frame) = self.first.pop_front() {
            self.put_now(frame);
        }
        self.put_now(frame);
    }

    /// Sends a frame to the model and to the board. Waits for the board if the order of what follows depends on it.
    fn put_now(&mut self, frame: Frame) {
        let actions = self.feed_model(&frame);
        if actions.contains(&Action::ResetDevice) {
            self.settle_before(&actions);
            self.follow_reset(frame);
        } else if actions.contains(&Action::Drop(Services::ALL)) {
            self.settle_before(&actions);
            self.follow_switch(frame);
        } else {
            let drops = |action: &Action| matches!(action, Action::SetNodeId(_) | Action::Drop(_));
            if actions.iter().any(drops) {
                // Frames that have not been sent by then are never sent.
                self.settle_before(&actions);
            }
            self.send(frame);
            if actions.iter().any(|action| matches!(action, Action::Store(_))) {
                self.stores += 1;
                self.settle();
            } else if actions.iter().filter(is_sdo_answer).count() > 1 {
                // The next request would come within the block.
                self.settle();
            }
        }
    }

    fn feed_model(&mut self, frame: &Frame) -> Vec<Action> {
        if let Some(delivered) = from_the_wire(frame) {
            self.model.receive(&delivered);
        }
        self.take_actions()
    }

    fn take_actions(&mut self) -> Vec<Action> {
        let actions = self.model.take_actions();
        self.expected.extend(actions.iter().filter_map(|action| match action {
            Action::Transmit(frame, _) => compared(frame),
            _ => None,
        }));
        if actions.iter().any(is_boot_up) {
            let node_id = self.model.node.node_id().expect("a node that boots up has one");
            self.first = A::end_times(node_id.get()).into();
        }
        actions
    }

    fn send(&mut self, frame: Frame) {
        self.rig.network.send(self.rig.master, frame);
        self.burst.push(frame);
        self.frames += 1;
    }

    /// Completes everything before the frame that made the model do `actions`.
    fn settle_before(&mut self, actions: &[Action]) {
        let own = actions.iter().filter(|action| match action {
            Action::Transmit(frame, _) => compared(frame).is_some(),
            _ => false,
        });
        let later = self.expected.split_off(self.expected.len() - own.count());
        self.settle_with(None);
        self.expected = later;
    }

    /// Waits until everything is sent and answered, then compares.
    fn settle(&mut self) {
        let content = self.model.flash.content();
        self.settle_with(Some(content));
    }

    fn settle_with(&mut self, content: Option<Vec<u8>>) {
        self.rig.send_all();
        let frame_time = self.rig.bit_time() * 160;
        let until =
            self.rig.network.now() + PATIENCE + frame_time * (self.expected.len() as u64 + 4);
        let mut sent = Vec::new();
        let expected = Sent::of(std::mem::take(&mut self.expected));
        // After the last frame there must not be another.
        let mut is_complete = false;
        while !is_complete && self.rig.network.now() < until {
            let received = self.rig.collect(frame_time.max(Time::from_ms(1)));
            let before = sent.len();
            sent.extend(received.0.iter().filter_map(compared));
            is_complete =
                sent.len() == before && Sent::of(sent.clone()).is_what_remains_of(&expected);
        }
        let sent = Sent::of(sent);
        self.pdos += sent.pdos.len() as u64;
        let last = self.burst.len().saturating_sub(LAST_FRAMES);
        let last: Vec<_> = self.burst[last..].iter().map(ToString::to_string).collect();
        let context = format!("frame {}, after {last:#?}", self.frames);
        assert!(is_complete, "{sent:?}\nnot {expected:?}\n{context}");
        if let Some(content) = content {
            let flash = self.rig.network.board(0).flash();
            let stored = &flash[SETTINGS_OFFSET as usize..][..content.len()];
            assert!(stored == content, "the settings in flash differ; {}", context);
        }
        self.burst.clear();
    }

    fn follow_reset(&mut self, frame: Frame) {
        let since = self.rig.network.now();
        self.rig.network.allow_reset(0, ResetCause::Software);
        self.send(frame);
        self.rig.send_all();
        self.boot(since);
    }

    /// Prepares for a reset of the board.
    fn boot(&mut self, since: Time) {
        self.resets += 1;
        self.set_rate();
        self.rig.boot(0, since);
        self.rig.network.run_for(A::FIRST_SAMPLE);
        (self.sample)(self.model.node.application_mut());
        self.settle();
        self.return_to_the_rate_of_the_storm();
    }

    /// Follows a bit rate switch: sends frames into the silence, sets the master's rate, and waits for both.
    fn follow_switch(&mut self, frame: Frame) {
        self.switches += 1;
        let delay = Time::from_ms(u64::from(u16::from_le_bytes([frame.data[1], frame.data[2]])));
        self.send(frame);
        self.rig.send_all();
        let t0 = self.rig.network.now();
        if delay > Time::ZERO && self.rate == RATE {
            for _ in 0..self.random.within(0..FRAMES_IN_SILENCE) {
                let frame = self.next_frame();
                self.feed_model(&frame);
                self.send(frame);
            }
            self.rig.send_all();
        }
        let us = delay.as_ps() / 1_000_000;
        self.model.pass_us(us + us / 2);
        self.rig.network.run_until(t0 + Time::from_us(us + us / 2));
        self.set_rate();
        self.model.pass_us(us / 2 + 1_000);
        let actions = self.take_actions();
        if actions.contains(&Action::ResetDevice) {
            // The frame waited until the end of the silence.
            self.rig.network.allow_reset(0, ResetCause::Software);
            let end = t0 + Time::from_us(2 * us);
            self.rig.network.run_until(end + Time::from_us(500));
            // The board has joined the bus at the new rate before.
            return self.boot(end);
        }
        self.rig.network.run_until(t0 + Time::from_us(2 * us + 1_000));
        self.settle();
        self.return_to_the_rate_of_the_storm();
    }

    /// Sets the master to the bit rate of the model.
    fn set_rate(&mut self) {
        if self.model.bit_rate() != self.rate {
            self.rate = self.model.bit_rate();
            self.rig.set_master_bit_rate(self.rate);
        }
    }

    fn return_to_the_rate_of_the_storm(&mut self) {
        if self.rate != RATE {
            for request in ["04 01", "13 00 00", "15 02 00"] {
                self.put_request(request);
            }
        }
    }
}

/// The compared frames of a node, by COB-ID, in order of their times.
#[derive(Debug)]
struct Sent {
    answers: Frames,
    pdos: Vec<canopen_node::Frame>,
}

impl Sent {
    fn of(mut frames: Vec<canopen_node::Frame>) -> Self {
        frames.sort_by_key(|frame| frame.cob_id());
        let (pdos, answers) = frames.into_iter().partition(is_pdo);
        Self { answers: Frames(answers), pdos }
    }

    /// Whether these are the `expected` frames. A PDO may have replaced older ones of its COB-ID that waited for the
    /// bus.
    fn is_what_remains_of(&self, expected: &Self) -> bool {
        let mut pdos = self.pdos.iter().rev().peekable();
        let mut later = None;
        for pdo in expected.pdos.iter().rev() {
            let is_last = later != Some(pdo.cob_id());
            later = Some(pdo.cob_id());
            if pdos.next_if_eq(&pdo).is_none() && is_last {
                return false;
            }
        }
        pdos.next().is_none() && self.answers == expected.answers
    }
}

/// Returns `frame` if the model predicts its content and order. Excluded are heartbeats and emergencies, which depend
/// on time; boot-ups, since two that wait for a full bus become one; and the controller's observations in the error
/// register 1001h, the error history 1003h and 2000h.
fn compared(frame: &canopen_node::Frame) -> Option<canopen_node::Frame> {
    let is_sdo = frame.cob_id() & !0x7F == 0x580;
    let is_of_controller = matches!(frame.data(), [_, 0x01 | 0x03, 0x10, ..] | [_, 0x00, 0x20, ..]);
    let is_compared = frame.cob_id() == lss::RESPONSE_COB_ID || is_sdo && !is_of_controller;
    (is_compared || is_pdo(frame)).then_some(*frame)
}

fn is_sdo_answer(action: &&Action) -> bool {
    matches!(action, Action::Transmit(frame, _) if frame.cob_id() & !0x7F == 0x580)
}

fn is_boot_up(action: &Action) -> bool {
    matches!(action, Action::Transmit(frame, _)
        if frame.cob_id() & !0x7F == nmt::ERROR_CONTROL_COB_ID && frame.data() == [0])
}
