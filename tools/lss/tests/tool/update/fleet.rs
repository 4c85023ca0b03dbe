//! Boards whose programs can be replaced, on the bus within the process, and the tool's adapter there.

use std::{
    cell::{RefCell, RefMut},
    fs,
    path::PathBuf,
    rc::Rc,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, Mode, Received, Status},
    person::Person,
    stop::Stop,
};
use canopen_node::{Action, BitRate, Device, Frame, Service};
use lss::Session;
use program_update::{FlashError, start::Cause};
use testkit::{
    cargo,
    flash::BoardFlash,
    image_rig::{flash_with, settings},
    node_rig::{ADDRESS, NodeRig, device},
    random::Random,
    slave_bus::{BusAdapter, Defect, Habits, Happening, SlaveBus},
};

use super::{
    board::{Board, Deed, State},
    program::{Kind, file_with},
};
use crate::{
    emulated::{Outcome, run},
    in_process::forward,
};

/// The bit rate of these networks.
const RATE: BitRate = BitRate::Kbit1000;
/// The time between two looks at the boards.
const STEP: Duration = Duration::from_millis(4);
/// The same while there is no tool.
const LONG_STEP: Duration = Duration::from_millis(50);
/// The length of the programs.
const LEN: usize = 1200;

/// The number of files made so far.
static FILES: AtomicUsize = AtomicUsize::new(0);

/// What goes wrong at a frame of the tool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    CtrlC,
    /// The adapter is gone, and with it the frame.
    AdapterGone,
    /// The power of the board with this number fails.
    PowerCut(usize),
    /// The same for a moment.
    PowerFails(usize),
    /// From then on its flash does.
    FlashFails(usize),
    /// The frame is lost.
    FrameIsLost,
    /// The answer of the board with this number is lost.
    AnswerIsLost(usize),
}

/// The boards, the bus, and the tool's adapter.
#[derive(Clone)]
pub struct Fleet {
    adapter: BusAdapter<Board>,
    boards: Rc<Vec<Board>>,
    is_interrupted: Arc<AtomicBool>,
    record: Rc<RefCell<Record>>,
}

#[derive(Default)]
struct Record {
    sent: Vec<Frame>,
    fault: Option<(usize, Fault)>,
    is_adapter_gone: bool,
    lost: Option<usize>,
    has_no_blocks: bool,
}

/// The old program of each board.
pub fn old() -> Vec<u8> {
    file_with("1.0", Kind::Good, LEN, |_| ())
}

/// The new one.
pub fn new() -> Vec<u8> {
    file_with("1.1", Kind::Good, LEN, |_| ())
}

/// Writes an update file for a test with this name.
pub fn write(name: &str, file: &[u8]) -> PathBuf {
    let path = cargo::scratch(&format!("{name}.update.bin"));
    fs::write(&path, file).expect("it can be written");
    path
}

/// The CRC in the header of a file.
pub fn crc_of(file: &[u8]) -> u32 {
    u32::from_le_bytes(*file[12..].first_chunk().expect("a header"))
}

impl Fleet {
    /// Boards with these node-IDs and the old program.
    pub fn new(ids: &[u8]) -> Self {
        Self::of(&ids.iter().map(|id| (*id, device(ADDRESS))).collect::<Vec<_>>())
    }

    /// Boards with these node-IDs that are these devices, but for their serial numbers.
    pub fn of(boards: &[(u8, Device)]) -> Self {
        let mut handles = Vec::new();
        let rigs: Vec<_> = (1..)
            .zip(boards)
            .map(|(number, (id, device))| {
                let board = Board::new(&old());
                handles.push(board.clone());
                let settings = settings(*id, RATE).with_heartbeat_ms(0);
                let flash = BoardFlash::with_content(flash_with(&[settings]), number);
                let device = device.with_serial_number(number as u32);
                let rig = NodeRig::with_application(device, flash, 0, board);
                (rig, Habits { answer_us: 0..1, store_us: 0, ..Habits::default() })
            })
            .collect();
        let mut bus = SlaveBus::new(rigs, Random::from_seed(1));
        bus.pass_us(100_000);
        Self {
            adapter: BusAdapter::new(bus),
            boards: Rc::new(handles),
            is_interrupted: Arc::default(),
            record: Rc::default(),
        }
    }

    /// Runs `lss update` with a file.
    pub fn update(&self, file: &[u8], rest: &str) -> Outcome {
        let number = FILES.fetch_add(1, Ordering::Relaxed);
        let path = write(&format!("fleet-{number}"), file);
        let outcome = self.lss(&format!("--bit-rate 1000 update {} {rest}", path.display()));
        fs::remove_file(path).expect("it was there");
        outcome
    }

    pub fn lss(&self, arguments: &str) -> Outcome {
        self.lss_with(Person::absent(), arguments)
    }

    /// Runs `lss` while a person answers.
    pub fn lss_with(&self, person: Person, arguments: &str) -> Outcome {
        self.record.borrow_mut().sent.clear();
        let prepare = |session: &mut Session| session.person = person;
        run(Box::new(self.clone()), &self.is_interrupted, arguments, prepare)
    }

    /// The frames that the last command has sent.
    pub fn sent(&self) -> Vec<Frame> {
        self.record.borrow().sent.clone()
    }

    pub fn bus(&self) -> RefMut<'_, SlaveBus<Board>> {
        self.adapter.bus()
    }

    pub fn board(&self, number: usize) -> RefMut<'_, State> {
        self.boards[number].0.borrow_mut()
    }

    /// The CRC of the program that each board runs, if it runs one that stays.
    pub fn kept(&self) -> Vec<Option<u32>> {
        let kept =
            |board: &Board| board.0.borrow().runs().filter(|_| !board.0.borrow().is_on_trial());
        self.boards.iter().map(kept).collect()
    }

    /// Lets something go wrong at the tool's frame with this number.
    pub fn fail_at(&self, number: usize, fault: Fault) {
        self.record.borrow_mut().fault = Some((number, fault));
    }

    /// Mends what went wrong; true if something did.
    pub fn mend(&self) -> bool {
        self.is_interrupted.store(false, Ordering::Relaxed);
        for number in 0..self.boards.len() {
            if !self.bus().slaves[number].is_powered {
                self.power_on(number, Cause::Other);
            }
        }
        let mut record = self.record.borrow_mut();
        record.is_adapter_gone = false;
        record.fault.take().is_none()
    }

    /// Lets time pass without the tool.
    pub fn pass_s(&self, seconds: u64) {
        let mut fleet = self.clone();
        let until = fleet.adapter.now() + Duration::from_secs(seconds);
        while fleet.adapter.now() < until {
            fleet.receive_step(LONG_STEP);
        }
    }

    /// Loses each frame with a number that is a multiple of this.
    pub fn lose_each(&self, number: usize) {
        self.record.borrow_mut().lost = Some(number);
    }

    /// Lets the boards have no block transfer.
    pub fn forbid_blocks(&self) {
        self.record.borrow_mut().has_no_blocks = true;
    }

    /// Asserts that no board is in LSS configuration state.
    #[track_caller]
    pub fn assert_waiting(&self) {
        assert_eq!(self.bus().in_configuration(), 0);
    }

    /// Cuts the power of a board.
    pub fn power_off(&self, number: usize) {
        self.board(number).power_off();
        self.bus().happen(number, Happening::PowerOff);
    }

    fn power_on(&self, number: usize, cause: Cause) {
        let mut board = self.board(number);
        board.boot(cause);
        let (hangs, owes_answer) = (board.hangs, board.owes_answer);
        drop(board);
        let mut bus = self.bus();
        bus.happen(number, if hangs { Happening::PullOut } else { Happening::PlugIn });
        bus.happen(number, Happening::PowerOn);
        if owes_answer {
            bus.on_bus(number, |rig| {
                let id = rig.node.node_id().map_or(0, |id| u16::from(id.get()));
                let answer = Frame::new(0x580 + id, &[0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]);
                rig.act(answer.map(|frame| Action::Transmit(frame, Service::Sdo)));
            });
        }
    }

    /// Lets each board do what is due.
    fn look(&self) {
        let now = self.bus().now();
        for number in 0..self.boards.len() {
            let deeds = self.board(number).poll(now);
            for deed in deeds {
                match deed {
                    Deed::Answer(outcome) => self.bus().on_bus(number, |rig| {
                        let action = rig.node.answer(outcome);
                        rig.act(action);
                    }),
                    Deed::Reset(cause) => {
                        self.bus().happen(number, Happening::PowerOff);
                        self.power_on(number, cause);
                    }
                }
            }
        }
    }

    fn receive_step(&mut self, wait: Duration) -> Option<Received> {
        self.look();
        let received = self.adapter.receive(wait);
        self.look();
        received.expect("the bus is there")
    }

    fn assert_adapter(&self) -> Result<(), Stop> {
        match self.record.borrow().is_adapter_gone {
            true => Err(Stop::AdapterGone("pulled out".into())),
            false => Ok(()),
        }
    }
}

impl Adapter for Fleet {
    forward!();

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        self.assert_adapter()?;
        let number = self.record.borrow().sent.len();
        let fault = self.record.borrow_mut().fault.take_if(|(at, _)| *at == number);
        self.record.borrow_mut().sent.push(*frame);
        match fault {
            Some((_, Fault::CtrlC)) => self.is_interrupted.store(true, Ordering::Relaxed),
            Some((_, Fault::AdapterGone)) => {
                self.record.borrow_mut().is_adapter_gone = true;
                return self.assert_adapter();
            }
            Some((_, Fault::PowerCut(board))) => self.power_off(board),
            Some((_, Fault::PowerFails(board))) => {
                self.power_off(board);
                self.power_on(board, Cause::Other);
            }
            Some((_, Fault::FrameIsLost)) => return Ok(()),
            Some((_, Fault::AnswerIsLost(board))) => {
                self.bus().slaves[board].defect = Some(Defect::LosesAnswers(1));
            }
            Some((_, Fault::FlashFails(board))) => {
                self.board(board).chip.borrow_mut().fault = Some(FlashError::Failed);
            }
            None => {}
        }
        let record = self.record.borrow();
        if record.lost.is_some_and(|lost| number % lost == lost - 1) {
            return Ok(());
        }
        match *frame.data() {
            // A command that no server knows.
            [0xC6, a, b, c, ..] if record.has_no_blocks => {
                let frame = Frame::new(frame.cob_id(), &[0xE6, a, b, c, 0, 0, 0, 0]);
                frame.map_or(Ok(()), |frame| self.adapter.send(&frame))
            }
            _ => self.adapter.send(frame),
        }
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        self.assert_adapter()?;
        let until = self.now() + wait;
        loop {
            let left = until.saturating_duration_since(self.now());
            let received = self.receive_step(left.min(STEP));
            if received.is_some() || self.now() >= until {
                return Ok(received);
            }
        }
    }

    fn status(&mut self) -> Result<Option<Status>, Stop> {
        self.adapter.status()
    }
}
