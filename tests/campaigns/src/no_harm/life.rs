//! One run of a situation with one image: the boards go through its events, then the master looks for them.

use canopen_node::{BitRate, NodeId, Settings, lss::Request};
use emulator::{
    Time,
    board::{self, Board},
    can::{Adapter, Clock, Frame, Id},
    chip::{Part, ResetCause},
    image::Image,
    network::{self, AdapterId, Network, Noise, Source},
};

use super::situation::{
    Foreign, Master, Node, Probe, SWITCH_LEAD_MS, Situation, Traffic, What, configure, ms,
};
use testkit::{
    boards::Variant,
    image_rig::{SETTINGS_LENGTH, SETTINGS_OFFSET},
    log::{self, LogLine},
    random::Random,
    settings::Stored,
    wire::{bit_per_s, on_the_wire},
};

/// The interval between questions to a board that is looked for.
pub const POLL: Time = Time::from_ms(20);
/// The boards' crystal deviations in ppm.
const PPM: [i32; 8] = [0, 30, -40, 15, -25, 50, -10, 5];
/// The number of frames that a foreign device sends at once, unless it sends one a second; as many more may wait.
const BURST: usize = 4;
/// The length of a long frame with its intermission, in bits.
pub const FRAME_BITS: u64 = 130;

/// The bus and its stations at an instant.
pub struct Life<'a> {
    situation: &'a Situation,
    network: Network,
    master: AdapterId,
    mode: Master,
    /// For each event, its adapters if it is a foreign device.
    foreign: Vec<Vec<AdapterId>>,
    talkers: Vec<Talker>,
    random: Random,
    /// The end of the silent time of the last switch that each board took part in, since its last power-on.
    switched: Vec<Option<Time>>,
}

/// A repeated sender.
#[derive(Clone, Copy)]
struct Talker {
    /// The event that made it a foreign device; `None`: the master.
    event: Option<usize>,
    every: Time,
    /// The time of its next frame.
    next: Time,
}

/// An action at an instant.
enum Step {
    Begin(usize),
    End(usize),
    /// A request of the LSS master.
    Send(Request),
    /// Records which boards have switched to the rate.
    Switched(BitRate),
}

/// The fate of a board from the start of the probe on.
#[derive(Clone, Copy, Debug, Default)]
pub struct Seen {
    /// The time until its first answer, heartbeat or emergency message.
    pub reached: Option<Time>,
    /// The time until its first answer or heartbeat.
    pub answered: Option<Time>,
}

impl Seen {
    /// The time by which an equal board must be received: when a heartbeat or a pending emergency message comes depends
    /// on chance, that of an answer does not.
    pub fn sign_of_life(&self, node: Node, probe: Probe) -> Option<Time> {
        let period = ms(node.heartbeat_ms.into());
        let answered = self.answered.filter(|_| !probe.listens);
        answered.or_else(|| self.reached.map(|reached| reached.max(period)))
    }
}

impl<'a> Life<'a> {
    /// Runs a situation up to the probe.
    pub fn up_to_the_probe(situation: &'a Situation, image: &Image, part: Part) -> Self {
        let mut network = Network::new();
        for (number, &node) in situation.boards.iter().enumerate() {
            let drift_ppm = situation.drift_ppm * (number as i32 + 1);
            network.add_board(board(number, node, drift_ppm, image, part));
        }
        let mut closed = |bit_per_s| {
            let id = network.add_adapter(Adapter::new(bit_per_s));
            network.adapter_mut(id).close();
            id
        };
        let master = closed(bit_per_s(situation.probe.rate));
        let foreign = situation.events.iter().map(|event| match event.what {
            What::Foreign(Foreign { bit_per_s, has_companion, .. }) => {
                (0..=u8::from(has_companion)).map(|_| closed(bit_per_s)).collect()
            }
            _ => Vec::new(),
        });
        let foreign = foreign.collect();
        let count = situation.boards.len();
        let mut life = Self {
            situation,
            network,
            master,
            mode: Master::Away,
            foreign,
            talkers: Vec::new(),
            random: Random::from_seed(count as u64),
            switched: vec![None; count],
        };
        let mut steps = life.steps();
        steps.sort_by_key(|(time, _)| *time);
        for (time, step) in steps {
            life.run_until(time);
            life.take(step);
        }
        life.run_until(ms(situation.probe.at));
        life
    }

    fn steps(&self) -> Vec<(Time, Step)> {
        let probe = ms(self.situation.probe.at);
        let mut steps = Vec::new();
        for (index, event) in self.situation.events.iter().enumerate() {
            let at = ms(event.at);
            steps.push((at, Step::Begin(index)));
            if event.until > event.at {
                steps.push((ms(event.until), Step::End(index)));
            }
            let mut send =
                |after, request: Request| steps.push((at + ms(after), Step::Send(request)));
            match event.what {
                What::Session(request) => {
                    let span = event.until - event.at;
                    send(0, Request::SwitchToConfiguration);
                    send(20, request);
                    send(span, Request::StoreConfiguration);
                    send(span + 100, Request::SwitchToWaiting);
                }
                What::Switch { to, delay_ms, is_stored } => {
                    send(0, Request::SwitchToConfiguration);
                    send(20, configure(to));
                    if is_stored {
                        send(40, Request::StoreConfiguration);
                    }
                    send(SWITCH_LEAD_MS, Request::ActivateBitTiming(delay_ms));
                    // The request itself takes up to 13 ms.
                    let looked = at + ms(SWITCH_LEAD_MS + 2 * u32::from(delay_ms) + 15);
                    steps.push((looked, Step::Switched(to)));
                }
                _ => {}
            }
        }
        steps.retain(|(time, _)| *time <= probe);
        steps
    }

    fn take(&mut self, step: Step) {
        match step {
            Step::Begin(index) => self.set(index, true),
            Step::End(index) => self.set(index, false),
            Step::Send(request) => self.send_request(request),
            Step::Switched(to) => {
                for board in 0..self.switched.len() {
                    if self.bit_rate(board) == Some(bit_per_s(to)) {
                        self.switched[board] = Some(self.network.now());
                    }
                }
            }
        }
    }

    /// Begins or ends an event.
    fn set(&mut self, index: usize, begins: bool) {
        let network = &mut self.network;
        let set_wire = |network: &mut Network, of| match begins {
            true => network.cut_wire(of),
            false => network.mend_wire(of),
        };
        match self.situation.events[index].what {
            What::Master(master) if begins => self.set_master(master),
            What::NoPower(board) if begins => {
                network.power_off(board);
                self.switched[board] = None;
            }
            What::NoPower(board) => network.power_on(board),
            What::BrokenWire(board) => set_wire(network, Source::Board(board)),
            What::BrokenWireOfMaster => set_wire(network, Source::Adapter(self.master)),
            What::Short(short) => network.set_short(begins.then_some(short)),
            What::Noise { seed, mean_interval_us, length_ns } => {
                let mean_interval = Time::from_us(u64::from(mean_interval_us));
                let length = Time::from_ns(u64::from(length_ns));
                network.set_noise(begins.then_some(Noise { seed, mean_interval, length }));
            }
            What::BitError(board) if begins => {
                network.flip_bit(Source::Board(board), network.now());
            }
            What::Foreign(foreign) if begins => {
                for &adapter in &self.foreign[index] {
                    network.adapter_mut(adapter).open();
                }
                let (every, next) = (pause(foreign), network.now());
                self.talkers.push(Talker { event: Some(index), every, next });
            }
            What::Foreign(_) => {
                for &adapter in &self.foreign[index] {
                    network.adapter_mut(adapter).close();
                }
                self.talkers.retain(|talker| talker.event != Some(index));
            }
            What::Master(_) | What::Switch { .. } | What::Session(_) | What::BitError(_) => {}
        }
    }

    /// Changes the master's role; if it stays at its rate, it does not leave the bus for this.
    fn set_master(&mut self, master: Master) {
        let listens = |master| matches!(master, Master::Listens(_));
        let adapter = self.network.adapter_mut(self.master);
        if master.bit_rate() != self.mode.bit_rate() || listens(master) != listens(self.mode) {
            adapter.close();
            if let Some(rate) = master.bit_rate() {
                adapter.set_bit_rate(bit_per_s(rate));
                if listens(master) {
                    adapter.listen_only();
                } else {
                    adapter.open();
                }
            }
        }
        self.mode = master;
        self.talkers.retain(|talker| talker.event.is_some());
        if let Master::Syncs(_, every) | Master::Polls(_, every) = master {
            let next = self.network.now();
            self.talkers.push(Talker { event: None, every: ms(every), next });
        }
    }

    fn send_request(&mut self, request: Request) {
        if matches!(self.mode, Master::Idle(_) | Master::Syncs(..) | Master::Polls(..)) {
            self.network.send(self.master, on_the_wire(&request.to_frame()));
        }
    }

    /// Whether a board has received a frame at `rate` or had one acknowledged, since its last power-on and switch.
    pub fn has_proven(&self, board: usize, rate: u32) -> bool {
        let mut at = None;
        let (mut takes_part, mut is_proven) = (false, false);
        let has_wire = |time: Time| {
            !self.situation.events.iter().any(|event| {
                event.what == What::BrokenWire(board)
                    && ms(event.at) <= time
                    && time <= ms(event.until)
            })
        };
        for event in self.network.trace() {
            match &event.what {
                network::What::Frame { start, bit_rate, .. } => {
                    is_proven |= takes_part
                        && at == Some(rate)
                        && *bit_rate == rate
                        && has_wire(*start)
                        && has_wire(event.time);
                }
                _ if event.source != Source::Board(board) => {}
                // A board that is proven at a rate leaves it for a switch only.
                network::What::BitTiming { bit_rate, .. } => {
                    is_proven &= at == Some(*bit_rate);
                    at = Some(*bit_rate);
                }
                network::What::InitializationLeft | network::What::Recovered => takes_part = true,
                network::What::InitializationEntered | network::What::BusOff => takes_part = false,
                network::What::PowerOff => (at, takes_part, is_proven) = (None, false, false),
                _ => {}
            }
        }
        is_proven
    }

    /// Whether a disturbance may have kept a board from a switch to `rate`: it has looked at a third one.
    pub fn has_missed_switch_to(&self, board: usize, rate: u32) -> bool {
        let known = [bit_per_s(self.situation.boards[board].stored), rate];
        known[0] != known[1]
            && self.network.trace().iter().any(|event| match event.what {
                network::What::BitTiming { bit_rate, .. } => {
                    event.source == Source::Board(board) && !known.contains(&bit_rate)
                }
                _ => false,
            })
    }

    /// The settings in a board's flash.
    pub fn stored(&self, board: usize) -> Vec<u8> {
        let flash = self.network.board(board).flash();
        flash[SETTINGS_OFFSET as usize..][..SETTINGS_LENGTH].to_vec()
    }

    fn run_until(&mut self, until: Time) {
        loop {
            let due = self.talkers.iter_mut().min_by_key(|talker| talker.next);
            let Some(talker) = due.filter(|talker| talker.next <= until) else {
                return self.network.run_until(until);
            };
            let Talker { event, every, next } = *talker;
            talker.next += every;
            self.network.run_until(next);
            match event {
                Some(event) => self.send_foreign(event, every),
                None if self.network.adapter_mut(self.master).unsent() > 0 => {}
                None => match self.mode {
                    Master::Syncs(..) => {
                        self.network.send(self.master, Frame::data(Id::Standard(0x080), &[]));
                    }
                    _ => self.ask(&vec![true; self.situation.boards.len()]),
                },
            }
        }
    }

    fn send_foreign(&mut self, event: usize, every: Time) {
        let adapter = self.foreign[event][0];
        let asks = matches!(
            self.situation.events[event].what,
            What::Foreign(Foreign { traffic: Traffic::Requests, .. })
        );
        let burst = if every < Time::from_s(1) && !asks { BURST } else { 1 };
        if self.network.adapter_mut(adapter).unsent() > burst {
            return;
        }
        for _ in 0..burst {
            let frame = if asks {
                on_the_wire(&Request::InquireNodeId.to_frame())
            } else {
                Frame::data(Id::Standard(0x181), &self.random.bytes::<8>())
            };
            self.network.send(adapter, frame);
        }
    }

    /// Makes the master ask all missing boards.
    fn ask(&mut self, is_missing: &[bool]) {
        let missing = self.situation.boards.iter().zip(is_missing).filter(|(_, missing)| **missing);
        let node_ids: Vec<_> = missing.map(|(node, _)| node.node_id).collect();
        for node_id in node_ids.iter().flatten() {
            let request = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
            let id = Id::Standard(0x600 + u16::from(*node_id));
            self.network.send(self.master, Frame::data(id, &request));
        }
        if node_ids.contains(&None) {
            self.send_request(Request::IdentifyNonConfigured);
        }
    }

    /// Makes the master look for the boards until it has found all that are `wanted`, for at most `limit`.
    pub fn probe(&mut self, wanted: &[bool], limit: Time) -> Vec<Seen> {
        let begin = self.network.now();
        let probe = self.situation.probe;
        self.set_master(if probe.listens {
            Master::Listens(probe.rate)
        } else {
            Master::Idle(probe.rate)
        });
        let mut seen = vec![Seen::default(); wanted.len()];
        while self.network.receive(self.master).is_some() {}
        let mut now = begin;
        loop {
            let is_missing: Vec<bool> = seen.iter().map(|seen| seen.answered.is_none()).collect();
            let is_over =
                wanted.iter().zip(&is_missing).all(|(wanted, missing)| !wanted || !missing);
            if is_over || now >= begin + limit {
                return seen;
            }
            if !probe.listens && self.network.adapter_mut(self.master).unsent() == 0 {
                self.ask(&is_missing);
            }
            self.network.run_until(now + POLL);
            for (board, time, is_emergency) in self.heard(now) {
                seen[board].reached.get_or_insert(time - begin);
                if !is_emergency {
                    seen[board].answered.get_or_insert(time - begin);
                }
            }
            now += POLL;
        }
    }

    /// The boards that the master has received since `since`, with times, and whether by an emergency message.
    fn heard(&mut self, since: Time) -> Vec<(usize, Time, bool)> {
        const EMERGENCY: u16 = 0x080;
        // A node that is alone and error passive reports this first.
        let cob_ids: &[u16] =
            if self.situation.probe.listens { &[0x700, EMERGENCY] } else { &[0x580] };
        let mut heard = Vec::new();
        while let Some((time, frame)) = self.network.receive(self.master) {
            let boards = self.situation.boards.iter().enumerate();
            heard.extend(boards.filter_map(|(board, node)| {
                let node_id = u16::from(node.node_id?);
                let is = |cob_id: &&u16| frame.id == Id::Standard(**cob_id + node_id);
                let cob_id = cob_ids.iter().find(is)?;
                Some((board, time, *cob_id == EMERGENCY))
            }));
        }
        let answer = Frame::data(Id::Standard(0x7E4), &[0x50, 0, 0, 0, 0, 0, 0, 0]);
        let rate = bit_per_s(self.situation.probe.rate);
        for event in self.network.trace().iter().rev().take_while(|event| event.time > since) {
            if let network::What::Frame { frame, bit_rate, also, .. } = &event.what
                && (*frame, *bit_rate) == (answer, rate)
            {
                let senders = also.iter().chain([&event.source]);
                heard.extend(senders.filter_map(|sender| match sender {
                    Source::Board(board) => Some((*board, event.time, false)),
                    Source::Adapter(_) => None,
                }));
            }
        }
        heard
    }

    /// The bit rate of a board's controller in bit/s; `None` without power.
    pub fn bit_rate(&self, board: usize) -> Option<u32> {
        let board = self.network.board(board);
        board.is_powered().then(|| board.chip().can(1).bit_rate())
    }

    /// The end of the silent time of the last switch that a board took part in, since its last power-on.
    pub fn switched(&self, board: usize) -> Option<Time> {
        self.switched[board]
    }

    /// Accesses that no program may make, and resets that were not requested.
    pub fn offences(&self) -> Vec<String> {
        let mut offences = Vec::new();
        for (number, board) in self.network.boards().iter().enumerate() {
            offences.extend(
                board.findings().iter().map(|finding| format!("board {number}: {finding}")),
            );
            offences.extend(board.lockup().map(|lockup| format!("board {number}: {lockup:?}")));
            let is_asked_for = |cause| matches!(cause, ResetCause::PowerOn);
            let resets = board.resets().iter().filter(|(_, cause)| !is_asked_for(*cause));
            offences.extend(resets.map(|(time, cause)| {
                format!("board {number}: reset at {} ms: {cause:?}", time.as_ms())
            }));
        }
        offences
    }

    /// The boards' logs, in lines.
    pub fn log(&self) -> impl Iterator<Item = String> {
        self.network.boards().iter().enumerate().flat_map(|(number, board)| {
            let line = move |line: LogLine| {
                format!("board {number}, {} ms: {} {}", line.time, line.level, line.text)
            };
            log::lines(board).into_iter().map(line)
        })
    }
}

/// The interval between bursts of a foreign device.
fn pause(foreign: Foreign) -> Time {
    let frames = FRAME_BITS * BURST as u64;
    let burst = Time::from_ps(frames * 1_000_000_000_000 / u64::from(foreign.bit_per_s));
    match foreign.traffic {
        Traffic::OneASecond => Time::from_s(1),
        Traffic::Requests => Time::from_ms(50),
        Traffic::WithoutPause => burst,
        Traffic::Load(percent) => Time::from_ps(burst.as_ps() * 100 / u64::from(percent)),
    }
}

fn board(number: usize, node: Node, drift_ppm: i32, image: &Image, part: Part) -> Board {
    let crystal = Clock { hz: 8_000_000, ppm: PPM[number % PPM.len()] + drift_ppm };
    let settings = board::Settings { crystal, ..Default::default() };
    let node_id = node.node_id.and_then(NodeId::new);
    let stored = Stored {
        settings: Settings::new(node.stored.into()).with_node_id(node_id),
        heartbeat_ms: node.heartbeat_ms,
    };
    Variant { image, part, settings }.board(number, Some(stored))
}
