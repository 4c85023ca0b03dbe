//! The runner that all boards share, over a controller in memory: frames that wait, errors, samples of the bus, and
//! loops that poll.

use std::{cell::RefCell, collections::VecDeque, rc::Rc};

use canopen_node::{
    Application, BitRate, Count, Device, Frame, Instant, Node, NodeId, Numbers, Receives, Service,
    Services, Settings,
    application::{NoApplication, Text},
    emergency::Fault,
    indicator::BusState,
    lss::StoreError,
    objects,
    runner::{self, BusError, Controller, Mode, Received, Runner, Sample, System},
    settings::{Found, Log},
};
use testkit::{
    flash::BoardFlash,
    frames::{self, Frames, SILENCE},
    node_rig::{ADDRESS, defaults, device},
};

use crate::{
    process_data::{Machine, With},
    program::Loader,
};

/// The bus while nothing happens.
const IDLE: Sample = Sample { is_recessive: true, is_transmitting: false };
const DOMINANT: Sample = Sample { is_recessive: false, is_transmitting: false };

type Storage = Log<BoardFlash, { <Node>::STORED_LEN }>;

/// The rest of the board: a controller with a place for one frame, its bus, and a clock.
struct Chip {
    now_us: u32,
    alarm_at_us: u32,
    received: VecDeque<Received>,
    /// The frame that waits for the bus.
    place: Option<(Frame, Service)>,
    acknowledged: Services,
    /// Whether the others acknowledge at once.
    is_bus_free: bool,
    sent: Vec<Frame>,
    /// The rates at which the controller was started.
    starts: Vec<(Mode, u16)>,
    /// Whether it was asked to receive all frames, each time afterwards.
    receives_all: Vec<bool>,
    refused_starts: usize,
    error: Option<BusError>,
    /// How often it was asked to report the next error.
    asked_for_errors: usize,
    state: BusState,
    sample: Sample,
    resets: usize,
}

/// A handle to the chip, as the runner's controller and system.
#[derive(Clone)]
struct Handle(Rc<RefCell<Chip>>);

impl Chip {
    fn take_frame(&mut self, frame: Frame, service: Service) {
        self.place = Some((frame, service));
        if self.is_bus_free {
            self.complete();
        }
    }

    fn complete(&mut self) {
        if let Some((frame, service)) = self.place.take() {
            self.sent.push(frame);
            self.acknowledged = self.acknowledged.and(Services::of(service));
        }
    }
}

impl Controller for Handle {
    fn start<N: Numbers>(&mut self, mode: Mode, bit_rate: BitRate, _: &Receives<N>) -> bool {
        let mut chip = self.0.borrow_mut();
        chip.place = None;
        chip.received.clear();
        chip.starts.push((mode, bit_rate.kbit_per_s()));
        chip.refused_starts = chip.refused_starts.saturating_sub(1);
        chip.refused_starts == 0
    }

    fn set_receives<N: Numbers>(&mut self, receives: &Receives<N>) {
        self.0.borrow_mut().receives_all.push(receives.all);
    }

    fn receive(&mut self) -> Option<Received> {
        self.0.borrow_mut().received.pop_front()
    }

    fn send(&mut self, frame: &Frame, service: Service) -> bool {
        let mut chip = self.0.borrow_mut();
        let is_empty = chip.place.is_none();
        if is_empty {
            chip.take_frame(*frame, service);
        }
        is_empty
    }

    fn take_sent(&mut self) -> Services {
        std::mem::replace(&mut self.0.borrow_mut().acknowledged, Services::NONE)
    }

    fn is_idle(&mut self) -> bool {
        self.0.borrow().place.is_none()
    }

    fn drop_frames(&mut self, services: Services) {
        self.0.borrow_mut().place.take_if(|(_, service)| services.has(*service));
    }

    fn take_error(&mut self) -> Option<BusError> {
        self.0.borrow_mut().error.take()
    }

    fn report_errors(&mut self) {
        self.0.borrow_mut().asked_for_errors += 1;
    }

    fn error_counters(&self) -> (u8, u8) {
        (0, 0)
    }

    fn bus_state(&self) -> BusState {
        self.0.borrow().state
    }

    fn sample(&self) -> Option<Sample> {
        Some(self.0.borrow().sample)
    }
}

impl System for Handle {
    fn now(&self) -> Instant {
        Instant::from_micros(self.0.borrow().now_us)
    }

    fn reset(&mut self) {
        self.0.borrow_mut().resets += 1;
    }

    fn set_alarm(&mut self, at: Instant) {
        self.0.borrow_mut().alarm_at_us = at.as_micros();
    }
}

objects! {
    /// What is long enough for block transfer.
    struct Label, values LabelValue;

    0x2001 {
        0 "Label" label: Text<40> = Text::EMPTY, rw;
    }
}

impl Application for Label {}

/// A board with its runner.
struct Board<A: Application = NoApplication> {
    chip: Rc<RefCell<Chip>>,
    runner: Runner<Handle, Handle, A>,
}

impl Board {
    fn new(device: Device) -> Self {
        Self::with_application(device, NoApplication)
    }

    /// A board with node-ID 5 that has sent its boot-up.
    fn with_node_id() -> Self {
        let mut board = Self::new(device(ADDRESS).with_defaults(defaults(5)));
        board.pass_ms(1);
        assert_eq!(board.take_sent(), ["705: 00"]);
        board
    }
}

impl<A: Application> Board<A> {
    fn with_application(device: Device, application: A) -> Self {
        let chip = Rc::new(RefCell::new(Chip {
            now_us: 0,
            alarm_at_us: 0,
            received: VecDeque::new(),
            place: None,
            acknowledged: Services::NONE,
            is_bus_free: true,
            sent: Vec::new(),
            starts: Vec::new(),
            receives_all: Vec::new(),
            refused_starts: 0,
            error: None,
            asked_for_errors: 0,
            state: BusState::Good,
            sample: IDLE,
            resets: 0,
        }));
        let handle = Handle(chip.clone());
        let node = Node::with_application(device, None, application);
        Self { chip, runner: Runner::new(node, handle.clone(), handle) }
    }

    fn chip(&self) -> std::cell::RefMut<'_, Chip> {
        self.chip.borrow_mut()
    }

    fn take_sent(&self) -> Frames {
        Frames(std::mem::take(&mut self.chip().sent))
    }

    fn take_starts(&self) -> Vec<(Mode, u16)> {
        std::mem::take(&mut self.chip().starts)
    }

    /// Lets frames arrive together.
    fn receive(&mut self, frames: &[&str]) {
        let frames = frames.iter().map(|text| Received::Frame(frames::of_master(text)));
        self.chip().received.extend(frames);
        self.runner.handle_received();
    }

    fn handle_error(&mut self, error: BusError) {
        self.chip().error = Some(error);
        self.runner.handle_status();
    }

    /// Lets time pass, with every interrupt that comes.
    fn pass_ms(&mut self, ms: u32) {
        let end = Instant::from_micros(self.chip().now_us).plus_micros(1000 * ms);
        loop {
            let alarm_at = Instant::from_micros(self.chip().alarm_at_us);
            if !alarm_at.has_come(end) {
                break;
            }
            let now = Instant::from_micros(self.chip().now_us).later(alarm_at);
            self.chip().now_us = now.as_micros();
            self.runner.handle_alarm();
            self.runner.handle_transmitted();
        }
        self.chip().now_us = end.as_micros();
    }

    /// Lets the frame in the controller leave, and those that follow, one after another.
    fn free_bus(&mut self) {
        while self.chip().place.is_some() {
            self.chip().complete();
            self.runner.handle_transmitted();
        }
    }
}

#[test]
fn frames_wait_most_urgent_first_and_answers_in_order() {
    let mut board = Board::with_node_id();
    board.chip().is_bus_free = false;
    board.receive(&["04 01", "5E", "5A", "605: 40 00 10 00 00 00 00 00", "5B"]);
    assert_eq!(board.take_sent(), SILENCE);
    board.free_bus();
    // The first was in the controller when the others came.
    let sent = board.take_sent().texts();
    let [first, sdo, second, third] = &sent[..] else { panic!("{sent:?}") };
    assert_eq!([&first[..7], &second[..7], &third[..7]], ["7E4: 5E", "7E4: 5A", "7E4: 5B"]);
    assert_eq!(&sdo[..7], "585: 43");
}

#[test]
fn only_lss_answers_outlive_a_reset_of_the_communication() {
    let mut board = Board::with_node_id();
    board.chip().is_bus_free = false;
    board.receive(&["04 01", "5E", "605: 40 00 10 00 00 00 00 00", "5A", "000: 82 05"]);
    board.free_bus();
    let [first, boot_up, second] = &board.take_sent().texts()[..] else { panic!() };
    assert_eq!([&first[..7], boot_up, &second[..7]], ["7E4: 5E", "705: 00", "7E4: 5A"]);
}

/// A board in NMT operational on a busy bus, with a heartbeat every 100 ms and this event timer of its first TPDO.
fn operational(event_timer_ms: &str) -> Board<Machine> {
    let device = device(ADDRESS).with_defaults(defaults(5)).with_heartbeat_ms(100);
    let mut board = Board::with_application(device, Machine::new());
    board.pass_ms(1);
    board.receive(&[&format!("605: 2B 00 18 05 {event_timer_ms} 00 00 00"), "000: 01 05"]);
    board.pass_ms(1);
    board.take_sent();
    board.chip().is_bus_free = false;
    board
}

#[test]
fn heartbeats_go_on_whatever_waited_for_the_bus_when_pdos_were_dropped() {
    for end in ["000: 80 05", "000: 02 05"] {
        let mut board = operational("00");
        board.pass_ms(100);
        board.runner.application(|machine| machine.level = 7);
        board.chip().complete();
        board.runner.handle_transmitted();
        assert_eq!(board.take_sent(), ["705: 05"], "the TPDO waits behind the heartbeat");
        check_heartbeats(board, end);

        let mut board = operational("32");
        board.pass_ms(50);
        assert_eq!(
            board.chip().place.map(|(frame, _)| frame.cob_id()),
            Some(0x185),
            "a timed TPDO"
        );
        check_heartbeats(board, end);
    }
}

/// Ends NMT operational on a bus that is free from then on.
fn check_heartbeats(mut board: Board<Machine>, end: &str) {
    board.receive(&[end]);
    let waiting = board.chip().place.map(|(_, service)| service);
    assert!(matches!(waiting, None | Some(Service::Heartbeat)), "{waiting:?}");
    board.free_bus();
    board.chip().is_bus_free = true;
    board.pass_ms(1_000);
    let heartbeats = board.take_sent().texts();
    assert!((9..=11).contains(&heartbeats.len()), "{end}: {heartbeats:?}");
}

#[test]
fn frames_that_find_no_room_are_dropped() {
    let mut board = Board::with_node_id();
    board.chip().is_bus_free = false;
    board.receive(&["04 01"]);
    (0..30).for_each(|_| board.receive(&["5E"]));
    board.free_bus();
    assert_eq!(board.take_sent().texts().len(), 1 + 24);
}

#[test]
fn there_is_room_for_every_tpdo_and_for_all_other_services() {
    let device = device(ADDRESS).with_defaults(defaults(5)).with_heartbeat_ms(100);
    let mut board = Board::with_application(device, With::<16, 16, 2>::new());
    board.pass_ms(1);
    for number in 5..=16 {
        let [at, cob_id] = [number - 1, number].map(|byte| format!("{byte:02X}"));
        board.receive(&[
            &format!("605: 2F {at} 1A 00 00 00 00 00"),
            &format!("605: 23 {at} 1A 01 08 01 00 60"),
            &format!("605: 2F {at} 1A 00 01 00 00 00"),
            &format!("605: 23 {at} 18 01 {cob_id} 04 00 00"),
        ]);
    }
    board.receive(&["04 01"]);
    board.pass_ms(100);
    board.take_sent();
    board.chip().is_bus_free = false;
    board.receive(&["000: 01 05", "080: "]);
    board.runner.with(|node| node.report(0xFF01, 0, [0; 5]));
    board.receive(&["605: 40 00 10 00 00 00 00 00", "5E", "5A", "5B"]);
    board.pass_ms(100);
    board.free_bus();
    let sent = board.take_sent().0;
    let count = |range: std::ops::RangeInclusive<u16>| {
        sent.iter().filter(|frame| range.contains(&frame.cob_id())).count()
    };
    assert_eq!(count(0x181..=0x410), 14, "TPDOs: {sent:?}");
    assert_eq!([0x085, 0x585, 0x705, 0x7E4].map(|id| count(id..=id)), [1, 1, 1, 3], "{sent:?}");
}

/// A handler of the runner.
type Handler<A> = fn(&mut Runner<Handle, Handle, A>);

/// The handlers, one of which an interrupt calls first after a halt.
fn handlers<A: Application>() -> [Handler<A>; 4] {
    [
        |runner| runner.handle_received(),
        |runner| runner.handle_transmitted(),
        |runner| runner.handle_status(),
        |runner| _ = runner.handle_alarm(),
    ]
}

/// Lets a debugger halt the program for so many seconds, while the controller goes on; then calls this handler.
fn halt<A: Application>(board: &mut Board<A>, seconds: u32, handler: Handler<A>) {
    let end = Instant::from_micros(board.chip().now_us).plus_micros(seconds * 1_000_000);
    board.chip().now_us = end.as_micros();
    if board.chip().place.is_some() {
        board.chip().complete();
    }
    board.take_sent();
    board.chip().is_bus_free = true;
    handler(&mut board.runner);
    board.pass_ms(100);
}

/// Two seconds, and more than half a turn of the count of microseconds.
#[test]
fn what_came_or_waited_while_a_debugger_had_halted_the_core_is_dropped() {
    for (seconds, handler) in [2, 40 * 60].into_iter().flat_map(|s| handlers().map(|h| (s, h))) {
        let mut board = Board::with_node_id();
        board.chip().is_bus_free = false;
        board.receive(&["04 01", "5E", "5A", "605: 40 00 10 00 00 00 00 00"]);
        let late = ["5B", "605: 40 18 10 01 00 00 00 00"].map(frames::of_master);
        board.chip().received.extend(late.map(Received::Frame));
        halt(&mut board, seconds, handler);
        assert_eq!(board.take_sent(), SILENCE);
        board.receive(&["5E"]);
        assert_eq!(board.take_sent().texts().len(), 1);
    }
}

#[test]
fn a_block_upload_does_not_go_on_after_a_halt_of_the_core() {
    for handler in handlers() {
        let device = device(ADDRESS).with_defaults(defaults(5));
        let mut board = Board::with_application(device, Label::new());
        board.pass_ms(1);
        board.take_sent();
        board.receive(&["605: A0 08 10 00 7F 00 00 00"]);
        assert!(board.take_sent().texts()[0].starts_with("585: C"));
        board.chip().is_bus_free = false;
        board.receive(&["605: A3 00 00 00 00 00 00 00"]);
        assert_eq!(board.chip().place.map(|(segment, _)| segment.data()[0]), Some(1));
        halt(&mut board, 2, handler);
        assert_eq!(board.take_sent(), SILENCE);
    }
}

#[test]
fn a_switch_starts_the_controller_at_the_new_rate_and_sends_nothing_meanwhile() {
    let mut board = Board::with_node_id();
    assert_eq!(board.take_starts(), [(Mode::TakePart, 1000)]);
    board.receive(&["04 01", "13 00 02"]);
    board.take_sent();
    board.chip().is_bus_free = false;
    board.receive(&["5E", "15 0A 00"]);
    assert_eq!(board.chip().place, None, "the answer is dropped");
    board.pass_ms(9);
    assert_eq!(board.take_starts(), []);
    board.pass_ms(2);
    assert_eq!(board.take_starts(), [(Mode::TakePart, 500)]);
    board.receive(&["5E"]);
    assert_eq!(board.chip().place, None);
    board.pass_ms(20);
    board.chip().is_bus_free = true;
    board.receive(&["5E"]);
    assert_eq!(board.take_sent().texts().len(), 1);
}

#[test]
fn a_controller_that_does_not_start_is_started_again() {
    let mut board = Board::with_node_id();
    board.receive(&["04 01", "13 00 03"]);
    board.chip().refused_starts = 3;
    board.take_starts();
    board.receive(&["15 00 00"]);
    board.pass_ms(1_250);
    assert_eq!(board.take_starts(), [(Mode::TakePart, 250); 3]);
}

/// A board that searches for the bit rate after an error.
fn searching() -> Board {
    searching_from(BitRate::Kbit1000)
}

fn searching_from(home: BitRate) -> Board {
    let device = device(ADDRESS).with_defaults(Settings::new(home.into())).with_rescue(true);
    let mut board = Board::new(device);
    board.pass_ms(1);
    assert_eq!(board.take_starts(), [(Mode::TakePart, home.kbit_per_s())]);
    board
}

#[test]
fn only_errors_that_tell_of_another_rate_begin_a_search() {
    for (error, begins) in [
        (BusError::Acknowledge, false),
        (BusError::BitDominant, false),
        (BusError::Stuff, true),
        (BusError::Crc, true),
        (BusError::Form, true),
        (BusError::BitRecessive, true),
    ] {
        let mut board = searching();
        board.handle_error(error);
        board.pass_ms(1);
        let listens = board.take_starts().iter().any(|(mode, _)| *mode == Mode::Listen);
        assert_eq!(listens, begins, "{error:?}");
    }
}

#[test]
fn traffic_without_a_frame_or_an_error_begins_a_search_unless_it_is_the_boards_own() {
    for is_transmitting in [false, true] {
        let mut board = searching();
        for ms in 0..100 {
            board.chip().sample = Sample { is_recessive: ms % 2 == 0, is_transmitting };
            board.pass_ms(1);
        }
        let listens = board.take_starts().iter().any(|(mode, _)| *mode == Mode::Listen);
        assert_eq!(listens, !is_transmitting);
    }
}

#[test]
fn a_bus_that_stays_dominant_ends_the_search() {
    let mut board = searching();
    board.handle_error(BusError::Stuff);
    assert_eq!(board.take_starts().last().map(|(mode, _)| *mode), Some(Mode::Listen));
    board.chip().sample = DOMINANT;
    board.pass_ms(20);
    assert_eq!(board.take_starts(), [(Mode::TakePart, 1000)]);
}

#[test]
fn a_listener_that_hears_nothing_of_a_dominant_bus_is_started_again() {
    let device = device(ADDRESS)
        .with_defaults(defaults(0xFF).with_bit_rate(canopen_node::BitRateSetting::Automatic));
    let mut board = Board::new(device.with_bit_rates(device.bit_rates.with_automatic()));
    assert_eq!(board.take_starts(), [], "it listens first");
    board.pass_ms(1);
    assert_eq!(board.take_starts(), [(Mode::Listen, 1000)]);
    board.pass_ms(250);
    assert_eq!(board.take_starts(), []);
    board.chip().sample = DOMINANT;
    board.pass_ms(250);
    assert_eq!(board.take_starts(), [(Mode::Listen, 1000)]);
    board.chip().received.push_back(Received::Overrun);
    board.runner.handle_received();
    board.pass_ms(250);
    assert_eq!(board.take_starts(), [], "it has heard something");
}

#[test]
fn the_last_error_code_of_a_controller_names_the_error() {
    use BusError::*;
    let errors = [Stuff, Form, Acknowledge, BitRecessive, BitDominant, Crc];
    for (code, error) in (1..).zip(errors) {
        assert_eq!(BusError::from_code(code), Some(error));
    }
    assert_eq!([0, 7, 255].map(BusError::from_code), [None; 3]);
}

#[test]
fn filters_get_the_cob_ids_in_full_lists() {
    let receives = Receives::<Count<0, 2, 3>> {
        all: false,
        services: [1, 2, 3, 4],
        rpdos: [5, 6],
        heartbeats: [7, 8, 9],
    };
    assert!(receives.lists().eq([[1, 2, 3, 4], [5, 6, 7, 8], [9, 9, 9, 9]]));
    assert!(receives.lists().eq([[1, 2, 3], [4, 5, 6], [7, 8, 9]]));
    assert_ne!(receives, Receives { all: true, ..receives });
    assert_ne!(receives, Receives { rpdos: [5, 7], ..receives });
}

#[test]
fn a_loss_of_the_settings_is_reported() {
    // A record of an unknown kind.
    let flash = testkit::settings::flash_with(&[(0, 0, testkit::settings::record(1, 2, 5, 2))]);
    let (mut log, found) = Storage::open_with_parameters(flash);
    let mut board = Board::with_node_id();
    let mut node: Node = Node::new(device(ADDRESS).with_defaults(defaults(5)), None);
    assert_eq!(runner::restore(&mut node, &mut log, found), Found::Damaged);
    board.runner = Runner::new(node, Handle(board.chip.clone()), Handle(board.chip.clone()));
    board.pass_ms(1);
    let sent = board.take_sent().texts();
    assert!(sent.iter().any(|text| text.starts_with("085: ")), "{sent:?}");
}

#[test]
fn a_command_to_reset_the_node_resets_the_device() {
    let mut board = Board::with_node_id();
    board.receive(&["000: 81 05"]);
    assert_eq!(board.chip().resets, 1);
}

#[test]
fn bus_off_and_the_recovery_are_reported() {
    let mut board = Board::with_node_id();
    board.chip().state = BusState::BusOff;
    board.runner.handle_status();
    board.chip().state = BusState::Good;
    board.pass_ms(250);
    let sent = board.take_sent();
    assert_eq!(sent, ["085: 40 81 11 00 00 00 00 00", "085: 00 00 00 00 00 00 00 00"]);
}

/// Polls the runner each millisecond, and returns the number of steps of the indicators.
fn run_ms(board: &mut Board, log: &mut Storage, ms: u32) -> usize {
    let mut steps = 0;
    for _ in 0..ms {
        steps += usize::from(board.runner.poll(log).lit.is_some());
        board.chip().now_us += 1000;
    }
    steps
}

#[test]
fn a_runner_that_is_polled_answers_stores_and_lights_its_indicators() {
    let mut board = Board::new(device(ADDRESS).with_defaults(defaults(0xFF)));
    let (mut log, _) = Storage::open_with_parameters(BoardFlash::blank(0));
    run_ms(&mut board, &mut log, 5);
    for (request, answer) in
        [("04 01", None), ("11 07", Some("11 00")), ("17", Some("17 00")), ("5E", Some("5E FF"))]
    {
        board.chip().received.push_back(Received::Frame(frames::request(request)));
        run_ms(&mut board, &mut log, 1);
        let sent = board.take_sent();
        assert_eq!(sent.texts().first().map(|text| &text[5..10]), answer, "{request}");
    }
    assert_eq!(log.settings().and_then(|settings| settings.node_id), NodeId::new(7));
    assert_eq!(run_ms(&mut board, &mut log, 1000), 20);
}

#[test]
fn the_runner_supervises_the_controller_four_times_a_second() {
    let mut board = Board::with_node_id();
    let (mut log, _) = Storage::open_with_parameters(BoardFlash::blank(0));
    board.receive(&["04 01", "13 00 03"]);
    board.take_starts();
    board.chip().refused_starts = 100;
    board.receive(&["15 00 00"]);
    run_ms(&mut board, &mut log, 1000);
    assert!((4..=5).contains(&board.take_starts().len()));
}

#[test]
fn a_runner_that_is_polled_sends_what_waited_for_the_bus() {
    let mut board = Board::with_node_id();
    let (mut log, _) = Storage::open_with_parameters(BoardFlash::blank(0));
    board.chip().is_bus_free = false;
    for request in ["04 01", "5E", "5A"] {
        board.chip().received.push_back(Received::Frame(frames::request(request)));
        run_ms(&mut board, &mut log, 1);
    }
    for _ in 0..2 {
        board.chip().complete();
        run_ms(&mut board, &mut log, 1);
    }
    assert_eq!(board.take_sent().texts().len(), 2);
}

#[test]
fn a_poll_says_when_the_next_one_is_due() {
    let mut board = Board::with_node_id();
    let (mut log, _) = Storage::open_with_parameters(BoardFlash::blank(0));
    board.receive(&["04 01", "13 00 02", "15 0A 00"]);
    let end_of_the_delay = board.chip().now_us + 10_000;
    board.take_starts();
    while board.chip().now_us < end_of_the_delay {
        let at = board.runner.poll(&mut log).at.as_micros();
        assert_eq!(board.take_starts(), []);
        board.chip().now_us = at;
    }
    _ = board.runner.poll(&mut log);
    assert_eq!(board.chip().now_us, end_of_the_delay);
    assert_eq!(board.take_starts(), [(Mode::TakePart, 500)]);
}

#[test]
fn bus_off_at_an_unproven_rate_begins_to_listen() {
    let mut board = searching();
    board.chip().state = BusState::BusOff;
    board.runner.handle_status();
    assert!(board.runner.is_bus_off());
    assert_eq!(board.take_starts(), [(Mode::Listen, 1000)]);
}

#[test]
fn the_controller_filters_frames_once_the_rate_is_proven() {
    let mut board = searching();
    board.receive(&["04 00"]);
    assert_eq!(board.chip().receives_all, [false]);
}

#[test]
fn a_frame_that_was_found_by_listening_counts_where_it_was_found() {
    let mut board = searching();
    board.handle_error(BusError::Stuff);
    board.handle_error(BusError::Form);
    board.take_starts();
    // The stay has ended, but nobody has looked.
    board.chip().now_us += 100_000;
    board.receive(&["04 00"]);
    assert_eq!(board.take_starts(), [(Mode::TakePart, 800)]);
}

#[test]
fn the_next_segments_of_an_upload_are_made_when_those_before_have_left() {
    let device = device(ADDRESS).with_defaults(defaults(5));
    let device = device.with_name("a name that takes four segments");
    let mut board = Board::with_application(device, Label::new());
    board.pass_ms(1);
    board.receive(&["605: A0 08 10 00 7F 00 00 00"]);
    board.take_sent();
    board.chip().is_bus_free = false;
    board.receive(&["605: A3 00 00 00 00 00 00 00"]);
    board.pass_ms(200);
    board.chip().complete();
    board.runner.handle_transmitted();
    board.receive(&["605: 80 08 10 00 00 00 00 00"]);
    board.free_bus();
    let sent = board.take_sent().texts();
    assert_eq!(sent.iter().map(|text| &text[..7]).collect::<Vec<_>>(), ["585: 01", "585: 02"]);
}

/// The number of changes of RUN in the next 2 s, as long as `goes_on`; and the number of steps.
fn changes_of_run(board: &mut Board, goes_on: impl Fn(&Board) -> bool) -> (usize, usize) {
    let mut steps = Vec::new();
    while steps.len() < 40 && goes_on(board) {
        board.chip().now_us += 1000;
        steps.extend(board.runner.handle_alarm().map(|lit| lit.run));
    }
    (steps.windows(2).filter(|pair| pair[0] != pair[1]).count(), steps.len())
}

#[test]
fn the_indicators_flicker_while_configured_listening_or_without_node_id() {
    let mut board = Board::with_node_id();
    let (changes, steps) = changes_of_run(&mut board, |_| true);
    assert!(changes <= 10 && steps == 40, "it blinks in NMT pre-operational");
    board.receive(&["04 01"]);
    assert_eq!(changes_of_run(&mut board, |_| true), (39, 40), "LSS configuration state");
    assert_eq!(changes_of_run(&mut searching(), |_| true), (39, 40), "without a node-ID");

    let device = device(ADDRESS).with_defaults(defaults(5)).with_rescue(true);
    let mut board = Board::new(device);
    board.chip().is_bus_free = false;
    board.pass_ms(1);
    board.handle_error(BusError::Stuff);
    let (changes, steps) = changes_of_run(&mut board, |board| board.runner.node().is_listening());
    assert!(steps > 10 && changes == steps - 1, "{changes} changes in {steps} steps");
}

#[test]
fn what_an_application_asks_the_runner_for_is_done_at_once() {
    let mut board = operational("00");
    board.chip().is_bus_free = true;
    assert!(board.runner.is_idle() && !board.runner.is_bus_off());
    assert!(board.runner.with(|node| node.report(0x4310, 0x08, [1, 2, 3, 4, 5])));
    board.runner.handle_transmitted();
    assert!(!board.runner.with(|node| node.report(0, 0x08, [0; 5])));
    board.runner.with(|node| node.end_report(0x4310));
    board.runner.with(|node| node.send_tpdo(1));
    assert_eq!(
        board.take_sent(),
        ["085: 10 43 09 01 02 03 04 05", "085: 00 00 00 00 00 00 00 00", "185: 00 00 00"]
    );
    board.chip().is_bus_free = false;
    board.runner.with(|node| node.send_tpdo(1));
    assert!(!board.runner.is_idle(), "a frame waits");
}

#[test]
fn a_device_that_cannot_store_refuses_with_its_reason() {
    let mut board = operational("00");
    board.chip().is_bus_free = true;
    for (error, answer) in [(StoreError::NotSupported, "17 01"), (StoreError::Full, "17 02")] {
        board.receive(&["04 01", "17"]);
        board.runner.refuse_store(error);
        assert_eq!(board.take_sent(), [answer]);
    }
}

#[test]
fn a_controller_with_room_gets_only_what_is_more_urgent_than_the_queue() {
    let mut board = operational("00");
    // The second answer waits in the queue, and another place of the controller becomes free.
    board.receive(&["605: 40 00 10 00 00 00 00 00", "605: 40 18 10 01 00 00 00 00"]);
    let in_controller = |board: &Board<Machine>| {
        let frame = board.chip().place.take();
        frame.map(|(frame, _)| frame.cob_id())
    };
    assert_eq!(in_controller(&board), Some(0x585));
    board.receive(&["04 01", "5A", "605: 40 18 10 02 00 00 00 00"]);
    assert_eq!(in_controller(&board), None, "neither 7E4h nor 585h is more urgent than 585h");
    board.runner.with(|node| node.report(0x4310, 0, [0; 5]));
    assert_eq!(in_controller(&board), Some(0x085));
    board.runner.handle_transmitted();
    board.free_bus();
    let ids: Vec<_> = board.take_sent().0.iter().map(Frame::cob_id).collect();
    assert_eq!(ids, [0x585, 0x585, 0x7E4]);
}

#[test]
fn a_heartbeat_and_a_pdo_wait_once_and_the_pdo_with_its_latest_values() {
    let mut board = operational("00");
    // It takes the place in the controller.
    board.receive(&["605: 40 00 10 00 00 00 00 00"]);
    for level in 1..4 {
        board.runner.application(|machine| machine.level = level);
    }
    board.free_bus();
    let sent = board.take_sent();
    assert_eq!(sent.0.len(), 2, "{sent:?}");
    assert_eq!(sent.texts()[1], "185: 00 03 00");
}

#[test]
fn traffic_that_ends_in_frames_begins_no_search() {
    for understands in [true, false] {
        let mut board = searching();
        board.chip().is_bus_free = false;
        for ms in 0..500 {
            board.chip().sample = Sample { is_recessive: ms % 2 == 0, is_transmitting: false };
            board.pass_ms(1);
            if understands && ms % 10 == 0 {
                board.chip().received.push_back(Received::Overrun);
                board.runner.handle_received();
            }
        }
        let listens = board.take_starts().iter().any(|(mode, _)| *mode == Mode::Listen);
        assert_eq!(listens, !understands);
    }
}

/// The number of alarms in the next second, with this level of the bus at the indicators' steps, every 50 ms.
fn alarms_of_a_second(board: &mut Board, is_recessive: impl Fn(u32) -> bool) -> usize {
    let mut alarms = 0;
    for ms in 0..1_000 {
        board.chip().sample = Sample { is_recessive: is_recessive(ms), is_transmitting: false };
        let next_us = board.chip().now_us + 1000;
        alarms += usize::from(board.chip().alarm_at_us <= next_us);
        board.pass_ms(1);
    }
    alarms
}

#[test]
fn the_bus_is_sampled_while_its_rate_is_not_proven_and_it_is_not_idle() {
    let mut board = searching();
    board.pass_ms(200);
    assert_eq!(alarms_of_a_second(&mut board, |_| true), 20, "the steps of the indicators");
    assert!(board.take_starts().is_empty());
    assert!(alarms_of_a_second(&mut board, |ms| ms % 2 == 1) > 25);
    assert_eq!(board.take_starts().first(), Some(&(Mode::Listen, 800)), "it was dominant");

    let mut board = Board::with_node_id();
    board.receive(&["04 00"]);
    board.handle_error(BusError::Stuff);
    assert_eq!(alarms_of_a_second(&mut board, |ms| ms % 2 == 1), 20, "a proven rate");
}

#[test]
fn while_the_bus_is_sampled_the_controller_is_asked_for_the_next_error() {
    let mut board = searching();
    board.handle_error(BusError::Stuff);
    board.chip().asked_for_errors = 0;
    board.pass_ms(10);
    let asked = board.chip().asked_for_errors;
    assert!((8..=11).contains(&asked), "{asked} times in 10 ms");
}

#[test]
fn samples_are_a_millisecond_apart_whoever_calls() {
    let mut board = searching();
    board.handle_error(BusError::Stuff);
    board.take_starts();
    board.chip().sample = DOMINANT;
    (0..100).for_each(|_| _ = board.runner.handle_alarm());
    assert_eq!(board.take_starts(), []);
}

#[test]
fn two_frame_times_of_traffic_without_a_frame_begin_a_search() {
    // The frames take 270 bits, at 1 Mbit/s no whole millisecond.
    for (bit_rate, two_frames_ms) in [(BitRate::Kbit1000, 0), (BitRate::Kbit10, 27)] {
        let mut board = searching_from(bit_rate);
        for ms in 0.. {
            board.chip().sample = Sample { is_recessive: ms % 2 == 0, is_transmitting: false };
            board.pass_ms(1);
            if !board.take_starts().is_empty() {
                break;
            }
        }
        // The gap between frames and two milliseconds more.
        assert_eq!(board.chip().now_us / 1000, 16 + 2 + two_frames_ms + 1);
    }
}

#[test]
fn answers_that_a_program_holds_or_keeps_are_given_at_once() {
    let device = device(ADDRESS).with_defaults(defaults(5));
    let mut board = Board::with_application(device, Loader::new());
    board.pass_ms(1);
    board.take_sent();
    board.runner.application(|loader| loader.set_full(true));
    board.receive(&["605: 21 50 1F 01 07 00 00 00", "605: 01 01 02 03 04 05 06 07"]);
    assert_eq!(board.take_sent(), ["585: 60 50 1F 01 00 00 00 00"]);
    board.runner.application(|loader| loader.set_full(false));
    board.runner.with(Node::resume);
    assert_eq!(board.take_sent(), SILENCE, "the program keeps the answer to the last part");
    board.runner.answer(Ok(()));
    assert_eq!(board.take_sent(), ["585: 20 00 00 00 00 00 00 00"]);
}

#[test]
fn the_newest_value_of_a_tpdo_leaves_whatever_its_cob_id_and_an_lss_answer_before_it() {
    let mut board = operational("00");
    board.chip().is_bus_free = true;
    board.receive(&["000: 80 05", "605: 23 00 18 01 85 01 00 80"]);
    board.receive(&["605: 23 00 18 01 F0 00 00 00", "000: 01 05", "04 01"]);
    board.pass_ms(1);
    board.take_sent();
    board.chip().is_bus_free = false;
    for level in 1..=40 {
        board.runner.application(|machine| machine.level = level);
    }
    board.receive(&["5A"]);
    board.free_bus();
    let sent = board.take_sent().texts();
    assert_eq!(sent[0], "0F0: 00 01 00", "it was in the controller");
    assert!(sent[1].starts_with("7E4: 5A"), "{sent:?}");
    assert_eq!(sent[2..], ["0F0: 00 28 00"]);
}

#[test]
fn bus_off_that_stops_the_node_is_reported() {
    let mut board = operational("00");
    board.chip().is_bus_free = true;
    board.receive(&["605: 2F 29 10 01 02 00 00 00"]);
    board.take_sent();
    board.chip().state = BusState::BusOff;
    board.runner.handle_status();
    board.chip().state = BusState::Good;
    board.runner.handle_status();
    board.pass_ms(2);
    assert_eq!(board.take_sent(), ["705: 04", "085: 40 81 11 00 00 00 00 00"]);
}

#[test]
fn a_heartbeat_of_another_state_does_not_leave_and_one_of_the_new_state_does() {
    for (end, state) in [("000: 80 05", "705: 7F"), ("000: 02 05", "705: 04")] {
        let mut board = operational("00");
        board.pass_ms(100);
        assert_eq!(board.chip().place.map(|(frame, _)| frame.cob_id()), Some(0x705));
        board.receive(&[end]);
        board.runner.handle_transmitted();
        board.free_bus();
        assert_eq!(board.take_sent(), [state]);
    }
}

#[test]
fn nothing_leaves_in_stopped_that_it_forbids() {
    let mut board = operational("00");
    board.receive(&["605: 40 00 10 00 00 00 00 00"]);
    board.runner.with(|node| node.report(0xFF00, 0, [0; 5]));
    board.runner.application(|machine| machine.level = 7);
    board.receive(&["000: 02 05"]);
    board.free_bus();
    board.chip().is_bus_free = true;
    board.pass_ms(200);
    assert_eq!(board.take_sent(), ["705: 04", "705: 04"]);
    board.receive(&["000: 80 05"]);
    board.pass_ms(1);
    assert_eq!(board.take_sent(), ["085: 00 FF 01 00 00 00 00 00"]);
}

#[test]
fn an_emergency_waits_until_the_boot_up_itself_was_acknowledged() {
    let mut board = Board::new(device(ADDRESS).with_defaults(defaults(5)));
    board.chip().is_bus_free = false;
    board.pass_ms(1);
    // Another place becomes free.
    let boot_up = board.chip().place.take();
    board.runner.with(|node| node.handle_fault(Fault::SettingsLost));
    board.receive(&["605: 40 00 10 00 00 00 00 00", "04 01", "5E"]);
    board.free_bus();
    board.pass_ms(10);
    let begins =
        |sent: Frames| sent.texts().iter().map(|text| text[..7].into()).collect::<Vec<String>>();
    assert_eq!(begins(board.take_sent()), ["585: 43", "7E4: 5E"]);
    board.chip().place = boot_up;
    board.free_bus();
    assert_eq!(begins(board.take_sent()), ["705: 00", "085: 10"]);
}

/// Whoever empties the controller and the queue tells every service.
#[test]
fn what_a_halt_of_the_core_has_dropped_is_made_again_by_each_service_that_still_needs_it() {
    type Make = fn(&mut Board<Machine>);
    let cases: [(&str, Make, Option<&str>); 6] = [
        ("boot-up", |board| board.receive(&["000: 82 05"]), Some("705: 00")),
        (
            "emergency",
            |board| {
                board.runner.with(|node| node.report(0xFF00, 0, [0; 5]));
            },
            Some("085: 00 FF 01 00 00 00 00 00"),
        ),
        ("heartbeat", |board| board.pass_ms(100), Some("705: 05")),
        (
            "TPDO",
            |board| board.runner.application(|machine| machine.level = 7),
            Some("185: 00 07 00"),
        ),
        ("SDO", |board| board.receive(&["605: 40 00 10 00 00 00 00 00"]), None),
        ("LSS", |board| board.receive(&["04 01", "5E"]), None),
    ];
    for (service, make, again) in cases {
        let mut board = operational("00");
        make(&mut board);
        let lost = board.chip().place.map(|(frame, _)| frames::text(&frame)).expect(service);
        board.chip().now_us += 2_000_000;
        board.chip().is_bus_free = true;
        board.runner.handle_alarm();
        board.pass_ms(2);
        let sent = board.take_sent().texts();
        match again {
            Some(again) => assert!(sent.iter().any(|text| text == again), "{service}: {sent:?}"),
            None => assert!(!sent.contains(&lost), "{service}: the master no longer waits"),
        }
    }
}
