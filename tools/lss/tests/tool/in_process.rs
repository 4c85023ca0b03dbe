//! Boards of the example `io` in the process, on an ideal bus in virtual time, and the tool's adapter there: thousands
//! of runs in seconds. It counts what is written, and never are two boards one node, not even after a power cut.

use std::{
    cell::{RefCell, RefMut},
    collections::{BTreeMap, VecDeque},
    path::Path,
    rc::Rc,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, HOST_CLOCK, Mode, Received, Status},
    stop::Stop,
};
use canopen_node::{
    BitRate, Frame, NodeId,
    lss::{Address, Request},
    nmt,
};
use example_io::{application::Application, device::DEVICE};
use testkit::{
    flash::BoardFlash,
    image_rig::{flash_with, settings},
    node_rig::NodeRig,
    sdo::Client,
};

use crate::emulated::{Outcome, run, text};

/// A board.
pub type Rig = NodeRig<Application>;

/// More bits than a frame.
const FRAME_BITS: u64 = 130;

/// What goes wrong from a frame of the tool on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The user presses Ctrl-C when the frame is sent.
    CtrlC,
    /// The adapter is gone, and with it the frame.
    AdapterGone,
    /// The adapter is gone after the frame.
    AdapterGoneBehind,
    /// The board with this number is off the bus, and has no power.
    BoardGone(usize),
    /// Another master brings all boards to LSS configuration state before the frame.
    OtherMaster,
}

/// What a board does that it must not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Defect {
    /// It refuses the LSS request with this command specifier.
    Refuses(u8),
    /// It stores, and says that it cannot.
    DeniesItsStore,
    /// It is off the bus, and has no power, from store configuration on.
    DiesAtStore,
    /// It says that it takes a node-ID, and does not.
    Disobeys,
    /// It says that it has stored, and has not.
    Forgets,
    /// It ignores NMT resets.
    IgnoresResets,
    /// It loses a node-ID when it hears a Fastscan.
    LosesItsNodeId,
    /// Another board is in its place after a reset: that with this number.
    IsReplacedAtReset(usize),
    /// Another board comes to the bus at its reset: that with this number.
    IsJoinedAtReset(usize),
    /// Its first boot-up messages are lost.
    LosesBootUps(usize),
    /// Its first answers to SDO are lost.
    LosesAnswers(usize),
}

/// When it goes wrong: at a write, or at a frame from the first write on, from 0 on.
#[derive(Clone, Copy, Debug)]
pub enum At {
    Write(usize),
    Frame(usize),
}

/// The boards, the bus, and the tool's adapter.
#[derive(Clone)]
pub struct Wire {
    world: Rc<RefCell<World>>,
    is_interrupted: Arc<AtomicBool>,
    start: Instant,
}

pub struct World {
    pub boards: Vec<Board>,
    /// In microseconds.
    now: u64,
    rate: Option<BitRate>,
    has_errors: bool,
    received: VecDeque<Frame>,
    /// All frames that the tool has sent.
    pub sent: Vec<Frame>,
    /// The number of writes among them.
    writes: usize,
    /// Whether two boards may be one node, as at the beginning of a test.
    pub may_collide: bool,
    /// The fault, and when it comes.
    fault: Option<(Fault, At)>,
    /// There was a write.
    has_begun: bool,
    /// An LSS request that the boards refuse: its command specifier, and the byte behind it.
    pub refused: Option<[u8; 2]>,
    is_adapter_gone: bool,
    /// The boards that are plugged in or pulled out, and when, in microseconds.
    hands: BTreeMap<u64, (usize, bool)>,
    /// Texts of the object 2101h:3 have a zero behind them.
    pub pads_texts: bool,
}

pub struct Board {
    pub rig: Rig,
    pub is_there: bool,
    pub defect: Option<Defect>,
}

/// The LSS address of the board with this number.
pub fn address(number: usize) -> Address {
    Address { serial_number: 0x1000 + number as u32, ..DEVICE.address }
}

/// The same as the tool writes it.
pub fn address_text(number: usize) -> String {
    text(address(number))
}

/// Whether a frame writes: configures by LSS, downloads by SDO, or is an NMT command.
pub fn is_write(frame: &Frame) -> bool {
    match (frame.cob_id(), frame.data()) {
        (nmt::COMMAND_COB_ID, _) => true,
        (0x7E5, [command, ..]) => matches!(command, 0x11 | 0x13 | 0x15 | 0x17),
        (0x601..=0x67F, [command, ..]) => matches!(command >> 5, 0 | 1),
        _ => false,
    }
}

impl Wire {
    /// Boards with these node-IDs, FF: none, at this bit rate. Those with a node-ID send no heartbeat.
    pub fn new(rate: BitRate, node_ids: &[u8]) -> Self {
        Self::with_heartbeat(rate, node_ids, 0)
    }

    /// The same with a heartbeat of this time in ms.
    pub fn with_heartbeat(rate: BitRate, node_ids: &[u8], heartbeat_ms: u16) -> Self {
        let board = |(number, id): (usize, &u8)| {
            let device = DEVICE.with_serial_number(address(number).serial_number);
            let flash = match id {
                0xFF if rate == BitRate::Kbit125 => BoardFlash::blank(number as u64),
                id => {
                    let settings = settings(*id, rate).with_heartbeat_ms(heartbeat_ms);
                    BoardFlash::with_content(flash_with(&[settings]), number as u64)
                }
            };
            Board {
                rig: Rig::with_application(device, flash, 0, Application::new()),
                is_there: true,
                defect: None,
            }
        };
        let world = World {
            boards: node_ids.iter().enumerate().map(board).collect(),
            now: 0,
            rate: None,
            has_errors: false,
            received: VecDeque::new(),
            sent: Vec::new(),
            writes: 0,
            may_collide: false,
            fault: None,
            has_begun: false,
            refused: None,
            is_adapter_gone: false,
            hands: BTreeMap::new(),
            pads_texts: false,
        };
        Self {
            world: Rc::new(RefCell::new(world)),
            is_interrupted: Arc::default(),
            start: Instant::now(),
        }
    }

    pub fn world(&self) -> RefMut<'_, World> {
        self.world.borrow_mut()
    }

    /// Runs `lss` with these arguments.
    pub fn lss(&self, arguments: &str) -> Outcome {
        run(Box::new(self.clone()), &self.is_interrupted, arguments, |_| ())
    }

    /// Runs `lss apply` with a file; returns the outcome and the number of writes.
    pub fn apply(&self, file: &Path, options: &str) -> (Outcome, usize) {
        let before = self.world().writes;
        let outcome = self.lss(&format!("apply {} {options}", file.display()));
        let writes = self.world().writes - before;
        (outcome, writes)
    }

    /// Lets something go wrong.
    pub fn fail_at(&self, at: At, fault: Fault) {
        self.world().fault = Some((fault, at));
    }

    /// Plugs a board in, or pulls it out, so many seconds from now on.
    pub fn hand(&self, seconds: u64, board: usize, is_there: bool) {
        let mut world = self.world();
        let at = world.now + 1_000_000 * seconds;
        world.hands.insert(at, (board, is_there));
    }

    /// The virtual time in seconds.
    pub fn seconds(&self) -> u64 {
        self.world().now / 1_000_000
    }

    /// Mends what went wrong, before another run; true if something did.
    pub fn mend(&self) -> bool {
        // It may have come at the last frame.
        self.is_interrupted.store(false, Ordering::Relaxed);
        let mut world = self.world();
        let has_happened = world.fault.take().is_none();
        world.is_adapter_gone = false;
        world.hands.clear();
        for board in &mut world.boards {
            if !board.is_there {
                board.is_there = true;
                board.rig.power_cycle();
            }
        }
        has_happened
    }

    /// Cuts the power of all boards, and restores it.
    pub fn power_cycle(&self) {
        let mut world = self.world();
        for board in &mut world.boards {
            board.rig.power_cycle();
        }
        world.assert_alone();
    }

    /// The node-ID in use and the stored one of each board.
    pub fn ids(&self) -> Vec<(Option<u8>, Option<u8>)> {
        let ids = |board: &Board| {
            let stored = board.rig.stored().and_then(|settings| settings.node_id);
            (board.rig.node.node_id().map(NodeId::get), stored.map(NodeId::get))
        };
        self.world().boards.iter().map(ids).collect()
    }

    /// The value of an object of a board.
    pub fn value(&self, board: usize, index: u16, sub_index: u8) -> Vec<u8> {
        let mut world = self.world();
        world.boards[board].rig.upload(index, sub_index).expect("it can be read")
    }

    /// Writes a value of a board without the tool.
    pub fn set(&self, board: usize, index: u16, sub_index: u8, bytes: &[u8]) {
        self.world().boards[board]
            .rig
            .download(index, sub_index, bytes)
            .expect("it can be written");
    }

    /// Asserts that no board is in LSS configuration state.
    #[track_caller]
    pub fn assert_waiting(&self) {
        for board in &mut self.world().boards {
            assert!(!board.rig.is_in_configuration_state());
        }
    }
}

impl World {
    pub fn pass_ms(&mut self, ms: u64) {
        self.run(self.now + 1000 * ms, false);
    }

    /// Lets time pass until `end` or until a frame comes.
    fn run(&mut self, end: u64, stops_at_frames: bool) {
        while self.now < end && (!stops_at_frames || self.received.is_empty()) {
            let deadlines = self.boards.iter().filter_map(|board| board.rig.us_to_deadline());
            let hand = self.hands.keys().next().map(|at| at.saturating_sub(self.now));
            let step = deadlines.chain(hand).min().unwrap_or(u64::MAX).clamp(1, end - self.now);
            self.now += step;
            if let Some(hand) = self.hands.first_entry().filter(|hand| *hand.key() <= self.now) {
                let (number, is_there) = hand.remove();
                self.boards[number].is_there = is_there;
                if is_there {
                    let frames = self.boards[number].rig.power_cycle().0;
                    self.take(number, frames);
                }
            }
            for number in 0..self.boards.len() {
                let frames = self.boards[number].rig.pass_us(step).0;
                self.take(number, frames);
            }
        }
    }

    /// Takes frames of a board. Those that several boards send at once and alike are one on the bus.
    fn take(&mut self, number: usize, frames: Vec<Frame>) {
        let Board { rig, is_there, defect } = &mut self.boards[number];
        rig.take_actions();
        if *is_there && self.rate == Some(rig.bit_rate()) {
            for mut frame in frames {
                let lost = match (frame.cob_id(), frame.data(), &mut *defect) {
                    (0x701..=0x77F, [0], Some(Defect::LosesBootUps(left))) => Some(left),
                    (0x581..=0x5FF, _, Some(Defect::LosesAnswers(left))) => Some(left),
                    _ => None,
                };
                if let Some(left @ 1..) = lost {
                    *left -= 1;
                    continue;
                }
                if let (true, &[0x47, 0x01, 0x21, 3, a, b, c, d]) = (self.pads_texts, frame.data())
                {
                    let padded = [0x43, 0x01, 0x21, 3, a, b, c, d];
                    frame = Frame::new(frame.cob_id(), &padded).expect("eight bytes");
                }
                if !self.received.contains(&frame) {
                    self.received.push_back(frame);
                }
            }
        }
    }

    /// Asserts that no two boards have one node-ID, neither in use nor stored.
    #[track_caller]
    fn assert_alone(&self) {
        if self.may_collide {
            return;
        }
        let there = self.boards.iter().filter(|board| board.is_there);
        let active: Vec<NodeId> = there.filter_map(|board| board.rig.node.node_id()).collect();
        let stored = self.boards.iter().filter_map(|board| board.rig.stored()?.node_id);
        for (what, mut ids) in [("in use", active), ("stored", stored.collect())] {
            let count = ids.len();
            ids.sort_unstable();
            ids.dedup();
            assert_eq!(ids.len(), count, "a node-ID twice {what}: {ids:?}");
        }
    }

    /// The fault that comes at this frame.
    fn fault_at(&mut self, frame: &Frame) -> Option<Fault> {
        let (fault, at) = self.fault?;
        let next = match at {
            At::Write(count) if is_write(frame) => count.checked_sub(1).map(At::Write),
            // From here on each frame counts.
            At::Frame(count) if is_write(frame) || self.has_begun => {
                self.has_begun = true;
                count.checked_sub(1).map(At::Frame)
            }
            at => Some(at),
        };
        self.fault = next.map(|at| (fault, at));
        next.is_none().then_some(fault)
    }

    /// Lets a board with a defect do something else with a frame; false if it does what it must.
    fn misbehaves(&mut self, number: usize, frame: &Frame) -> bool {
        let board = &mut self.boards[number];
        let Some(defect) = board.defect else { return false };
        let specifier = frame.data()[0];
        let reset = [0x81, board.rig.node.node_id().map_or(0, NodeId::get)];
        if let (
            nmt::COMMAND_COB_ID,
            Defect::IsReplacedAtReset(other) | Defect::IsJoinedAtReset(other),
        ) = (frame.cob_id(), defect)
            && frame.data() == reset
        {
            board.defect = None;
            board.is_there = matches!(defect, Defect::IsJoinedAtReset(_));
            self.boards[other].is_there = true;
            let frames = self.boards[other].rig.power_cycle().0;
            self.take(other, frames);
            return !self.boards[number].is_there;
        }
        if let (nmt::COMMAND_COB_ID, Defect::IgnoresResets) = (frame.cob_id(), defect) {
            return true;
        }
        if let (0x7E5, 0x51, Defect::LosesItsNodeId) = (frame.cob_id(), specifier, defect)
            && board.rig.node.node_id().is_some()
        {
            board.rig.configure("11 FF, 17");
            board.rig.power_cycle();
            board.rig.take_actions();
        }
        if frame.cob_id() != 0x7E5 || !board.rig.is_in_configuration_state() {
            return false;
        }
        let code = match (defect, specifier) {
            (Defect::Refuses(refused), _) if refused == specifier => 1,
            (Defect::DeniesItsStore, 0x17) => {
                board.rig.receive(frame);
                board.rig.take_actions();
                2
            }
            (Defect::DiesAtStore, 0x17) => {
                board.is_there = false;
                return true;
            }
            (Defect::Disobeys, 0x11) | (Defect::Forgets, 0x17) => 0,
            _ => return false,
        };
        self.received.extend(Frame::new(0x7E4, &[specifier, code, 0, 0, 0, 0, 0, 0]));
        true
    }

    fn deliver(&mut self, frame: &Frame) {
        let Some(rate) = self.rate else { return };
        let span = FRAME_BITS * 1000 / u64::from(rate.kbit_per_s());
        self.run(self.now + span, false);
        if let (0x7E5, Some(refused)) = (frame.cob_id(), self.refused)
            && frame.data().starts_with(&refused)
        {
            let answer = [refused[0], 1, 0, 0, 0, 0, 0, 0];
            self.received.extend(Frame::new(0x7E4, &answer));
            return;
        }
        let mut is_acknowledged = false;
        for number in 0..self.boards.len() {
            let Board { rig, is_there, .. } = &mut self.boards[number];
            if *is_there && rig.bit_rate() == rate {
                is_acknowledged = true;
                if !self.misbehaves(number, frame) {
                    let answers = self.boards[number].rig.receive(frame).0;
                    self.take(number, answers);
                }
            }
        }
        self.has_errors |= !is_acknowledged;
        self.assert_alone();
    }
}

impl Adapter for Wire {
    fn open(&mut self, rate: BitRate, _: Mode) -> Result<(), Stop> {
        let mut world = self.world();
        world.rate = Some(rate);
        world.received.clear();
        world.has_errors = false;
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        self.world().rate = None;
        Ok(())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        let is_interrupted = Arc::clone(&self.is_interrupted);
        let mut world = self.world();
        let fault = world.fault_at(frame);
        if let Some(fault) = fault {
            match fault {
                Fault::CtrlC => is_interrupted.store(true, Ordering::Relaxed),
                Fault::AdapterGone => world.is_adapter_gone = true,
                Fault::AdapterGoneBehind => {}
                Fault::BoardGone(number) => world.boards[number].is_there = false,
                Fault::OtherMaster => {
                    let request = Request::SwitchToConfiguration.to_frame();
                    world.deliver(&request);
                    world.received.push_back(request);
                }
            }
        }
        if world.is_adapter_gone {
            return Err(Stop::AdapterGone("pulled out".into()));
        }
        world.sent.push(*frame);
        world.writes += usize::from(is_write(frame));
        world.deliver(frame);
        if fault == Some(Fault::AdapterGoneBehind) {
            world.is_adapter_gone = true;
        }
        Ok(())
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        let mut world = self.world();
        if world.is_adapter_gone {
            return Err(Stop::AdapterGone("pulled out".into()));
        }
        let end = world.now + wait.as_micros() as u64;
        world.run(end, true);
        let at = Duration::from_micros(world.now);
        let frame = world.received.pop_front();
        Ok(frame.map(|frame| Received { frame, at, here: self.start + at }))
    }

    fn status(&mut self) -> Result<Option<Status>, Stop> {
        let has_errors = std::mem::take(&mut self.world().has_errors);
        Ok(Some(Status { is_error_passive: false, has_errors }))
    }

    fn now(&self) -> Instant {
        self.start + Duration::from_micros(self.world.borrow().now)
    }

    fn clock(&self) -> &'static str {
        HOST_CLOCK
    }

    fn latency(&self) -> Option<Duration> {
        None
    }

    fn description(&self) -> String {
        "boards in the process".into()
    }
}
