//! The adapter of emulated boards, in virtual time, and the outcome of a command on it.

use std::{
    cell::{Cell, RefCell, RefMut},
    io,
    rc::Rc,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, Mode, Received, Status},
    person::Person,
    stop::Stop,
};
use canopen_node::{
    BitRate, Frame, NodeId,
    lss::{Address, REQUEST_COB_ID, RESPONSE_COB_ID},
    nmt,
    settings::Log,
};
use emulator::{Time, network::Network};
use firmware::device::DEVICE;
use lss::{Arguments, Session, Shows};
use testkit::{
    flash::BoardFlash,
    image::Firmware,
    image_rig::{ImageRig, SETTINGS_LENGTH, SETTINGS_OFFSET, blank_board, board_with, settings},
    wire::{bit_per_s, from_the_wire, on_the_wire},
};

/// The NMT command reset node.
const RESET_NODE: u8 = 0x81;

/// What happens at a frame that the tool sends.
type Hook = Box<dyn FnMut(&Frame, &mut Network)>;

/// What happens at a time.
type Deed = (Time, Box<dyn FnOnce(&mut Network)>);

/// Boards on a bus, and the tool's adapter.
#[derive(Clone)]
pub struct Boards {
    rig: Rc<RefCell<ImageRig>>,
    hook: Rc<RefCell<Option<Hook>>>,
    deeds: Rc<RefCell<Vec<Deed>>>,
    /// The LSS service that the boards do not support: requests with this command specifier are lost.
    pub unsupported: Rc<Cell<Option<u8>>>,
    /// The number of LSS answers until one is lost; 0: none.
    pub answers_until_loss: Rc<Cell<usize>>,
    pub is_interrupted: Arc<AtomicBool>,
    /// Whether the results go to a terminal of 80 by 24 characters.
    pub has_screen: Rc<Cell<bool>>,
    /// What the person says, if there is one.
    pub person: Rc<Cell<Option<&'static [&'static str]>>>,
    known_errors: Rc<Cell<u64>>,
    start: Instant,
}

/// The outcome of a command.
pub struct Outcome {
    pub text: String,
    pub code: u8,
    pub error: String,
    /// The answer time of a slow slave that the person was told of.
    pub slow_answer: Option<Duration>,
    /// The serial numbers that the person was told to be there twice.
    pub twice: Vec<u32>,
    /// What the person was told of the adapter.
    pub remarks: Vec<String>,
}

impl Boards {
    /// Boards with these node-IDs, FF: none, at `rate`. None of them sends a heartbeat, but a blank board once it has a
    /// node-ID.
    pub fn new(rate: BitRate, node_ids: &[u8]) -> Self {
        let board = |(number, id): (usize, &u8)| match (*id, rate) {
            (0xFF, BitRate::Kbit125) => blank_board(Firmware::Default, number as u8 + 1),
            (id, rate) => board_with(Firmware::Default, number as u8 + 1, settings(id, rate)),
        };
        Self::of(ImageRig::new(rate, node_ids.iter().enumerate().map(board)))
    }

    /// Boards with these node-IDs, FF: none, and these stored bit rates, which nobody has acknowledged yet. With a
    /// node-ID they send a heartbeat each `heartbeat_ms`; 0: never.
    pub fn unattended(firmware: Firmware, boards: &[(u8, BitRate)], heartbeat_ms: u16) -> Self {
        let mut rig = ImageRig::new(BitRate::Kbit125, []);
        rig.network.adapter_mut(rig.master).close();
        for (number, (id, rate)) in boards.iter().enumerate() {
            let settings = settings(*id, *rate).with_heartbeat_ms(heartbeat_ms);
            let board = board_with(firmware, number as u8 + 1, settings);
            let board = rig.network.add_board(board);
            rig.boot(board, Time::ZERO);
        }
        Self::of(rig)
    }

    fn of(mut rig: ImageRig) -> Self {
        rig.network.run_for(Time::from_ms(100));
        Self {
            rig: Rc::new(RefCell::new(rig)),
            hook: Rc::default(),
            deeds: Rc::default(),
            unsupported: Rc::default(),
            answers_until_loss: Rc::default(),
            is_interrupted: Arc::default(),
            has_screen: Rc::default(),
            person: Rc::default(),
            known_errors: Rc::default(),
            start: Instant::now(),
        }
    }

    /// Lets something happen at the frames that the tool sends.
    pub fn at_each_frame(&self, hook: impl FnMut(&Frame, &mut Network) + 'static) {
        *self.hook.borrow_mut() = Some(Box::new(hook));
    }

    /// Lets something happen after a number of seconds, while the tool waits for frames.
    pub fn after(&self, seconds: u64, deed: impl FnOnce(&mut Network) + 'static) {
        let time = self.rig().network.now() + Time::from_ms(1000 * seconds);
        self.deeds.borrow_mut().push((time, Box::new(deed)));
    }

    /// Acts like Ctrl-C after a number of seconds.
    pub fn interrupt_after(&self, seconds: u64) {
        let flag = Arc::clone(&self.is_interrupted);
        self.after(seconds, move |_| flag.store(true, Ordering::Relaxed));
    }

    /// Acts like Ctrl-C at the tool's frame with this number.
    pub fn interrupt_at(&self, number: usize) {
        let flag = Arc::clone(&self.is_interrupted);
        let mut count = 0;
        self.at_each_frame(move |_, _| {
            count += 1;
            if count == number {
                flag.store(true, Ordering::Relaxed);
            }
        });
    }

    pub fn rig(&self) -> RefMut<'_, ImageRig> {
        self.rig.borrow_mut()
    }

    /// Runs `lss` with these arguments. No board may be reset before an NMT reset node.
    pub fn lss(&self, arguments: &str) -> Outcome {
        self.rig().network.forbid_misuse();
        run(Box::new(self.clone()), &self.is_interrupted, arguments, |session| {
            session.screen = self.has_screen.get().then_some(|| (80, 24));
            if let Some(lines) = self.person.get() {
                session.person = Person::who_says(lines);
            }
        })
    }

    /// Asserts that no board is in LSS configuration state: none answers to inquire node-ID at `rate`.
    #[track_caller]
    pub fn assert_waiting(&self, rate: BitRate) {
        let mut rig = self.rig();
        rig.set_master_bit_rate(rate);
        let master = rig.master;
        rig.network.adapter_mut(master).open();
        let answers = rig.lss("5E");
        assert!(answers.0.iter().all(|frame| frame.cob_id() != 0x7E4), "{answers:?}");
    }

    /// What a board has stored: its node-ID, FF: none, and the index of its bit rate; `None` for a blank one.
    pub fn stored(&self, board: usize) -> Option<(u8, u8)> {
        let rig = self.rig();
        let log = rig.network.board(board).flash()[SETTINGS_OFFSET as usize..][..SETTINGS_LENGTH]
            .to_vec();
        let settings = Log::open(BoardFlash::with_content(log, 0)).0.settings()?;
        Some((NodeId::to_lss(settings.node_id), settings.bit_rate.index()))
    }
}

/// Where a command writes its results.
#[derive(Clone, Default)]
struct Out(Rc<RefCell<Vec<u8>>>);

impl io::Write for Out {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.borrow_mut().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Runs `lss` with these arguments on an adapter, in a session that `prepare` changes first.
pub fn run(
    adapter: Box<dyn Adapter>,
    is_interrupted: &Arc<AtomicBool>,
    arguments: &str,
    prepare: impl FnOnce(&mut Session),
) -> Outcome {
    let words = ["lss"].into_iter().chain(arguments.split_whitespace());
    let is_prompt = !arguments.contains("--latency");
    let mut arguments = Arguments::read(words).expect("a command line");
    if is_prompt {
        arguments.latency = 1;
    }
    let is_interrupted = Arc::clone(is_interrupted);
    let out = Out::default();
    let results = Box::new(out.clone());
    let session = Session::new(adapter, &arguments, is_interrupted, results, Shows::Nothing);
    let mut session = session.expect("a log that can be written");
    prepare(&mut session);
    let outcome = session.run(&arguments);
    let Session { slow_answer, twice, remarks, .. } = session;
    let text = String::from_utf8(out.0.take()).expect("UTF-8");
    let (code, error) = match outcome {
        Ok(()) => (0, String::new()),
        Err(failure) => (failure.exit_code(), failure.to_string()),
    };
    println!("{text}{error}");
    Outcome { text, code, error, slow_answer, twice, remarks }
}

/// The LSS address of the board with this number.
pub fn address(board: usize) -> Address {
    let serial_number = Address::serial_number_of(&[board as u8 + 1; 12]);
    Address { serial_number, ..DEVICE.address }
}

/// The same as the tool writes it.
pub fn address_text(board: usize) -> String {
    text(address(board))
}

/// An LSS address as the tool writes it.
pub fn text(address: Address) -> String {
    address.to_string()
}

impl Adapter for Boards {
    fn open(&mut self, rate: BitRate, mode: Mode) -> Result<(), Stop> {
        let mut rig = self.rig.borrow_mut();
        let master = rig.master;
        while rig.network.receive(master).is_some() {}
        let adapter = rig.network.adapter_mut(master);
        adapter.set_bit_rate(bit_per_s(rate));
        match mode {
            Mode::Normal => adapter.open(),
            Mode::ListenOnly => adapter.listen_only(),
        }
        self.known_errors.set(adapter.errors());
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        let mut rig = self.rig.borrow_mut();
        let master = rig.master;
        rig.network.adapter_mut(master).close();
        Ok(())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        let mut rig = self.rig.borrow_mut();
        let master = rig.master;
        let unsupported = self.unsupported.get();
        if frame.cob_id() != REQUEST_COB_ID
            || unsupported.is_none()
            || frame.data().first() != unsupported.as_ref()
        {
            rig.network.send(master, on_the_wire(frame));
        }
        if (frame.cob_id(), frame.data().first()) == (nmt::COMMAND_COB_ID, Some(&RESET_NODE)) {
            rig.network.permit_misuse();
        }
        if let Some(hook) = &mut *self.hook.borrow_mut() {
            hook(frame, &mut rig.network);
        }
        Ok(())
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        let mut rig = self.rig.borrow_mut();
        let master = rig.master;
        let now = rig.network.now();
        for (_, deed) in self.deeds.borrow_mut().extract_if(.., |(time, _)| *time <= now) {
            deed(&mut rig.network);
        }
        let received =
            rig.network.run_until_received(master, Time::from_us(wait.as_micros() as u64));
        let instant = |time: Time| Duration::from_micros(time.as_us());
        Ok(received.and_then(|(time, frame)| {
            let frame = from_the_wire(&frame)?;
            if frame.cob_id() == RESPONSE_COB_ID {
                let left = self.answers_until_loss.get();
                self.answers_until_loss.set(left.saturating_sub(1));
                if left == 1 {
                    return None;
                }
            }
            Some(Received { frame, at: instant(time), here: self.start + instant(time) })
        }))
    }

    fn status(&mut self) -> Result<Option<Status>, Stop> {
        let mut rig = self.rig.borrow_mut();
        let master = rig.master;
        let errors = rig.network.adapter_mut(master).errors();
        let has_errors = errors > self.known_errors.replace(errors);
        Ok(Some(Status { is_error_passive: false, has_errors }))
    }

    fn now(&self) -> Instant {
        self.start + Duration::from_micros(self.rig.borrow().network.now().as_us())
    }

    fn description(&self) -> String {
        "emulated boards".into()
    }
}
