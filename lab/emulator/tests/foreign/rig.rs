//! A board whose program has a CAN driver of others, remotely controlled through its RAM, and an adapter on its bus.

use std::{collections::BTreeMap, env, path::PathBuf, sync::Mutex};

use chip_build::{TARGET, cargo_for_the_chip};
use emulator::{
    Time,
    board::{Board, Settings},
    can::{Adapter, BitSegments, Clock, Frame, Id},
    chip::{Finding, Part},
    image::Image,
    network::{AdapterId, Network, Recording},
};
use testkit::log;

use crate::command::*;

pub const MSR: u32 = 0x004;
const RF0R: u32 = 0x00C;
const ESR: u32 = 0x018;
/// Registers of FDCAN (RM0440 44.4.11, 44.4.12, 44.4.23).
const ECR: u32 = 0x040;
const PSR: u32 = 0x044;
const ACT: u32 = 0b11 << 3;
const RXF0S: u32 = 0x090;
const TXBRP: u32 = 0x0C8;

/// Bits of MSR: sleep mode, transmission.
pub const SLAK: u32 = 1 << 1;
pub const TXM: u32 = 1 << 8;

/// The state of error confinement as ESR shows it: warning, error passive, bus-off.
pub const WARNING: u32 = 1 << 0;
pub const PASSIVE: u32 = 1 << 1;
pub const BUS_OFF: u32 = 1 << 2;

/// The longest time for a command that waits for the bus, and for the start of the program.
const PATIENCE: Time = Time::from_ms(50);
/// The time between two looks at the program's answer.
const LOOK: Time = Time::from_us(2);

/// The driver of a program of `lab/emulator/foreign/`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Driver {
    /// The driver of embassy-stm32.
    Embassy,
    /// The crate bxcan.
    Bxcan,
    /// The driver of embassy-stm32 for FDCAN.
    Fdcan,
}

/// A program of `lab/emulator/foreign/`, which is built once.
pub fn image(program: &'static str, feature: &str) -> &'static Image {
    static IMAGES: Mutex<BTreeMap<&str, &Image>> = Mutex::new(BTreeMap::new());
    let mut images = IMAGES.lock().expect("the programs build");
    images.entry(program).or_insert_with(|| Box::leak(Box::new(build(program, feature))))
}

fn build(program: &str, feature: &str) -> Image {
    let directory = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo runs this"));
    let target = directory.join("../../target/foreign");
    let status = cargo_for_the_chip(&directory.join("foreign"), "build")
        .expect("the compiler has the library for the chip")
        .args(["--quiet", "--locked", "--release"])
        .args(["--features", feature, "--bin", program])
        .arg("--target-dir")
        .arg(&target)
        .status()
        .expect("cargo runs");
    assert!(status.success(), "lab/emulator/foreign/src/bin/{program}.rs does not build");
    Image::load(target.join(TARGET).join("release").join(program)).expect("an image")
}

/// An adapter with its sample point at 75 %.
///
/// A receiver's bits begin up to one of its quanta before the sender's, as the emulated bus has no delay. At 1 Mbit/s a
/// quantum of embassy-stm32 lasts 143 ns: a sender that samples later than that before the end of a bit would see the
/// acknowledgement come early.
pub fn adapter(bit_rate: u32) -> Adapter {
    let bit_timing = BitSegments { prescaler: 1, segment_1: 11, segment_2: 4, jump_width: 2 };
    Adapter::with_timing(Clock { hz: 16 * bit_rate, ppm: 0 }, bit_timing)
}

/// A board, an adapter, and the bus between them.
pub struct Rig {
    pub driver: Driver,
    pub network: Network,
    pub board: usize,
    pub adapter: AdapterId,
    control: u32,
}

impl Rig {
    /// A board that has started; its controller and the adapter are off the bus.
    pub fn new(driver: Driver) -> Self {
        let (part, image) = match driver {
            Driver::Embassy => (Part::Stm32f405, image("embassy", "embassy")),
            Driver::Bxcan => (Part::Stm32f405, image("bxcan", "bxcan")),
            Driver::Fdcan => (Part::Stm32g431, image("fdcan", "fdcan")),
        };
        let mut network = Network::new();
        network.record(Recording::Off);
        let board = network.add_board(Board::new(part, image, Settings::default()));
        let adapter = network.add_adapter(adapter(1_000_000));
        network.adapter_mut(adapter).close();
        let control = image.symbol("REMOTE_CONTROL").expect("the program has the words");
        let mut rig = Self { driver, network, board, adapter, control };
        rig.wait("the program's start", |rig| rig.word(0) == READY);
        rig
    }

    /// A board and an adapter that have joined the bus; everything is accepted into FIFO 0.
    pub fn joined(driver: Driver, bit_rate: u32, modes: u32) -> Self {
        let mut rig = Self::new(driver);
        rig.join(bit_rate, modes);
        rig
    }

    pub fn join(&mut self, bit_rate: u32, modes: u32) {
        self.network.adapter_mut(self.adapter).close();
        self.adapter = self.network.add_adapter(adapter(bit_rate));
        self.call(CONFIGURE, &[bit_rate, modes]);
        self.accept_everything();
        self.call(ENABLE, &[]);
        // Its driver does not wait for the bus.
        if self.driver == Driver::Fdcan {
            self.wait("the bus", |rig| rig.can_register(PSR) & ACT != 0);
        }
    }

    pub fn accept_everything(&mut self) {
        self.call(FILTER, &[0, 0, MASK_32, 0, 0]);
    }

    /// Replaces all filters by banks from 0 on: FIFO, kind and words of each.
    pub fn set_filters(&mut self, banks: &[(u32, u32, [u32; 4])]) {
        self.call(CLEAR_FILTERS, &[]);
        for (number, (fifo, kind, [a, b, c, d])) in (0..).zip(banks) {
            self.call(FILTER, &[number, *fifo, *kind, *a, *b, *c, *d]);
        }
    }

    fn word(&self, index: u32) -> u32 {
        let mut bytes = [0; 4];
        let board = self.network.board(self.board);
        assert!(board.read_memory(self.control + 4 * index, &mut bytes), "the words are in RAM");
        u32::from_le_bytes(bytes)
    }

    /// Gives the program a command without waiting until it is ready.
    pub fn begin(&mut self, command: u32, arguments: &[u32]) {
        assert!(self.is_ready(), "command {command} comes while another is carried out");
        let words = arguments.iter().copied().chain(std::iter::repeat(0)).take(WORDS);
        let bytes: Vec<u8> =
            [command].into_iter().chain(words).flat_map(u32::to_le_bytes).collect();
        self.network.board_mut(self.board).write_memory(self.control, &bytes);
    }

    pub fn is_ready(&self) -> bool {
        self.word(0) == READY
    }

    /// Carries out a command and returns the answer.
    pub fn call(&mut self, command: u32, arguments: &[u32]) -> [u32; WORDS] {
        self.begin(command, arguments);
        self.wait(&format!("the answer to command {command}"), |rig| rig.is_ready());
        std::array::from_fn(|index| self.word(1 + index as u32))
    }

    pub fn wait(&mut self, what: &str, mut done: impl FnMut(&mut Self) -> bool) {
        let limit = self.network.now() + PATIENCE;
        while !done(self) {
            self.network.run_for(LOOK);
            if self.network.now() >= limit {
                let board = self.network.board(self.board);
                panic!(
                    "{what} never came: pc {:08x}, {:?}, {:#?}, {:#?}",
                    board.pc(),
                    board.lockup(),
                    log::lines(board),
                    board.findings()
                );
            }
        }
    }

    pub fn run_us(&mut self, us: u64) {
        self.network.run_for(Time::from_us(us));
    }

    /// The number of the mailbox, and the frame that had to make room, unless the driver refuses the frame.
    pub fn transmit(&mut self, frame: Frame) -> Option<(u32, Option<Frame>)> {
        let pending = self.pending();
        let [answer, mut mailbox, replaced @ .., _] = self.call(TRANSMIT, &words(frame));
        if self.driver == Driver::Fdcan && self.pending() != pending {
            mailbox = (self.pending() & !pending).trailing_zeros();
        }
        (answer != REFUSED).then(|| (mailbox, (answer == REPLACED).then(|| from_words(replaced))))
    }

    /// A frame if there is one, or the driver's error.
    pub fn receive(&mut self) -> Result<Option<Frame>, u32> {
        let [answer, a, b, c, d, ..] = self.call(RECEIVE, &[]);
        match answer {
            EMPTY => Ok(None),
            FRAME => Ok(Some(from_words([a, b, c, d]))),
            error => Err(error),
        }
    }

    /// The frames that the program takes out of its FIFOs until they are empty.
    pub fn receive_all(&mut self) -> Vec<Frame> {
        let mut frames = Vec::new();
        loop {
            match self.receive() {
                Ok(Some(frame)) => frames.push(frame),
                Ok(None) => return frames,
                Err(_) => {}
            }
        }
    }

    pub fn abort(&mut self, mailbox: u32) -> bool {
        self.call(ABORT, &[mailbox])[0] == 1
    }

    /// The transmit buffers of FDCAN with a request.
    fn pending(&self) -> u32 {
        if self.driver == Driver::Fdcan { self.can_register(TXBRP) } else { 0 }
    }

    pub fn is_idle(&mut self) -> bool {
        if self.driver == Driver::Fdcan {
            return self.pending() == 0;
        }
        self.call(IS_IDLE, &[])[0] == 1
    }

    /// The numbers of interrupts so far: transmit, FIFO 0, FIFO 1, status change and error.
    pub fn interrupts(&mut self) -> [u32; 4] {
        let [transmit, fifo_0, fifo_1, change, ..] = self.call(INTERRUPTS, &[]);
        [transmit, fifo_0, fifo_1, change]
    }

    pub fn send(&mut self, frame: Frame) {
        self.network.send(self.adapter, frame);
    }

    /// The frames that the adapter has received.
    pub fn heard(&mut self) -> Vec<Frame> {
        std::iter::from_fn(|| self.network.receive(self.adapter)).map(|(_, frame)| frame).collect()
    }

    pub fn can_register(&self, offset: u32) -> u32 {
        let board = self.network.board(self.board);
        let now = board.now();
        board.chip().can(1).read(offset, now).expect("a register")
    }

    /// The transmit and receive error counters.
    pub fn error_counters(&self) -> (u32, u32) {
        if self.driver == Driver::Fdcan {
            let ecr = self.can_register(ECR);
            return (ecr & 0xFF, ecr >> 8 & 0x7F);
        }
        let esr = self.can_register(ESR);
        (esr >> 16 & 0xFF, esr >> 24)
    }

    /// The state of error confinement.
    pub fn error_state(&self) -> u32 {
        if self.driver == Driver::Fdcan {
            let psr = self.can_register(PSR);
            return psr >> 6 & WARNING | psr >> 4 & PASSIVE | psr >> 5 & BUS_OFF;
        }
        self.can_register(ESR) & (WARNING | PASSIVE | BUS_OFF)
    }

    pub fn is_transmitting(&self) -> bool {
        match self.driver {
            Driver::Fdcan => self.can_register(PSR) & ACT == ACT,
            _ => self.can_register(MSR) & TXM != 0,
        }
    }

    /// Adds an adapter on the bus.
    pub fn add_adapter(&mut self, bit_rate: u32) -> AdapterId {
        self.network.add_adapter(adapter(bit_rate))
    }

    /// The number of messages in a FIFO.
    pub fn waiting(&self, fifo: u32) -> u32 {
        match self.driver {
            Driver::Fdcan => self.can_register(RXF0S + 8 * fifo) & 3,
            _ => self.can_register(RF0R + 4 * fifo) & 3,
        }
    }
}

/// Accesses that RM0090 does not define for the chip.
///
/// embassy-stm32 has one RCC for all F4: it clears bits of DCKCFGR, which only the F42x and F43x have (6.3.25).
const EXPLAINED: [(Driver, u32, bool); 2] =
    [(Driver::Embassy, 0x4002_388C, false), (Driver::Embassy, 0x4002_388C, true)];

/// Whether a finding is one of those.
pub fn explained(driver: Driver, finding: &Finding) -> bool {
    EXPLAINED.contains(&(driver, finding.address, finding.write))
}

/// No property leaves an unexplained finding.
impl Drop for Rig {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            let findings = self.network.board(self.board).findings();
            let unexplained = findings.iter().filter(|finding| !explained(self.driver, finding));
            let texts: Vec<String> = unexplained.map(Finding::to_string).collect();
            assert!(texts.is_empty(), "{:?}: {texts:#?}", self.driver);
        }
    }
}

pub fn standard(id: u16, payload: &[u8]) -> Frame {
    Frame::data(Id::Standard(id), payload)
}

pub fn extended(id: u32, payload: &[u8]) -> Frame {
    Frame::data(Id::Extended(id), payload)
}

fn words(frame: Frame) -> [u32; 4] {
    let id = match frame.id {
        Id::Standard(id) => id.into(),
        Id::Extended(id) => id | EXTENDED,
    };
    let data = u64::from_le_bytes(frame.data);
    let remote = if frame.remote { REMOTE } else { 0 };
    [id | remote, frame.dlc.into(), data as u32, (data >> 32) as u32]
}

fn from_words([id, dlc, low, high]: [u32; 4]) -> Frame {
    let number = id & !(EXTENDED | REMOTE);
    let frame_id =
        if id & EXTENDED != 0 { Id::Extended(number) } else { Id::Standard(number as u16) };
    if id & REMOTE != 0 {
        return Frame::remote(frame_id, dlc as u8);
    }
    let bytes = (u64::from(high) << 32 | u64::from(low)).to_le_bytes();
    Frame::data(frame_id, &bytes[..dlc as usize])
}
