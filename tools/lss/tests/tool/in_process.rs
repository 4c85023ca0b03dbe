//! Boards of the example `io` on the bus within the process, and the tool's adapter there: thousands of runs in seconds.
//! It counts what is written, and never are two boards one node, not even after a power cut.

use std::{
    cell::{RefCell, RefMut},
    path::Path,
    rc::Rc,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, Mode, Received, Status},
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
    random::Random,
    sdo::Client,
    slave_bus::{BusAdapter, Firmware, Habits, Happening, SlaveBus},
};

use crate::emulated::{Outcome, run, text};

/// More time than a frame takes, in microseconds.
const FRAME_US: u64 = 2_000;

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

/// When it goes wrong: at a write, or at a frame from the first write on, from 0 on.
#[derive(Clone, Copy, Debug)]
pub enum At {
    Write(usize),
    Frame(usize),
}

/// The boards, the bus, and the tool's adapter.
#[derive(Clone)]
pub struct Wire {
    adapter: BusAdapter<Application>,
    record: Rc<RefCell<Record>>,
    is_interrupted: Arc<AtomicBool>,
}

/// What the tool has done, and what goes wrong with it.
#[derive(Default)]
pub struct Record {
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
    is_adapter_gone: bool,
    /// NMT commands are lost.
    pub loses_nmt: bool,
    /// The adapter does not report its status.
    pub has_no_status: bool,
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
            let rig = NodeRig::with_application(device, flash, 0, Application::new());
            // It answers at once.
            (rig, Habits { answer_us: 0..1, store_us: 0, ..Habits::default() })
        };
        let boards = node_ids.iter().enumerate().map(board);
        let mut bus = SlaveBus::new(boards, Random::from_seed(1));
        // Nobody hears the boot-up messages.
        bus.pass_us(100 * FRAME_US);
        Self {
            adapter: BusAdapter::new(bus),
            record: Rc::default(),
            is_interrupted: Arc::default(),
        }
    }

    pub fn bus(&self) -> RefMut<'_, SlaveBus<Application>> {
        self.adapter.bus()
    }

    /// The tool's adapter with the firmware of another one.
    pub fn with_firmware(&self, firmware: Firmware) -> Result<Box<dyn Adapter>, Stop> {
        self.adapter.with_firmware(firmware)
    }

    pub fn record(&self) -> RefMut<'_, Record> {
        self.record.borrow_mut()
    }

    /// Runs `lss` with these arguments.
    pub fn lss(&self, arguments: &str) -> Outcome {
        run(Box::new(self.clone()), &self.is_interrupted, arguments, |_| ())
    }

    /// Runs `lss apply` with a file; returns the outcome and the number of writes.
    pub fn apply(&self, file: &Path, options: &str) -> (Outcome, usize) {
        let before = self.record().writes;
        let outcome = self.lss(&format!("apply {} {options}", file.display()));
        let writes = self.record().writes - before;
        (outcome, writes)
    }

    /// Lets something go wrong.
    pub fn fail_at(&self, at: At, fault: Fault) {
        self.record().fault = Some((fault, at));
    }

    /// Lets somebody send so many PDOs at once, again and again, for this time.
    pub fn load(&self, pdos: u64, every_us: u64, seconds: u64) {
        let mut bus = self.bus();
        let begin = bus.now();
        // It is for node 127, and tells of no node.
        let pdo = Frame::new(0x27F, &[0; 8]).expect("a frame");
        for at in (begin..begin + 1_000_000 * seconds).step_by(every_us as usize) {
            (0..pdos).for_each(|_| bus.send_from_another_master(at, pdo));
        }
    }

    /// Plugs a board in, or pulls it out, so many seconds from now on.
    pub fn hand(&self, seconds: u64, board: usize, is_there: bool) {
        let happening = if is_there { Happening::PowerOn } else { Happening::PowerOff };
        let mut bus = self.bus();
        let at = bus.now() + 1_000_000 * seconds;
        bus.plan(at, board, happening);
    }

    /// Pulls a board out.
    pub fn pull_out(&self, board: usize) {
        self.bus().happen(board, Happening::PowerOff);
    }

    /// The virtual time in seconds.
    pub fn seconds(&self) -> u64 {
        self.bus().now() / 1_000_000
    }

    /// Mends what went wrong, before another run; true if something did.
    pub fn mend(&self) -> bool {
        // It may have come at the last frame.
        self.is_interrupted.store(false, Ordering::Relaxed);
        self.bus().calm();
        let mut record = self.record();
        record.is_adapter_gone = false;
        record.fault.take().is_none()
    }

    /// Cuts the power of all boards, and restores it.
    pub fn power_cycle(&self) {
        let mut bus = self.bus();
        for happening in [Happening::PowerOff, Happening::PowerOn] {
            (0..bus.slaves.len()).for_each(|board| bus.happen(board, happening));
        }
        bus.pass_us(100 * FRAME_US);
        drop(bus);
        self.assert_alone();
    }

    /// The node-ID in use and the stored one of each board.
    pub fn ids(&self) -> Vec<(Option<u8>, Option<u8>)> {
        let ids = |rig: &NodeRig<Application>| {
            let stored = rig.stored().and_then(|settings| settings.node_id);
            (rig.node.node_id().map(NodeId::get), stored.map(NodeId::get))
        };
        self.bus().slaves.iter().map(|board| ids(&board.rig)).collect()
    }

    /// The bit rates of the boards.
    pub fn bit_rates(&self) -> Vec<BitRate> {
        self.bus().slaves.iter().map(|board| board.rig.bit_rate()).collect()
    }

    /// The value of an object of a board.
    pub fn value(&self, board: usize, index: u16, sub_index: u8) -> Vec<u8> {
        let value = self.bus().beside_bus(board, |rig| rig.upload(index, sub_index));
        value.expect("it can be read")
    }

    /// Writes a value of a board without the tool.
    pub fn set(&self, board: usize, index: u16, sub_index: u8, bytes: &[u8]) {
        let outcome = self.bus().beside_bus(board, |rig| rig.download(index, sub_index, bytes));
        outcome.expect("it can be written");
    }

    /// Lets a board have received an NMT command.
    pub fn nmt(&self, board: usize, command: &str) {
        self.bus().beside_bus(board, |rig| drop(rig.nmt(command)));
    }

    /// Asserts that no board is in LSS configuration state.
    #[track_caller]
    pub fn assert_waiting(&self) {
        assert_eq!(self.bus().in_configuration(), 0);
    }

    /// Asserts that no two boards have one node-ID, neither in use nor stored.
    #[track_caller]
    fn assert_alone(&self) {
        if self.record().may_collide {
            return;
        }
        let bus = self.bus();
        let there = bus.slaves.iter().filter(|board| board.is_powered);
        let active: Vec<NodeId> = there.filter_map(|board| board.rig.node.node_id()).collect();
        let stored = bus.slaves.iter().filter_map(|board| board.rig.stored()?.node_id);
        for (what, mut ids) in [("in use", active), ("stored", stored.collect())] {
            let count = ids.len();
            ids.sort_unstable();
            ids.dedup();
            assert_eq!(ids.len(), count, "a node-ID twice {what}: {ids:?}");
        }
    }
}

impl Record {
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
}

impl Wire {
    /// Lets all frames leave the adapter that were sent before.
    fn flush(&mut self) -> Result<(), Stop> {
        self.adapter.close()?;
        self.bus().pass_us(FRAME_US);
        Ok(())
    }

    fn assert_adapter(&self) -> Result<(), Stop> {
        match self.record().is_adapter_gone {
            true => Err(Stop::AdapterGone("pulled out".into())),
            false => Ok(()),
        }
    }
}

/// The methods of an adapter in front of another one, `self.adapter`, but for what a test changes.
macro_rules! forward {
    () => {
        fn open(&mut self, rate: BitRate, mode: Mode) -> Result<(), Stop> {
            self.adapter.open(rate, mode)
        }

        fn close(&mut self) -> Result<(), Stop> {
            self.adapter.close()
        }

        fn now(&self) -> Instant {
            self.adapter.now()
        }

        fn latency(&self) -> Option<Duration> {
            self.adapter.latency()
        }

        fn description(&self) -> String {
            self.adapter.description()
        }
    };
}
pub(crate) use forward;

impl Adapter for Wire {
    forward!();

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        self.assert_adapter()?;
        let fault = self.record().fault_at(frame);
        match fault {
            Some(Fault::CtrlC) => self.is_interrupted.store(true, Ordering::Relaxed),
            Some(Fault::BoardGone(number)) => self.pull_out(number),
            Some(Fault::OtherMaster) => {
                let mut bus = self.bus();
                let now = bus.now();
                bus.send_from_another_master(now, Request::SwitchToConfiguration.to_frame());
            }
            Some(Fault::AdapterGone) => {
                self.record().is_adapter_gone = true;
                self.flush()?;
                return self.assert_adapter();
            }
            Some(Fault::AdapterGoneBehind) | None => {}
        }
        self.record().sent.push(*frame);
        self.record().writes += usize::from(is_write(frame));
        if !(self.record().loses_nmt && frame.cob_id() == nmt::COMMAND_COB_ID) {
            self.adapter.send(frame)?;
        }
        if fault == Some(Fault::AdapterGoneBehind) {
            self.record().is_adapter_gone = true;
            self.flush()?;
        }
        Ok(())
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        self.assert_adapter()?;
        let received = self.adapter.receive(wait);
        self.assert_alone();
        received
    }

    fn status(&mut self) -> Result<Option<Status>, Stop> {
        let status = self.adapter.status()?;
        Ok(status.filter(|_| !self.record().has_no_status))
    }
}
