//! The release image of the commissioner on an emulated board, with the slaves of its network in the process.

use std::{
    array,
    collections::{BTreeMap, VecDeque},
    sync::LazyLock,
};

use canopen_node::{BitRate, Device, Frame, NodeId, Settings, lss, lss::Address};
use emulator::{
    Time,
    board::{self, Board},
    can::Adapter,
    chip::Pin,
    image::Image,
    network::{AdapterId, Network},
};
use example_commissioner::application::State;
use testkit::{
    flash::BoardFlash,
    frames,
    image::{self, PART},
    image_rig::{self, SETTINGS_OFFSET, flash_with},
    node_rig::{NodeRig, device},
    random::Random,
    sdo::Client,
    slave_bus::{Habits, Happening, SlaveBus},
    wire::{bit_per_s, from_the_wire, on_the_wire},
};

static IMAGE: LazyLock<Image> = LazyLock::new(|| {
    image::build_example("commissioner", PART).unwrap_or_else(|error| panic!("{error}"))
});

const BUTTON: Pin = Pin('A', 0);
/// The node-ID of the commissioner.
const OWN: u16 = 127;
/// The longest that it takes to deal with a network.
const LONGEST: Time = Time::from_s(60);

/// The length of a frame on the bus in the process.
const FLIGHT_BITS: u64 = 123;

/// The commissioner on the emulated bus, and a gateway to the bus in the process, at the bit rate of most slaves.
pub struct Rig {
    pub network: Network,
    pub slaves: SlaveBus,
    gateway: AdapterId,
    /// Acknowledges its frames, as other slaves do.
    witness: AdapterId,
    answers: VecDeque<[u8; 8]>,
    /// The time of the last LSS request.
    requested_at: Time,
    /// The frames of the commissioner.
    pub sent: Vec<Frame>,
    /// The frames of the commissioner and of the slaves.
    pub frames: Vec<Frame>,
    /// The power cut to come.
    pub cut: Option<Cut>,
    /// The end of a power cut of the commissioner.
    power_on_at: Option<Time>,
}

/// A power cut.
#[derive(Clone, Copy, Debug)]
pub struct Cut {
    pub party: Party,
    /// The number of frames after which it begins.
    pub after: usize,
    pub span: Time,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Party {
    Commissioner,
    Slave(usize),
}

/// A commissioner with an empty table at this rate; those with different numbers have different serial numbers.
pub fn commissioner(number: u8, rate: BitRate) -> Board {
    let settings = board::Settings { unique_id: [number; 12], ..Default::default() };
    let mut board = Board::new(PART, &IMAGE, settings);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[image_rig::settings(OWN as u8, rate)]));
    board
}

/// The LSS address of a board with this number, of a product.
pub fn address(product_code: u32, number: u32) -> Address {
    // Far from each other, as those from chips' unique ids.
    let serial_number = number.wrapping_mul(0x9E37_79B9);
    Address { vendor_id: 0x0300, product_code, revision_number: 0x0001_0000, serial_number }
}

/// A new board without a node-ID, at this rate.
pub fn new_board(address: Address, rate: BitRate) -> NodeRig {
    board_of(device(address).with_defaults(Settings::new(rate.into())).with_heartbeat_ms(1_000))
}

/// A board with these settings that sends no heartbeat.
pub fn silent(address: Address, settings: Settings) -> NodeRig {
    board_of(device(address).with_defaults(settings))
}

fn board_of(device: Device) -> NodeRig {
    NodeRig::with_device(device.with_rescue(true), BoardFlash::blank(0), 0)
}

/// A new board that stays at its bit rate, as those of others do.
pub fn plain_board(number: u32) -> NodeRig {
    let settings = Settings::new(BitRate::Kbit125.into());
    let device = device(address(1, number)).with_defaults(settings).with_heartbeat_ms(1_000);
    NodeRig::with_device(device.with_rescue(false), BoardFlash::blank(0), 0)
}

/// Blank boards of one product.
pub fn blank(numbers: impl IntoIterator<Item = u32>) -> Vec<NodeRig> {
    numbers.into_iter().map(|number| new_board(address(1, number), BitRate::Kbit125)).collect()
}

impl Rig {
    /// The commissioner with an empty table, just powered on, and these boards.
    pub fn new(slaves: impl IntoIterator<Item = NodeRig>) -> Self {
        Self::with_habits(slaves.into_iter().map(|rig| (rig, Habits::default())))
    }

    pub fn with_habits(slaves: impl IntoIterator<Item = (NodeRig, Habits)>) -> Self {
        Self::at(BitRate::Kbit125, slaves)
    }

    /// The same at this rate.
    pub fn at(rate: BitRate, slaves: impl IntoIterator<Item = (NodeRig, Habits)>) -> Self {
        Self::of(commissioner(0, rate), rate, slaves)
    }

    /// The same with this commissioner.
    pub fn of(
        commissioner: Board,
        rate: BitRate,
        slaves: impl IntoIterator<Item = (NodeRig, Habits)>,
    ) -> Self {
        let mut network = Network::new();
        network.forbid_misuse();
        network.record(emulator::network::Recording::Off);
        network.add_board(commissioner);
        let [gateway, witness] =
            [(); 2].map(|()| network.add_adapter(Adapter::new(bit_per_s(rate))));
        let mut slaves = SlaveBus::new(slaves, Random::from_seed(1));
        slaves.open(rate, true);
        let (answers, sent) = (VecDeque::new(), Vec::new());
        let mut rig = Self {
            network,
            slaves,
            gateway,
            witness,
            answers,
            requested_at: Time::ZERO,
            sent,
            frames: Vec::new(),
            cut: None,
            power_on_at: None,
        };
        // It comes to the bus.
        rig.run_for(Time::from_ms(50));
        rig
    }

    /// Lets time pass.
    pub fn run_for(&mut self, span: Time) {
        let until = self.network.now() + span;
        while self.network.now() < until {
            self.step(until);
        }
    }

    /// Lets time pass until the commissioner has sent an LSS request with this command specifier.
    pub fn run_until_request(&mut self, specifier: u8) {
        let until = self.network.now() + LONGEST;
        let is_it = |frame: &Frame| {
            frame.cob_id() == lss::REQUEST_COB_ID && frame.data().first() == Some(&specifier)
        };
        while !self.sent.last().is_some_and(is_it) {
            assert!(self.network.now() < until, "it sends no {specifier:02X}");
            self.step(until);
        }
    }

    /// Lets time pass until a frame or something in a slave comes.
    fn step(&mut self, until: Time) {
        // The gateway soon follows the commissioner to another bit rate.
        let until = until.min(self.network.now() + Time::from_ms(2));
        let until = self.power_on_at.map_or(until, |at| at.min(until));
        let next = Time::from_us(self.slaves.next_at().min(until.as_us() + 1)).min(until);
        let span = next.saturating_sub(self.network.now());
        if let Some((_, frame)) = self.network.run_until_received(self.witness, span) {
            self.note(from_the_wire(&frame).expect("a frame of CANopen"));
        }
        while let Some((_, frame)) = self.network.receive(self.gateway) {
            self.take(from_the_wire(&frame).expect("a frame of CANopen"));
        }
        let now = self.network.now();
        if self.power_on_at.take_if(|at| *at <= now).is_some() {
            self.network.power_on(0);
        }
        while let Some((_, frame)) = self.slaves.run(now.as_us()) {
            self.network.send(self.gateway, on_the_wire(&frame));
        }
        self.follow_bit_rate();
        self.check();
    }

    /// Notes a frame on the bus, except for those of a client, and cuts the power behind it.
    fn note(&mut self, frame: Frame) {
        if [0x580 + OWN, 0x600 + OWN].contains(&frame.cob_id()) {
            return;
        }
        self.frames.push(frame);
        if let Some(cut) = self.cut.take_if(|cut| cut.after <= self.frames.len()) {
            let now = self.network.now();
            match cut.party {
                Party::Commissioner => {
                    self.network.power_off(0);
                    self.power_on_at = Some(now + cut.span);
                }
                // It has received the frame, on the bus in the process, and not answered.
                Party::Slave(slave) => {
                    let at = now.as_us()
                        + FLIGHT_BITS * 1_000 / u64::from(self.slaves.rate.kbit_per_s())
                        + 50;
                    self.slaves.plan(at, slave, Happening::PowerOff);
                    self.slaves.plan(at + cut.span.as_us(), slave, Happening::PowerOn);
                }
            }
        }
    }

    /// Passes a frame of the commissioner on.
    fn take(&mut self, frame: Frame) {
        if frame.cob_id() == 0x580 + OWN {
            self.answers.push_back(frame.data().try_into().expect("eight bytes"));
            return;
        }
        self.sent.push(frame);
        if frame.cob_id() == lss::REQUEST_COB_ID {
            self.requested_at = self.network.now();
        }
        self.slaves.send(frame);
    }

    /// Puts the gateway at the bit rate of the commissioner if a slave is there, and else at that of most slaves.
    fn follow_bit_rate(&mut self) {
        let mut rates = BTreeMap::new();
        for slave in self.slaves.slaves.iter().filter(|slave| slave.is_powered) {
            *rates.entry(slave.rig.bit_rate()).or_insert(0) += 1;
        }
        let own = self.own_rate().filter(|own| rates.is_empty() || rates.contains_key(own));
        let most = rates.into_iter().max_by_key(|(_, count)| *count);
        if let Some(rate) = own.or(most.map(|(rate, _)| rate))
            && rate != self.slaves.rate
        {
            self.slaves.open(rate, true);
            for adapter in [self.gateway, self.witness] {
                self.network.adapter_mut(adapter).set_bit_rate(bit_per_s(rate));
            }
        }
    }

    fn own_rate(&mut self) -> Option<BitRate> {
        let own = self.network.board(0).chip().can(1).bit_rate();
        BitRate::ALL.into_iter().find(|rate| bit_per_s(*rate) == own)
    }

    /// The bit rate of the commissioner.
    pub fn rate(&mut self) -> BitRate {
        self.own_rate().expect("it takes part")
    }

    /// No two nodes have one node-ID.
    fn check(&self) {
        let mut nodes = self.node_ids();
        nodes.retain(Option::is_some);
        nodes.sort_unstable();
        let all = nodes.len();
        nodes.dedup();
        assert_eq!(nodes.len(), all, "a node-ID twice: {:?}", self.node_ids());
    }

    /// The active node-IDs of the slaves; `None` without power, too.
    pub fn node_ids(&self) -> Vec<Option<u8>> {
        let slaves = self.slaves.slaves.iter();
        slaves
            .map(|slave| slave.rig.node.node_id().filter(|_| slave.is_powered).map(NodeId::get))
            .collect()
    }

    /// Lets time pass until the commissioner has found a state; returns it.
    pub fn settle(&mut self) -> State {
        let until = self.network.now() + LONGEST;
        loop {
            assert!(self.network.now() < until, "it comes to no end");
            self.run_for(Time::from_ms(100));
            // A switch of the bit rate wants silence.
            if self.network.now() < self.requested_at + Time::from_ms(600) {
                continue;
            }
            if let Some(state) = self.ask_state()
                && state != State::Asking
            {
                return state;
            }
        }
    }

    pub fn state(&mut self) -> State {
        self.ask_state().expect("an answer")
    }

    /// The state, unless the commissioner is silent, such as while it looks for the others at another rate.
    fn ask_state(&mut self) -> Option<State> {
        use State::*;
        // One that came too late.
        self.answers.clear();
        self.confirm([0x40, 0x00, 0x21, 1, 0, 0, 0, 0]);
        let until = self.network.now() + Time::from_ms(200);
        while self.answers.is_empty() && self.network.now() < until {
            self.step(until);
        }
        let answer = self.answers.pop_front()?;
        let states = [Complete, Asking, Missing, New, Conflict, NotStored, Rival, TakenBack];
        Some(states[usize::from(answer[4])])
    }

    /// How many of the 16 steps of a commissioner's LED are lit, and how often it changes in them.
    pub fn pattern(&mut self, board: usize) -> (usize, usize) {
        let step = |_| {
            self.run_for(Time::from_ms(50));
            self.network.board(board).output(Pin('D', 13)).level == Some(true)
        };
        let steps: Vec<bool> = (0..16).map(step).collect();
        let next = steps.iter().cycle().skip(1);
        let changes = steps.iter().zip(next).filter(|(step, next)| step != next).count();
        (steps.iter().filter(|is_lit| **is_lit).count(), changes)
    }

    /// Presses the button for 50 ms, and lets the commissioner find a state.
    pub fn press(&mut self) -> State {
        self.push(true);
        self.run_for(Time::from_ms(50));
        self.push(false);
        self.settle()
    }

    pub fn push(&mut self, is_pressed: bool) {
        self.network.board(0).chip().gpio_mut().set_input(BUTTON, Some(is_pressed));
    }

    /// Cuts the power of the commissioner, if it has some, and restores it.
    pub fn restart(&mut self) -> State {
        self.network.power_off(0);
        self.run_for(Time::from_ms(10));
        self.network.power_on(0);
        self.run_for(Time::from_ms(50));
        self.settle()
    }

    /// Cuts the power of all, and restores it.
    pub fn restart_all(&mut self) -> State {
        self.network.power_off(0);
        let slaves = 0..self.slaves.slaves.len();
        slaves.clone().for_each(|slave| self.slaves.happen(slave, Happening::PowerOff));
        self.run_for(Time::from_ms(10));
        slaves.for_each(|slave| self.slaves.happen(slave, Happening::PowerOn));
        self.restart()
    }

    /// Asks for a bit rate, and lets the commissioner switch.
    pub fn switch(&mut self, rate: u16) -> State {
        self.order(rate);
        self.settle()
    }

    /// Asks for a bit rate.
    pub fn order(&mut self, rate: u16) {
        let [low, high] = rate.to_le_bytes();
        self.confirm([0x2B, 0x01, 0x21, 0, low, high, 0, 0]);
        self.run_for(Time::from_ms(100));
        self.answers.clear();
    }

    /// The rows of the table.
    pub fn table(&mut self) -> Vec<Option<Address>> {
        let bytes = self.upload(0x2200, 0).expect("it can be read");
        let row = |row: &[u8]| {
            let mut parts = row.chunks(4).map(|part| u32::from_le_bytes(part.try_into().unwrap()));
            let parts = array::from_fn(|_| parts.next().expect("four"));
            (parts != [0; 4]).then(|| parts.into())
        };
        bytes.chunks(16).map(row).collect()
    }

    /// Writes the table, and stores it.
    pub fn set_table(&mut self, rows: &[Option<Address>]) {
        let parts = rows.iter().flat_map(|row| row.map_or([0; 4], <[u32; 4]>::from));
        let bytes: Vec<u8> = parts.flat_map(u32::to_le_bytes).collect();
        assert_eq!(self.download(0x2200, 0, &bytes), Ok(()));
        assert_eq!(self.save(1), Ok(()));
    }

    /// Whether no slave has stored anything.
    pub fn nothing_is_stored(&self) -> bool {
        self.slaves.slaves.iter().all(|slave| slave.rig.stored().is_none())
    }

    /// The LSS requests of the commissioner since the last call, by their first byte.
    pub fn take_requests(&mut self) -> Vec<u8> {
        let sent = std::mem::take(&mut self.sent);
        sent.iter().filter(|f| f.cob_id() == lss::REQUEST_COB_ID).map(|f| f.data()[0]).collect()
    }

    /// Another master sends a request.
    pub fn send_as_another_master(&mut self, rival: AdapterId, request: &str) {
        self.network.send(rival, on_the_wire(&frames::request(request)));
    }
}

impl Client for Rig {
    fn say(&mut self, messages: &[[u8; 8]], is_last: impl Fn(&[u8; 8]) -> bool) -> Vec<[u8; 8]> {
        let mut answers = Vec::new();
        messages.iter().for_each(|message| self.confirm(*message));
        let until = self.network.now() + Time::from_s(1);
        while !answers.last().is_some_and(&is_last) {
            assert!(self.network.now() < until, "an answer");
            self.step(until);
            answers.extend(self.answers.drain(..));
        }
        answers
    }

    fn confirm(&mut self, message: [u8; 8]) {
        let frame = Frame::new(0x600 + OWN, &message).expect("a frame");
        self.network.send(self.gateway, on_the_wire(&frame));
    }
}
