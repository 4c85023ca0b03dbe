//! The release image of the commissioner on an emulated board, with the slaves of its network in the process.

use std::{array, mem, sync::LazyLock};

use canopen_node::{
    BitRate, Device, NodeId, Settings, lss,
    lss::Address,
    nmt,
    settings::{
        Log,
        parameters::{Packer, Parameter},
    },
};
use emulator::{
    Time,
    board::{self, Board},
    can::Adapter,
    chip::Pin,
    image::Image,
    network::{AdapterId, Network, Recording},
};
use testkit::{
    flash::BoardFlash,
    frames,
    image::{self, PART},
    image_rig::{SETTINGS_LENGTH, SETTINGS_OFFSET},
    node_rig::{NodeRig, device},
    random::Random,
    slave_bus::{Habits, Happening, SlaveBus},
    wire::{bit_per_s, from_the_wire, on_the_wire},
};

static IMAGE: LazyLock<Image> = LazyLock::new(|| {
    image::build_example("commissioner", PART).unwrap_or_else(|error| panic!("{error}"))
});

pub const RATE: BitRate = BitRate::Kbit125;
const BUTTON: Pin = Pin('A', 0);
const LED: Pin = Pin('D', 13);
/// The longest that it takes to deal with a network.
const LONGEST: Time = Time::from_s(60);
/// Longer than any pause between two requests of a round, and than that before a round after a boot-up.
const PAUSE: Time = Time::from_ms(2_200);

/// A table of LSS addresses, that with node-ID 1 first.
pub type Table = [Option<Address>; 32];
/// The most bytes of the stored parameters.
const STORED: usize = 6 + 32 * 16;

/// What the LED says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    Complete,
    Waiting,
    Missing,
    New,
    Conflict,
    Invalid,
}

/// The commissioner on the emulated bus, and a gateway to the bus in the process.
pub struct Rig {
    pub network: Network,
    pub slaves: SlaveBus,
    gateway: AdapterId,
    is_open: bool,
    /// The LSS requests on the bus, with their times.
    pub requests: Vec<(Time, [u8; 8])>,
    /// The number of NMT commands.
    pub resets: usize,
    /// The number of frames on the bus.
    pub frames: usize,
    /// The power cut to come: the number of frames after which it begins, the slave or else the commissioner, and its span.
    pub cut: Option<(usize, Option<usize>, Time)>,
    /// The end of a power cut of the commissioner.
    power_on_at: Option<Time>,
}

/// The LSS address of a board with this number, of a product.
pub fn address(product_code: u32, number: u32) -> Address {
    // Far from each other, as those from chips' unique ids.
    let serial_number = number.wrapping_mul(0x9E37_79B9);
    Address { vendor_id: 0x0300, product_code, revision_number: 0x0001_0000, serial_number }
}

/// The LSS addresses of boards of product 1 with these numbers.
pub fn table(numbers: &[u32]) -> Table {
    array::from_fn(|at| numbers.get(at).map(|number| address(1, *number)))
}

/// A new board without a node-ID.
pub fn blank(address: Address) -> NodeRig {
    board_of(device(address).with_defaults(Settings::new(RATE.into())).with_heartbeat_ms(1_000))
}

/// A board with a node-ID of its own that sends no heartbeat.
pub fn with_node_id(address: Address, node_id: u8) -> NodeRig {
    let settings = Settings::new(RATE.into()).with_node_id(NodeId::new(node_id));
    board_of(device(address).with_defaults(settings))
}

fn board_of(device: Device) -> NodeRig {
    NodeRig::with_device(device, BoardFlash::blank(0), 0)
}

/// Blank boards of product 1.
pub fn blanks(numbers: impl IntoIterator<Item = u32>) -> Vec<NodeRig> {
    numbers.into_iter().map(|number| blank(address(1, number))).collect()
}

/// The flash of a commissioner with this table.
fn flash_with(table: &Table) -> Vec<u8> {
    let value: Vec<u8> =
        table.iter().flat_map(|row| row.map_or([0; 16], Address::to_le_bytes)).collect();
    let mut packed = [0; STORED];
    let parameter = Parameter { index: 0x2200, sub_index: 0, data_type: 0x0A, value: &value };
    Packer::new(&mut packed).put(&parameter);
    let (mut log, _) = Log::<_, STORED>::open_with_parameters(BoardFlash::blank(0));
    log.store_with_parameters(Settings::new(RATE.into()), &packed).expect("it has room");
    log.close().content()
}

impl Rig {
    /// A commissioner with an empty table, just powered on, and these boards.
    pub fn new(slaves: impl IntoIterator<Item = NodeRig>) -> Self {
        Self::with_table(None, slaves)
    }

    /// The same with this table.
    pub fn with_table(
        table: impl Into<Option<Table>>,
        slaves: impl IntoIterator<Item = NodeRig>,
    ) -> Self {
        let slaves = slaves.into_iter().map(|rig| (rig, Habits::default()));
        Self::with_habits(table, slaves)
    }

    /// The same with boards of these habits.
    pub fn with_habits(
        table: impl Into<Option<Table>>,
        slaves: impl IntoIterator<Item = (NodeRig, Habits)>,
    ) -> Self {
        let mut network = Network::new();
        network.forbid_misuse();
        network.record(Recording::Off);
        let mut commissioner = Board::new(PART, &IMAGE, board::Settings::default());
        if let Some(table) = table.into() {
            commissioner.set_flash(SETTINGS_OFFSET, &flash_with(&table));
        }
        network.add_board(commissioner);
        let gateway = network.add_adapter(Adapter::new(bit_per_s(RATE)));
        let mut slaves = SlaveBus::new(slaves, Random::from_seed(1));
        slaves.open(RATE, true);
        let (requests, resets, frames, cut, power_on_at) = (Vec::new(), 0, 0, None, None);
        Self { network, slaves, gateway, is_open: true, requests, resets, frames, cut, power_on_at }
    }

    /// Lets time pass.
    pub fn run_for(&mut self, span: Time) {
        let until = self.network.now() + span;
        while self.network.now() < until {
            self.step(until);
        }
    }

    /// Lets time pass until a frame or something in a slave comes.
    fn step(&mut self, until: Time) {
        let until = self.power_on_at.map_or(until, |at| at.min(until));
        let next = Time::from_us(self.slaves.next_at().min(until.as_us() + 1)).min(until);
        // Slaves without power acknowledge nothing.
        let is_open = self.network.boards().len() > 1
            || self.slaves.slaves.iter().any(|slave| slave.is_powered);
        if mem::replace(&mut self.is_open, is_open) != is_open {
            let gateway = self.network.adapter_mut(self.gateway);
            if is_open { gateway.open() } else { gateway.close() }
        }
        let span = next.saturating_sub(self.network.now());
        if let Some((_, frame)) = self.network.run_until_received(self.gateway, span) {
            let frame = from_the_wire(&frame).expect("a frame of CANopen");
            self.resets += usize::from(frame.cob_id() == nmt::COMMAND_COB_ID);
            if frame.cob_id() == lss::REQUEST_COB_ID {
                let request = frame.data().try_into().expect("eight bytes");
                self.requests.push((self.network.now(), request));
            }
            self.slaves.send(frame);
            self.count();
        }
        let now = self.network.now();
        if self.power_on_at.take_if(|at| *at <= now).is_some() {
            self.network.power_on(0);
        }
        while let Some((_, frame)) = self.slaves.run(now.as_us()) {
            self.network.send(self.gateway, on_the_wire(&frame));
            self.count();
        }
        self.check();
    }

    /// Counts a frame, and cuts the power behind it.
    fn count(&mut self) {
        self.frames += 1;
        let frames = self.frames;
        let Some((_, party, span)) = self.cut.take_if(|(after, ..)| *after <= frames) else {
            return;
        };
        match party {
            None => self.cut_power(span),
            Some(slave) => self.cut_power_of(slave, span),
        }
    }

    /// Cuts the power of the commissioner.
    pub fn cut_power(&mut self, span: Time) {
        if self.power_on_at.is_none() {
            self.network.power_off(0);
            self.power_on_at = Some(self.network.now() + span);
        }
    }

    /// Cuts the power of a slave, behind a frame that is on its way to it.
    pub fn cut_power_of(&mut self, slave: usize, span: Time) {
        let at = self.slaves.now() + 1_100;
        self.slaves.plan(at, slave, Happening::PowerOff);
        self.slaves.plan(at + span.as_us(), slave, Happening::PowerOn);
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

    /// Lets time pass until the commissioner is between two rounds; returns what its LED says.
    pub fn settle(&mut self) -> State {
        let until = self.network.now() + LONGEST;
        self.run_for(PAUSE);
        while self.requests.last().is_some_and(|(at, _)| self.network.now() < *at + PAUSE) {
            assert!(self.network.now() < until, "it comes to no end");
            self.run_for(Time::from_ms(50));
        }
        self.state()
    }

    /// What the LED says.
    pub fn state(&mut self) -> State {
        let step = |_| {
            self.run_for(Time::from_ms(50));
            self.network.board(0).output(LED).level == Some(true)
        };
        let steps: Vec<bool> = (0..16).map(step).collect();
        let next = steps.iter().cycle().skip(1);
        let changes = steps.iter().zip(next).filter(|(step, next)| step != next).count();
        match (steps.iter().filter(|is_lit| **is_lit).count(), changes) {
            (16, 0) => State::Complete,
            (8, 8) => State::Waiting,
            (1, 2) => State::Missing,
            (8, 2) => State::New,
            (2, 4) => State::Conflict,
            (3, 6) => State::Invalid,
            _ => panic!("the LED says nothing: {steps:?}"),
        }
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

    /// Cuts the power of the commissioner for a moment, and lets it find a state.
    pub fn restart(&mut self) -> State {
        self.cut_power(Time::from_ms(10));
        self.run_for(Time::from_ms(50));
        self.settle()
    }

    /// The same with the power of all.
    pub fn restart_all(&mut self) -> State {
        (0..self.slaves.slaves.len()).for_each(|slave| self.cut_power_of(slave, Time::from_ms(10)));
        self.restart()
    }

    /// The table in the flash.
    pub fn table(&self) -> Table {
        let start = SETTINGS_OFFSET as usize;
        let content = self.network.board(0).flash()[start..start + SETTINGS_LENGTH].to_vec();
        let flash = BoardFlash::with_content(content, 0);
        let (mut log, _) = Log::<_, STORED>::open_with_parameters(flash);
        let mut table = [None; 32];
        let restored = log.restore(|parameter| {
            for (row, bytes) in table.iter_mut().zip(parameter.value.as_chunks().0) {
                *row = (*bytes != [0; 16]).then(|| Address::from_le_bytes(*bytes));
            }
            true
        });
        restored.expect("it can be read");
        table
    }

    /// The node-ID of each powered board that is in the table: those in it, and those in force.
    pub fn places(&self) -> Vec<(Option<u8>, Option<u8>)> {
        let table = self.table();
        let place = |address: Address| {
            let at = table.iter().position(|row| *row == Some(address));
            at.map(|at| at as u8 + 1)
        };
        let slaves = self.slaves.slaves.iter().zip(self.node_ids());
        let places = slaves.map(|(slave, node)| (place(slave.rig.node.lss().address()), node));
        places.filter(|(place, _)| place.is_some()).collect()
    }

    /// Whether no slave has stored anything.
    pub fn nothing_is_stored(&self) -> bool {
        self.slaves.slaves.iter().all(|slave| slave.rig.stored().is_none())
    }

    /// The LSS requests since the last call, by their first byte.
    pub fn take_requests(&mut self) -> Vec<u8> {
        mem::take(&mut self.requests).iter().map(|(_, request)| request[0]).collect()
    }

    /// The adapter of another LSS master.
    pub fn add_rival(&mut self) -> AdapterId {
        self.network.add_adapter(Adapter::new(bit_per_s(RATE)))
    }

    pub fn send_as_rival(&mut self, rival: AdapterId, request: &str) {
        self.network.send(rival, on_the_wire(&frames::request(request)));
    }
}
