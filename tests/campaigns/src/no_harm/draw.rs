//! Random situations: their kind, the stations on the bus, and the events.

use canopen_node::{BitRate, lss::Request};
use emulator::network::Short;

use super::situation::{
    Event, Foreign, Master, Node, Probe, SWITCH_LEAD_MS, Situation, Traffic, What, configure,
};
use testkit::{random::Random, wire::bit_per_s};

/// Slow rates, at which a frame takes up to 13 ms, are rare; so are fast rates, at which errors keep the emulated cores
/// busy.
const RATES: [BitRate; 16] = [
    BitRate::Kbit1000,
    BitRate::Kbit800,
    BitRate::Kbit500,
    BitRate::Kbit500,
    BitRate::Kbit250,
    BitRate::Kbit250,
    BitRate::Kbit250,
    BitRate::Kbit125,
    BitRate::Kbit125,
    BitRate::Kbit125,
    BitRate::Kbit125,
    BitRate::Kbit125,
    BitRate::Kbit50,
    BitRate::Kbit50,
    BitRate::Kbit20,
    BitRate::Kbit10,
];
/// Node-IDs of the boards, by number.
const NODE_IDS: [u8; 8] = [1, 2, 3, 40, 5, 64, 100, 127];

type Draw = fn(&mut Draft) -> Probe;

/// The kind with a session of the LSS master.
pub const SESSION: &str = "session and pulses";
/// The kinds of situations, and what draws each.
const KINDS: [(&str, Draw); 15] = [
    ("late master", Draft::late_master),
    ("foreign device", Draft::foreign_device),
    ("faults of the line", Draft::line_fault),
    ("missed switch", Draft::missed_switch),
    ("wrong stored rate", Draft::wrong_rate),
    ("power cuts", Draft::power_cut),
    ("mixture", Draft::mixture),
    ("led away together", Draft::herd),
    (SESSION, Draft::session),
    ("scan of bit rates", Draft::scan),
    ("half of a switch", Draft::half_switch),
    ("brown-outs", Draft::brown_out),
    ("one after another", Draft::stagger),
    ("two masters", Draft::two_masters),
    ("bad contacts", Draft::bad_contacts),
];

/// A situation under construction.
struct Draft {
    random: Random,
    home: BitRate,
    boards: Vec<Node>,
    events: Vec<Event>,
}

/// The situation of this seed.
pub fn situation(seed: u64) -> Situation {
    let mut random = Random::from_seed(seed);
    // Of eight boards at 10 kbit/s each would receive little but the questions to the others.
    let home = random.pick(&RATES);
    let most = if home.kbit_per_s() < 125 { 3 } else { 8 };
    let many = random.within(4..9) as usize;
    let count = random.pick(&[1, 1, 1, 1, 1, 1, 1, 1, 2, 2, 2, 2, 2, 3, 3, many]).min(most);
    let boards = (0..count).map(|number| Node {
        node_id: (!random.one_in(4)).then_some(NODE_IDS[number]),
        stored: home,
        heartbeat_ms: random.pick(&[0, 100, 1000]),
    });
    let boards = boards.collect();
    let mut draft = Draft { boards, home, events: Vec::new(), random };
    let (kind, draw) = draft.random.pick(&KINDS);
    let probe = draw(&mut draft);
    draft.events.sort_by_key(|event| event.at);
    Situation { kind, boards: draft.boards, drift_ppm: 0, events: draft.events, probe }
}

impl Draft {
    /// A switch with 15, which the master follows late.
    fn late_master(&mut self) -> Probe {
        let begin = self.span(100, 500);
        self.master_at(0, self.home);
        let to = self.other_rate();
        let t0 = self.switch(begin, to);
        let delay_ms = self.delay_of_switch();
        if self.random.one_in(2) {
            self.add(t0 + 20, t0 + 20, What::Master(Master::Away));
        }
        let late = match self.random.within(0..10) {
            0..4 => self.random.pick(&[1, 20, 50, 200]),
            4..9 => self.span(200, 2_500),
            _ if self.boards.len() > 3 => self.span(2_500, 5_000),
            _ => self.span(2_500, 30_000),
        };
        self.probe(t0 + delay_ms + 1 + late, to)
    }

    /// A foreign device, from power-on or later.
    fn foreign_device(&mut self) -> Probe {
        self.any_master_at(0, self.home);
        let begin = if self.random.one_in(2) { 0 } else { self.span(50, 1_000) };
        let end = self.foreign(begin, self.home);
        self.probe_after(end, self.home)
    }

    /// Shorts, broken wires, noise and bit errors, in sequence or at once.
    fn line_fault(&mut self) -> Probe {
        self.any_master_at(0, self.home);
        let mut end = self.span(0, 800);
        for _ in 0..self.random.within(1..4) {
            end = self.fault(end);
            end += if self.random.one_in(2) { 0 } else { self.span(0, 500) };
        }
        self.probe(end, self.home)
    }

    /// A switch that some or all boards miss: in the latter case the master alone goes to another rate.
    fn missed_switch(&mut self) -> Probe {
        self.master_at(0, self.home);
        let begin = self.span(200, 1_000);
        let to = self.other_rate();
        if self.random.one_in(3) {
            let master = self.talking_master(to);
            self.add(begin, begin, What::Master(master));
            return self.probe_after(begin, to);
        }
        let t0 = self.switch(begin, to);
        let away = t0 + self.delay_of_switch() + self.span(10, 1_000);
        let missing = self.any_board();
        for board in 0..self.boards.len() {
            if board == missing || self.random.one_in(5) {
                let has_power = self.random.one_in(2);
                let what = if has_power { What::BrokenWire(board) } else { What::NoPower(board) };
                let from = begin - self.span(1, 200);
                self.add(from, away, what);
            }
        }
        let follows = t0 + self.delay_of_switch() + 1;
        let master = self.talking_master(to);
        self.add(follows, follows, What::Master(master));
        let probe = self.probe_after(away, to);
        self.may_crash(begin, probe)
    }

    /// Lets half of the masters crash in the switch that began at `begin`, and come back at the rate of the probe.
    fn may_crash(&mut self, begin: u32, probe: Probe) -> Probe {
        if self.random.one_in(2) {
            return probe;
        }
        let crash = self.span(begin + 1, probe.at);
        self.events.retain(|event| event.at < crash || !matches!(event.what, What::Master(_)));
        self.add(crash, crash, What::Master(Master::Away));
        let back = crash + self.span(1, 3_000);
        self.master_at(back, probe.rate);
        Probe { at: probe.at.max(back), ..probe }
    }

    /// Boards with a stored rate that is not the bus's.
    fn wrong_rate(&mut self) -> Probe {
        let wrong = self.any_board();
        for board in 0..self.boards.len() {
            if board == wrong || self.random.one_in(4) {
                self.boards[board].stored = self.other_rate();
            }
        }
        self.any_master_at(0, self.home);
        let mut end = self.span(50, 1_500);
        if self.random.one_in(4) {
            end = self.fault(end);
        }
        self.probe(end, self.home)
    }

    /// Power cuts, some after a switch that was not stored.
    fn power_cut(&mut self) -> Probe {
        self.master_at(0, self.home);
        let mut at = self.span(100, 1_000);
        let to = self.other_rate();
        let mut rate = self.home;
        if self.random.one_in(2) {
            at = self.switch(at, to) + 2 * self.delay_of_switch() + 20;
            rate = if self.last_switch().1 { to } else { self.home };
            self.add(at, at, What::Master(Master::Idle(to)));
        }
        let mut end = at;
        for board in 0..self.boards.len() {
            let from = at + self.span(0, 500);
            let until = from + self.span(5, 2_000);
            self.add(from, until, What::NoPower(board));
            end = end.max(until);
        }
        let back = self.span(at, end);
        self.master_at(back, rate);
        self.probe_after(end, rate)
    }

    /// A mixture of events, with a switch among them.
    fn mixture(&mut self) -> Probe {
        self.any_master_at(0, self.home);
        // A rescued board would obey a switch that the plain slave does not receive.
        let is_wrong = self.random.one_in(4);
        if is_wrong {
            let board = self.any_board();
            self.boards[board].stored = self.other_rate();
        }
        let mut rate = self.home;
        let mut at = self.span(0, 1_000);
        let mut end = at;
        for _ in 0..self.random.within(2..5) {
            let until = match self.random.within(0..6) {
                0 | 1 => self.foreign(at, rate),
                2 | 3 => self.fault(at),
                4 if at > 200 && !is_wrong => {
                    self.add(at - 150, at - 150, What::Master(Master::Idle(rate)));
                    rate = self.other_rate();
                    let follows = self.switch(at, rate) + self.delay_of_switch() + 1;
                    let late = self.span(0, 1_000);
                    self.master_at(follows + late, rate);
                    follows + late
                }
                _ => {
                    self.any_master_at(at, rate);
                    at
                }
            };
            end = end.max(until);
            at = if self.random.one_in(3) {
                at + self.span(1, 300)
            } else {
                until + self.span(0, 300)
            };
        }
        self.probe_after(end.max(at), rate)
    }

    /// A master that only listens or only acknowledges.
    fn silent_master(&mut self) -> Master {
        if self.random.one_in(2) { Master::Listens(self.home) } else { Master::Idle(self.home) }
    }

    /// Several boards with a foreign device and a silent master.
    fn herd(&mut self) -> Probe {
        self.add_second_board();
        for (board, node_id) in self.boards.iter_mut().zip(NODE_IDS) {
            board.node_id = Some(node_id);
            board.heartbeat_ms = self.random.pick(&[100, 1000]);
        }
        let master = self.silent_master();
        self.add(0, 0, What::Master(master));
        let begin = if self.random.one_in(2) { 0 } else { self.span(50, 1_500) };
        let end = self.foreign(begin, self.home);
        let wait = self.wait();
        Probe { at: end + wait, rate: self.home, listens: matches!(master, Master::Listens(_)) }
    }

    /// A session of the LSS master with single-bit pulses and a pause.
    fn session(&mut self) -> Probe {
        self.boards.truncate(1);
        self.master_at(0, self.home);
        let begin = self.span(200, 600);
        self.add(begin - 60, begin - 60, What::Master(Master::Idle(self.home)));
        let end = begin + self.span(1_000, 10_000);
        let request = if self.random.one_in(2) {
            Request::ConfigureNodeId(self.boards[0].node_id.unwrap_or(1))
        } else {
            configure(self.other_rate())
        };
        self.add(begin, end, What::Session(request));
        let noise = What::Noise {
            seed: self.random.u64(),
            mean_interval_us: self.random.within(100_000..1_500_000) as u32,
            length_ns: 1_000_000 / u32::from(self.home.kbit_per_s()),
        };
        self.add(begin + 50, end - 50, noise);
        self.probe(end + 200, self.home)
    }

    /// A master that tries one bit rate after another.
    fn scan(&mut self) -> Probe {
        let mut at = 0;
        for _ in 0..self.random.within(2..7) {
            let rate = self.random.pick(&RATES);
            let master = self.talking_master(rate);
            self.add(at, at, What::Master(master));
            at += self.span(100, 700);
        }
        self.add(at, at, What::Master(Master::Away));
        self.probe(at, self.home)
    }

    /// A switch that half of the boards miss.
    fn half_switch(&mut self) -> Probe {
        self.add_second_board();
        self.master_at(0, self.home);
        let begin = self.span(300, 1_000);
        let to = self.other_rate();
        let t0 = self.switch(begin, to);
        let away = t0 + self.delay_of_switch() + self.span(10, 500);
        for board in (0..self.boards.len()).step_by(2) {
            self.add(begin - 20, away, What::BrokenWire(board));
        }
        let follows = t0 + self.delay_of_switch() + 1;
        self.add(follows, follows, What::Master(Master::Idle(to)));
        let wait = self.wait();
        let rate = if self.random.one_in(2) { to } else { self.home };
        let probe = self.probe(away.max(follows) + wait, rate);
        self.may_crash(begin, probe)
    }

    /// Power cuts of a few milliseconds while a foreign device sends.
    fn brown_out(&mut self) -> Probe {
        self.any_master_at(0, self.home);
        let end = self.foreign(0, self.home);
        for _ in 0..self.random.within(1..5) {
            let board = self.any_board();
            let at = self.span(10, end);
            let length = self.span(2, 40);
            self.add(at, at + length, What::NoPower(board));
        }
        self.probe_after(end + 50, self.home)
    }

    /// Boards that come up one after another, with different stored rates.
    fn stagger(&mut self) -> Probe {
        self.any_master_at(0, self.home);
        let mut last = 0;
        for board in 0..self.boards.len() {
            if self.random.one_in(3) {
                self.boards[board].stored = self.other_rate();
            }
            let on = self.span(1, 1_500);
            self.add(0, on, What::NoPower(board));
            last = last.max(on);
        }
        self.probe_after(last, self.home)
    }

    /// A second master, at a wrong rate.
    fn two_masters(&mut self) -> Probe {
        self.any_master_at(0, self.home);
        let other = self.other_rate();
        let begin = self.span(0, 1_000);
        let end = begin + self.span(100, 3_000);
        let traffic = Traffic::Requests;
        let bit_per_s = bit_per_s(other);
        let has_companion = self.random.one_in(2);
        self.add(begin, end, What::Foreign(Foreign { bit_per_s, traffic, has_companion }));
        self.probe_after(end, self.home)
    }

    /// Contacts that open again and again.
    fn bad_contacts(&mut self) -> Probe {
        self.any_master_at(0, self.home);
        let mut at = self.span(0, 500);
        for _ in 0..self.random.within(3..12) {
            let board = self.any_board();
            let length = self.span(1, 50);
            self.add(at, at + length, What::BrokenWire(board));
            at += length + self.span(1, 200);
        }
        self.probe(at, self.home)
    }

    fn add_second_board(&mut self) {
        if self.boards.len() < 2 {
            self.boards.push(Node { node_id: Some(NODE_IDS[1]), ..self.boards[0] });
        }
    }

    fn any_board(&mut self) -> usize {
        self.random.within(0..self.boards.len() as u64) as usize
    }

    fn add(&mut self, at: u32, until: u32, what: What) {
        self.events.push(Event { at, until, what });
    }

    fn span(&mut self, from: u32, to: u32) -> u32 {
        self.random.within(u64::from(from)..u64::from(to.max(from + 1))) as u32
    }

    /// The time from the end of the disturbance to the probe.
    fn wait(&mut self) -> u32 {
        if self.random.one_in(2) { 0 } else { self.span(1, 1_000) }
    }

    fn other_rate(&mut self) -> BitRate {
        loop {
            let rate = self.random.pick(&RATES);
            if rate != self.home {
                return rate;
            }
        }
    }

    /// A probe some time after the end of the disturbance.
    fn probe_after(&mut self, end: u32, rate: BitRate) -> Probe {
        let wait = self.wait();
        self.probe(end + wait, rate)
    }

    fn probe(&mut self, at: u32, rate: BitRate) -> Probe {
        let has_heartbeat = |node: &Node| node.node_id.is_some() && node.heartbeat_ms > 0;
        let listens = self.boards.iter().all(has_heartbeat) && self.random.one_in(4);
        Probe { at, rate, listens }
    }

    /// A switch of all boards that receive it; returns the approximate start of its delays.
    fn switch(&mut self, at: u32, to: BitRate) -> u32 {
        let delay_ms = self.random.pick(&[0, 1, 10, 50, 100, 100, 500, 1000]);
        let is_stored = self.random.one_in(3);
        self.add(at, at, What::Switch { to, delay_ms, is_stored });
        at + SWITCH_LEAD_MS
    }

    fn delay_of_switch(&self) -> u32 {
        self.last_switch().0
    }

    /// The delay of the last switch in milliseconds, and whether it is stored.
    fn last_switch(&self) -> (u32, bool) {
        let switch = |event: &Event| match event.what {
            What::Switch { delay_ms, is_stored, .. } => Some((u32::from(delay_ms), is_stored)),
            _ => None,
        };
        self.events.iter().rev().find_map(switch).unwrap_or_default()
    }

    /// A master that takes part.
    fn master_at(&mut self, at: u32, rate: BitRate) {
        let master =
            if self.random.one_in(2) { Master::Idle(rate) } else { self.talking_master(rate) };
        self.add(at, at, What::Master(master));
    }

    fn talking_master(&mut self, rate: BitRate) -> Master {
        let every = self.random.pick(&[10, 100, 100, 500, 1000]);
        if self.random.one_in(2) { Master::Syncs(rate, every) } else { Master::Polls(rate, every) }
    }

    /// A master that takes part, listens or is absent.
    fn any_master_at(&mut self, at: u32, rate: BitRate) {
        match self.random.within(0..4) {
            0 => self.add(at, at, What::Master(Master::Away)),
            1 => self.add(at, at, What::Master(Master::Listens(rate))),
            _ => self.master_at(at, rate),
        }
    }

    /// A foreign device at another rate than `rate`; returns the time at which it leaves.
    fn foreign(&mut self, at: u32, rate: BitRate) -> u32 {
        let others = BitRate::ALL.map(bit_per_s);
        let others = others.into_iter().chain([333_000, 83_000]);
        let others: Vec<u32> =
            others.filter(|other| other / 1000 != u32::from(rate.kbit_per_s())).collect();
        let load = Traffic::Load(self.random.within(50..91) as u8);
        let foreign = Foreign {
            bit_per_s: self.random.pick(&others),
            traffic: self.random.pick(&[Traffic::OneASecond, Traffic::WithoutPause, load]),
            has_companion: self.random.one_in(2),
        };
        let until = at + self.random.pick(&[100, 300, 500, 500, 1_000, 1_000, 2_000, 3_000]);
        self.add(at, until, What::Foreign(foreign));
        until
    }

    /// A fault of the line or the supply; returns its end.
    fn fault(&mut self, at: u32) -> u32 {
        let board = self.any_board();
        let span =
            self.random.pick(&[1, 20, 20, 200, 200, 200, 200, 500, 500, 1_000, 1_000, 3_000]);
        let what = match self.random.within(0..10) {
            0..2 => What::Short(Short::Dominant),
            2..4 => What::Short(Short::Recessive),
            4..6 => What::BrokenWire(board),
            6 => What::BrokenWireOfMaster,
            7 => What::NoPower(board),
            8 => What::BitError(board),
            _ => What::Noise {
                seed: self.random.u64(),
                mean_interval_us: self.random.pick(&[200, 1_000, 10_000, 100_000]),
                length_ns: self.random.pick(&[200, 1_000, 5_000, 50_000]),
            },
        };
        let until = if matches!(what, What::BitError(_)) { at } else { at + span };
        self.add(at, until, what);
        until
    }
}
