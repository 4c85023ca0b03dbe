//! A test rig for the release image: emulated boards and an LSS master on one bus, with checks of the boards'
//! behaviour.

use std::ops::Range;

use canopen_node::{BitRate, BitRateSetting, NodeId, Settings, lss, settings::Log};
use emulator::{
    Time, board,
    can::{Adapter, Frame, Id},
    network::{AdapterId, Event, Network, Short, Source, What},
};
use lss_master::{Master, Procedure};

#[cfg(feature = "log")]
use super::log;
use super::{
    flash::BoardFlash,
    frames::{self, Frames},
    image::{Firmware, PART, example},
    lss_session,
    sdo::{self, Client},
    settings::Stored,
    unmodelled,
    wire::{bit_per_s, from_the_wire, on_the_wire},
};

/// The bit rate of the image on a board with blank flash: `DEFAULTS` of src/device.rs.
pub const DEFAULT_BIT_RATE: BitRate = BitRate::Kbit125;
/// The offset of the settings log in the flash, as in memory.x.
pub const SETTINGS_OFFSET: u32 = 0x4000;
/// The length of the settings log in bytes: sectors 1 and 2.
pub const SETTINGS_LENGTH: usize = 0x8000;
/// The length of a place in the log of the settings.
pub const PLACE: usize = 40;
/// The core clock of the image in MHz.
pub const CORE_MHZ: u64 = 160;
/// The wait for an answer after its request, in addition to the frame's own time.
const PATIENCE: Time = Time::from_ms(5);
/// The time in which a board joins the bus after power-on, even if its flash is slow and two sectors must be erased by bytes
/// first, and the crystal is in the other mode.
pub const BOOT: Time = Time::from_ms(1_900);
/// The interval between questions to a node that may be away.
const POLL: Time = Time::from_ms(20);
/// More bits than any frame, intermission included.
const FRAME_BITS: u64 = 160;

/// Boards with the release image, and the LSS master's adapter. A run ends in a panic if a board misuses its chip, locks
/// up, is reset unexpectedly, or does not do what is waited for.
pub struct ImageRig {
    pub network: Network,
    pub master: AdapterId,
    bit_rate: BitRate,
    lss: Master,
}

/// A frame that was on the bus.
#[derive(Clone, Copy, Debug)]
pub struct Sent {
    pub by: Source,
    pub frame: Frame,
    pub start: Time,
    pub end: Time,
}

/// A board with a blank settings flash; boards with different `number` have different serial numbers.
pub fn blank_board(firmware: Firmware, number: u8) -> board::Board {
    let settings = board::Settings { unique_id: [number; 12], ..Default::default() };
    board::Board::new(PART, firmware.image(), settings)
}

/// A board with stored `settings`.
pub fn board_with(firmware: Firmware, number: u8, settings: Stored) -> board::Board {
    let mut board = blank_board(firmware, number);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings]));
    board
}

/// A board with the image of the example `io` and stored `settings`.
pub fn example_board(settings: Stored) -> board::Board {
    let mut board = board::Board::new(PART, example(), board::Settings::default());
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings]));
    board
}

/// The content of the settings' flash after the start of a new board and these stores: the next start writes nothing.
pub fn flash_with(stores: &[Stored]) -> Vec<u8> {
    let (mut log, _) = Log::<_, 8>::open_with_parameters(BoardFlash::blank(0));
    stores.iter().for_each(|stored| stored.store(&mut log));
    log.close().content()
}

/// Settings without a heartbeat; node-ID FF: not configured.
pub fn settings(node_id: u8, bit_rate: impl Into<BitRateSetting>) -> Stored {
    let node_id = NodeId::from_lss(node_id).expect("1..=127 or FF");
    Settings::new(bit_rate.into()).with_node_id(node_id).into()
}

/// Whether a board has set its bit timing and then joined the bus, by its events since power-on or reset.
pub fn has_joined<'a>(events: impl Iterator<Item = &'a Event>) -> bool {
    let mut events = events.skip_while(|event| !matches!(event.what, What::BitTiming { .. }));
    events.any(|event| event.what == What::InitializationLeft)
}

/// A frame that a node has sent.
fn of_node(frame: &Frame) -> canopen_node::Frame {
    from_the_wire(frame).unwrap_or_else(|| panic!("a node does not send {frame}"))
}

impl ImageRig {
    /// Powers these boards on, with the master at `bit_rate`, and lets them boot.
    pub fn new(bit_rate: BitRate, boards: impl IntoIterator<Item = board::Board>) -> Self {
        let mut network = Network::new();
        network.forbid_misuse();
        let master = network.add_adapter(Adapter::new(bit_per_s(bit_rate)));
        let lss = Master::new(lss_session::timing(bit_rate));
        let mut rig = Self { network, master, bit_rate, lss };
        for board in boards {
            rig.network.add_board(board);
        }
        for board in 0..rig.network.boards().len() {
            rig.boot(board, Time::ZERO);
        }
        rig
    }

    /// A board that is being switched on, without the master on the bus.
    pub fn unattended(board: board::Board) -> Self {
        let mut rig = Self::new(DEFAULT_BIT_RATE, []);
        // Its errors would make the board search for another rate.
        rig.network.adapter_mut(rig.master).close();
        rig.network.add_board(board);
        rig
    }

    /// Takes the master off the bus, and cuts the supply of the only board for 10 ms.
    pub fn restart_unattended(&mut self) {
        self.network.adapter_mut(self.master).close();
        self.network.power_off(0);
        self.network.run_for(Time::from_ms(10));
        self.network.power_on(0);
    }

    /// Puts the master on the bus of an unattended board at the rate that the board sets; `None` if its power fails
    /// before.
    pub fn join(&mut self) -> Option<BitRate> {
        let (since, _) = *self.network.board(0).resets().last().expect("it was switched on");
        while !has_joined(self.did(0, since)) {
            assert!(self.network.now() < since + BOOT, "the board does not come to the bus");
            self.network.run_for(Time::from_ms(1));
            if !self.network.board(0).is_powered() {
                return None;
            }
        }
        let (_, first) = self.bit_rates(0, since)[0];
        let rate = BitRate::ALL.into_iter().find(|rate| bit_per_s(*rate) == first);
        self.set_master_bit_rate(rate.expect("a bit rate of CiA 301"));
        self.network.adapter_mut(self.master).open();
        rate
    }

    /// Waits until a board that was powered on or reset after `since` has joined the bus.
    pub fn boot(&mut self, board: usize, since: Time) {
        let until = self.network.now() + BOOT;
        while !has_joined(self.did(board, since)) {
            assert!(self.network.now() < until, "board {board} does not come to the bus");
            self.network.run_for(Time::from_ms(1));
        }
    }

    /// Cuts the supply of a board for 10 ms and lets it boot.
    pub fn power_cycle(&mut self, board: usize) {
        self.network.power_off(board);
        self.network.run_for(Time::from_ms(10));
        self.power_on(board);
    }

    /// Restores the supply of a board and lets it boot.
    pub fn power_on(&mut self, board: usize) {
        let since = self.network.now();
        self.network.power_on(board);
        self.boot(board, since);
    }

    /// Sends requests of the LSS master, `11 05, 17`; returns the frames that the boards send within 5 ms after each.
    pub fn lss(&mut self, requests: &str) -> Frames {
        let exchange = |request| self.exchange(on_the_wire(&frames::request(request))).0;
        Frames(requests.split(", ").flat_map(exchange).collect())
    }

    /// Sends an NMT command; returns the frames that the boards send within 5 ms.
    pub fn nmt(&mut self, command: &str) -> Frames {
        self.exchange(on_the_wire(&frames::command(command)))
    }

    fn exchange(&mut self, frame: Frame) -> Frames {
        self.transmit(frame);
        let span = PATIENCE + self.bit_time() * FRAME_BITS;
        self.collect(span)
    }

    /// Sends an NMT command; returns the time of its end on the bus.
    pub fn transmit_command(&mut self, command: &str) -> Time {
        self.transmit(on_the_wire(&frames::command(command)))
    }

    /// Sends a request of the LSS master; returns the time of its end on the bus.
    pub fn transmit_request(&mut self, request: &str) -> Time {
        self.transmit(on_the_wire(&frames::request(request)))
    }

    /// Sends activate bit timing; returns the time of its end on the bus.
    pub fn activate(&mut self, delay_ms: u16) -> Time {
        let [low, high] = delay_ms.to_le_bytes();
        self.transmit_request(&format!("15 {low:02X} {high:02X}"))
    }

    /// Sends a frame from the master within a second; returns the time of its end on the bus.
    pub fn transmit(&mut self, frame: Frame) -> Time {
        let from = self.network.now();
        self.network.send(self.master, frame);
        let sent = |event: &Event| matches!(event.what, What::Frame { frame: f, .. } if f == frame);
        while self.network.now() < from + Time::from_s(1) {
            self.network.run_for(Time::from_us(10));
            let mut since = self.network.trace().iter().rev().take_while(|event| event.time > from);
            if let Some(event) = since.find(|event| sent(event)) {
                return event.time;
            }
        }
        panic!("{frame} does not get through");
    }

    /// Queues frames of the master, such as `04 01, 5E` or `000: 81 05`.
    pub fn send(&mut self, texts: &str) {
        texts.split(", ").for_each(|text| self.queue(&frames::of_master(text)));
    }

    /// Sends requests of the LSS master, and expects only these answers, `11 00, 17 00`, beside other services.
    pub fn ask(&mut self, requests: &str, answers: &str) {
        let mut frames = self.lss(requests);
        frames.0.retain(|frame| frame.cob_id() == lss::RESPONSE_COB_ID);
        let expected: Vec<_> = answers.split(", ").collect();
        assert_eq!(frames, expected.as_slice(), "to {requests}");
    }

    /// Carries out a procedure of the LSS master, without an error.
    pub fn carry_out<P: Procedure>(&mut self, procedure: P) -> P::Output {
        lss_session::carry_out(&mut self.network, self.master, &mut self.lss, procedure)
            .unwrap_or_else(|error| panic!("{error}"))
    }

    /// Waits until the master receives a frame that `is_it`, for at most `limit`; returns it with its time.
    pub fn wait_for(
        &mut self,
        limit: Time,
        is_it: impl Fn(&canopen_node::Frame) -> bool,
    ) -> Option<(Time, canopen_node::Frame)> {
        let until = self.network.now() + limit;
        loop {
            let left = until.saturating_sub(self.network.now());
            let (time, frame) = self.network.run_until_received(self.master, left)?;
            let frame = of_node(&frame);
            if is_it(&frame) {
                return Some((time, frame));
            }
        }
    }

    /// Waits for a frame of a node, such as `705: 00`, which must come within `limit`; returns its time.
    pub fn expect(&mut self, text: &str, limit: Time) -> Time {
        let expected = frames::of_node(text);
        let received = self.wait_for(limit, |frame| *frame == expected);
        received.unwrap_or_else(|| panic!("{text} is not received in {} ms", limit.as_ms())).0
    }

    /// Sends a request every 20 ms until the answer is as expected, which must be within `limit`.
    pub fn reach(&mut self, request: &str, answer: &str, limit: Time) {
        let (request, answer) = (frames::of_master(request), frames::of_node(answer));
        let time = self.poll_until(&request, limit, |frame| *frame == answer);
        assert!(time.is_some(), "no {} in {} ms", frames::text(&answer), limit.as_ms());
        self.collect(Time::from_ms(50));
    }

    /// Sends a request every 20 ms until a frame comes that `is_answer`; returns the time taken, or `None` after `limit`.
    pub fn poll_until(
        &mut self,
        request: &canopen_node::Frame,
        limit: Time,
        is_answer: impl Fn(&canopen_node::Frame) -> bool,
    ) -> Option<Time> {
        let from = self.network.now();
        while self.network.now() < from + limit {
            if self.network.adapter_mut(self.master).unsent() == 0 {
                self.queue(request);
            }
            if let Some((time, _)) = self.wait_for(POLL, &is_answer) {
                return Some(time - from);
            }
        }
        None
    }

    /// Queues a frame in the master, which sends it as soon as the bus allows.
    pub fn queue(&mut self, frame: &canopen_node::Frame) {
        self.network.send(self.master, on_the_wire(frame));
    }

    /// Waits until the master has sent all that is queued.
    pub fn send_all(&mut self) {
        while self.network.adapter_mut(self.master).unsent() > 0 {
            self.network.run_for(Time::from_us(200));
        }
    }

    /// Short-circuits the bus for `span`.
    pub fn short_circuit(&mut self, short: Short, span: Time) {
        self.network.set_short(Some(short));
        self.network.run_for(span);
        self.network.set_short(None);
    }

    /// The errors that the nodes have detected.
    pub fn errors(&self) -> Vec<&Event> {
        let is_error = |event: &&Event| matches!(event.what, What::Error { .. });
        self.network.trace().iter().filter(is_error).collect()
    }

    /// Adds two nodes that acknowledge each other's frames.
    pub fn add_others(&mut self, bit_rate: BitRate) -> [AdapterId; 2] {
        [(); 2].map(|()| self.network.add_adapter(Adapter::new(bit_per_s(bit_rate))))
    }

    /// The log of a board, after the next look of its probe.
    #[cfg(feature = "log")]
    pub fn log(&mut self, board: usize) -> Vec<log::LogLine> {
        self.network.run_for(board::LOG_POLL);
        log::lines(self.network.board(board))
    }

    /// Whether a line of the first board's log begins with `text`.
    #[cfg(feature = "log")]
    pub fn has_logged(&mut self, text: &str) -> bool {
        self.log(0).iter().any(|line| line.text.starts_with(text))
    }

    #[cfg(feature = "log")]
    fn print_logs(&self) {
        for (number, board) in self.network.boards().iter().enumerate() {
            for line in log::lines(board) {
                eprintln!("board {number}, {} ms: {} {}", line.time, line.level, line.text);
            }
        }
    }

    /// The frames that the master receives within `span`.
    pub fn collect(&mut self, span: Time) -> Frames {
        self.network.run_for(span);
        let mut received = Vec::new();
        while let Some((_, frame)) = self.network.receive(self.master) {
            received.push(of_node(&frame));
        }
        Frames(received)
    }

    /// The next frame that the master receives within a second, and its time.
    pub fn next_frame(&mut self) -> (Time, Frames) {
        match self.network.run_until_received(self.master, Time::from_s(1)) {
            Some((time, frame)) => (time, Frames(vec![of_node(&frame)])),
            None => (self.network.now(), Frames(Vec::new())),
        }
    }

    /// A client of the SDO server of the node `node_id`, which is the master.
    pub fn sdo_client(&mut self, node_id: u8) -> SdoClient<'_> {
        SdoClient { rig: self, node_id }
    }

    /// The share of a span in which frames, with the intermissions of three bits, are on the bus, in percent.
    pub fn bus_load(&self, span: Range<Time>) -> u64 {
        let intermission = self.bit_time() * 3;
        let events = self.network.trace().iter().filter(|event| span.contains(&event.time));
        let busy = events.filter_map(|event| match event.what {
            What::Frame { start, .. } => Some((event.time + intermission - start).as_ps()),
            _ => None,
        });
        busy.sum::<u64>() * 100 / (span.end - span.start).as_ps()
    }

    /// Adds a node at a bit rate that no other node uses, disconnected from the bus.
    pub fn add_disturber(&mut self) -> AdapterId {
        let disturber = self.network.add_adapter(Adapter::new(333_000));
        self.network.adapter_mut(disturber).close();
        disturber
    }

    /// Replaces the master on the bus by the disturber for `span`, which queues a frame at each interval of `every`.
    pub fn disturb(&mut self, disturber: AdapterId, id: Id, every: Time, span: Time) {
        self.network.adapter_mut(self.master).close();
        self.network.adapter_mut(disturber).open();
        let until = self.network.now() + span;
        while self.network.now() < until {
            self.network.send(disturber, Frame::data(id, &[0xA5; 8]));
            self.network.run_for(every);
        }
        self.network.adapter_mut(disturber).close();
        self.network.adapter_mut(self.master).open();
    }

    /// Sets the master's bit rate.
    pub fn set_master_bit_rate(&mut self, bit_rate: BitRate) {
        self.bit_rate = bit_rate;
        self.lss = Master::new(lss_session::timing(bit_rate));
        self.network.adapter_mut(self.master).set_bit_rate(bit_per_s(bit_rate));
    }

    /// The duration of a bit at the master's rate.
    pub fn bit_time(&self) -> Time {
        Time::from_ps(1_000_000_000 / u64::from(self.bit_rate.kbit_per_s()))
    }

    /// The frames that began on the bus at `since` or later.
    pub fn sent(&self, since: Time) -> impl Iterator<Item = Sent> {
        let sent = move |event: &Event| match event.what {
            What::Frame { frame, start, .. } if start >= since => {
                Some(Sent { by: event.source, frame, start, end: event.time })
            }
            _ => None,
        };
        self.network.trace().iter().filter_map(sent)
    }

    /// Those of boards among them.
    pub fn sent_by_boards(&self, since: Time) -> impl Iterator<Item = Sent> {
        self.sent(since).filter(|sent| matches!(sent.by, Source::Board(_)))
    }

    /// The events of a board since `since`.
    pub fn did(&self, board: usize, since: Time) -> impl Iterator<Item = &Event> {
        let of_board =
            move |event: &&Event| event.source == Source::Board(board) && event.time >= since;
        self.network.trace().iter().filter(of_board)
    }

    /// The transmission requests of a board since `since`: time and frame.
    pub fn requested(&self, board: usize, since: Time) -> impl Iterator<Item = (Time, Frame)> {
        self.did(board, since).filter_map(|event| match event.what {
            What::Requested { frame, .. } => Some((event.time, frame)),
            _ => None,
        })
    }

    /// The bit rate changes of a board since `since`: their time and the new rate in bit/s.
    pub fn bit_rates(&self, board: usize, since: Time) -> Vec<(Time, u32)> {
        let changes = self.did(board, since).filter_map(|event| match event.what {
            What::BitTiming { bit_rate, .. } => Some((event.time, bit_rate)),
            _ => None,
        });
        changes.collect()
    }
}

/// The master as a client of the SDO server of one node. It answers at once.
pub struct SdoClient<'a> {
    rig: &'a mut ImageRig,
    node_id: u8,
}

impl Client for SdoClient<'_> {
    fn say(&mut self, messages: &[[u8; 8]], is_last: impl Fn(&[u8; 8]) -> bool) -> Vec<[u8; 8]> {
        for message in messages {
            self.rig.queue(&sdo::of_client(self.node_id, message));
        }
        let mut answers = Vec::new();
        while !answers.last().is_some_and(&is_last) {
            let frame = self.rig.next_frame().1.0.pop().expect("an answer");
            answers.extend(sdo::of_server(self.node_id, &frame));
        }
        answers
    }

    fn confirm(&mut self, message: [u8; 8]) {
        self.rig.transmit(on_the_wire(&sdo::of_client(self.node_id, &message)));
    }
}

impl Drop for ImageRig {
    /// Prints which peripherals are not modelled and, behind a failure, the logs of the boards. `cargo test` shows it
    /// for a test that fails, and for all with `-- --nocapture`.
    fn drop(&mut self) {
        for (number, board) in self.network.boards().iter().enumerate() {
            for line in unmodelled::report(board) {
                println!("board {number}: {line}");
            }
        }
        #[cfg(feature = "log")]
        if std::thread::panicking() {
            self.print_logs();
        }
    }
}
