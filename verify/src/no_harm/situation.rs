//! A situation: boards and a master on one bus, with a list of timed events that can be printed as text.

use std::fmt;

use canopen_node::BitRate;
use emulator::{Time, network::Short};

use super::life::SWITCH_LEAD_MS;

/// Boards, events and the time at which the master starts to look for the boards.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Situation {
    /// The main subject.
    pub kind: Kind,
    pub boards: Vec<Node>,
    /// A deviation of the first board's crystal; the second has twice as much, and so on.
    pub drift_ppm: i32,
    /// The events in order of their start.
    pub events: Vec<Event>,
    pub probe: Probe,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    LateMaster,
    Laptop,
    LineFault,
    MissedSwitch,
    WrongRate,
    PowerCut,
    Mixture,
    Herd,
    Session,
    Scan,
    HalfSwitch,
    BrownOut,
    Stagger,
    TwoMasters,
    Contacts,
}

impl Kind {
    pub const ALL: [Self; 15] = [
        Self::LateMaster,
        Self::Laptop,
        Self::LineFault,
        Self::MissedSwitch,
        Self::WrongRate,
        Self::PowerCut,
        Self::Mixture,
        Self::Herd,
        Self::Session,
        Self::Scan,
        Self::HalfSwitch,
        Self::BrownOut,
        Self::Stagger,
        Self::TwoMasters,
        Self::Contacts,
    ];
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::LateMaster => "late master",
            Self::Laptop => "foreign device",
            Self::LineFault => "faults of the line",
            Self::MissedSwitch => "missed switch",
            Self::WrongRate => "wrong stored rate",
            Self::PowerCut => "power cuts",
            Self::Mixture => "mixture",
            Self::Herd => "led away together",
            Self::Session => "session and pulses",
            Self::Scan => "scan of bit rates",
            Self::HalfSwitch => "half of a switch",
            Self::BrownOut => "brown-outs",
            Self::Stagger => "one after another",
            Self::TwoMasters => "two masters",
            Self::Contacts => "bad contacts",
        })
    }
}

/// The settings stored in a board; its number in the list is that of its unique id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Node {
    pub node_id: Option<u8>,
    pub stored: BitRate,
    pub heartbeat_ms: u16,
}

/// An event, with its start and end in milliseconds since power-on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Event {
    pub at: u32,
    /// The end; equal to `at` for an event without one.
    pub until: u32,
    pub what: What,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum What {
    /// The master's role from now on.
    Master(Master),
    /// The master, which must be at the boards' rate, sends `04 01`, 20 ms later `13`, 20 ms later optionally `17`, and
    /// `15` 100 ms after the first. It stays at its rate.
    Switch {
        to: BitRate,
        delay_ms: u16,
        is_stored: bool,
    },
    /// The master selects all boards with `04 01`, sends `11` or `13` 20 ms later, at the end `17` and 100 ms later
    /// `04 00`.
    Session(Configure),
    NoPower(usize),
    BrokenWire(usize),
    /// The master's own wire is broken.
    BrokenWireOfMaster,
    Short(Short),
    /// Pulses of a number of nanoseconds at random instants.
    Noise {
        seed: u64,
        mean_interval_us: u32,
        length_ns: u32,
    },
    /// A board samples one bit wrongly.
    BitError(usize),
    Foreign(Foreign),
}

/// What a session configures: a node-ID, or a bit rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Configure {
    NodeId(u8),
    Rate(BitRate),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Master {
    Away,
    Listens(BitRate),
    /// Acknowledges and sends nothing.
    Idle(BitRate),
    /// Sends SYNC at intervals in milliseconds.
    Syncs(BitRate, u32),
    /// Asks all boards at intervals in milliseconds.
    Polls(BitRate, u32),
}

impl Master {
    pub const fn bit_rate(self) -> Option<BitRate> {
        match self {
            Self::Away => None,
            Self::Listens(rate)
            | Self::Idle(rate)
            | Self::Syncs(rate, _)
            | Self::Polls(rate, _) => Some(rate),
        }
    }
}

/// A device that does not belong to the network, such as a laptop's adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Foreign {
    pub bit_per_s: u32,
    pub traffic: Traffic,
    /// Whether a second adapter at its rate acknowledges.
    pub has_companion: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Traffic {
    OneASecond,
    WithoutPause,
    /// A percentage of the bus.
    Load(u8),
    /// A request of an LSS master every 50 ms.
    Requests,
}

/// The master's search for the boards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Probe {
    /// The start in milliseconds.
    pub at: u32,
    pub rate: BitRate,
    /// Whether the master only listens for heartbeats; otherwise it asks each board every 20 ms.
    pub listens: bool,
}

impl Situation {
    /// The end of the last disturbance and the longest time that one has lasted, in milliseconds. A master at another
    /// rate than the probe's counts as one, and so does a board.
    pub fn calm_at(&self) -> Option<(u32, u32)> {
        let mut ends = Vec::new();
        for (index, event) in self.events.iter().enumerate() {
            let until = match event.what {
                What::Master(master)
                    if master.bit_rate().is_none_or(|rate| rate == self.probe.rate) =>
                {
                    continue;
                }
                What::Master(_) => {
                    let is_master = |event: &&Event| matches!(event.what, What::Master(_));
                    let next = self.events[index + 1..].iter().find(is_master);
                    next.map_or(self.probe.at, |event| event.at)
                }
                What::Switch { .. } | What::Session(_) => continue,
                _ => event.until,
            };
            ends.push((until, until - event.at));
        }
        // Its boot-up, which nobody acknowledges, is repeated again and again.
        if self.boards.iter().any(|board| board.stored != self.probe.rate) {
            ends.push((self.probe.at, 0));
        }
        let calm = ends.iter().map(|(until, _)| *until).max()?;
        Some((calm, ends.iter().map(|(_, span)| *span).max()?))
    }

    /// Whether a master sends requests at another rate than the probe's.
    pub fn has_foreign_requests(&self) -> bool {
        self.events.iter().any(|event| match event.what {
            What::Master(Master::Syncs(rate, _) | Master::Polls(rate, _)) => {
                rate != self.probe.rate
            }
            What::Foreign(foreign) => foreign.traffic == Traffic::Requests,
            _ => false,
        })
    }

    /// The end of the last switch, in milliseconds. The request itself takes up to 13 ms.
    pub fn last_switch(&self) -> Option<u32> {
        const REQUEST_MS: u32 = 15;
        let end = |event: &Event| match event.what {
            What::Switch { delay_ms, .. } => {
                Some(event.at + SWITCH_LEAD_MS + 2 * u32::from(delay_ms) + REQUEST_MS)
            }
            _ => None,
        };
        self.events.iter().filter_map(end).max()
    }

    /// The time from which the master sends at the probe's rate without disturbance, in milliseconds.
    pub fn evidence_at(&self) -> u32 {
        let last_end = |event: &Event| match event.what {
            What::Master(_) => None,
            What::Switch { .. } => Some(event.at),
            _ => Some(event.until),
        };
        let calm = self.events.iter().filter_map(last_end).max().unwrap_or(0);
        let mut masters = self.events.iter().filter_map(|event| match event.what {
            What::Master(master) => Some((event.at, master)),
            _ => None,
        });
        match masters.next_back() {
            Some((at, Master::Syncs(rate, _) | Master::Polls(rate, _)))
                if rate == self.probe.rate =>
            {
                at.max(calm)
            }
            _ => self.probe.at,
        }
    }
}

/// A line of an event list.
impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.until > self.at {
            write!(f, "{:>6} .. {:>6} ms  {}", self.at, self.until, self.what)
        } else {
            write!(f, "{:>6}           ms  {}", self.at, self.what)
        }
    }
}

impl fmt::Display for What {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Master(master) => write!(f, "{master}"),
            Self::Switch { to, delay_ms, is_stored } => {
                let store = if is_stored { ", 17" } else { "" };
                let (index, kbit_per_s) = (to.index(), to.kbit_per_s());
                write!(
                    f,
                    "the master sends 04 01, 13 00 {index:02X}{store}, 15 with d = {delay_ms} ms: to {kbit_per_s} kbit/s"
                )
            }
            Self::Session(Configure::NodeId(id)) => {
                write!(f, "the master sends 04 01, 11 {id:02X}, and at the end 17, 04 00")
            }
            Self::Session(Configure::Rate(rate)) => {
                let index = rate.index();
                write!(f, "the master sends 04 01, 13 00 {index:02X}, and at the end 17, 04 00")
            }
            Self::NoPower(board) => write!(f, "board {board} has no power"),
            Self::BrokenWire(board) => write!(f, "the wire of board {board} is broken"),
            Self::BrokenWireOfMaster => write!(f, "the wire of the master is broken"),
            Self::Short(Short::Dominant) => write!(f, "the bus is held dominant"),
            Self::Short(Short::Recessive) => {
                write!(f, "CANH and CANL are shorted: the bus is recessive")
            }
            Self::Noise { mean_interval_us, length_ns, .. } => {
                write!(f, "noise: pulses of {length_ns} ns, {mean_interval_us} us apart on average")
            }
            Self::BitError(board) => write!(f, "board {board} samples one bit wrongly"),
            Self::Foreign(foreign) => write!(f, "{foreign}"),
        }
    }
}

impl fmt::Display for Master {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(rate) = self.bit_rate() else {
            return f.write_str("the master is away");
        };
        write!(f, "the master is at {} kbit/s and ", rate.kbit_per_s())?;
        match self {
            Self::Away | Self::Idle(_) => f.write_str("sends nothing"),
            Self::Listens(_) => f.write_str("only listens"),
            Self::Syncs(_, every) => write!(f, "sends SYNC every {every} ms"),
            Self::Polls(_, every) => write!(f, "asks all boards every {every} ms"),
        }
    }
}

impl fmt::Display for Foreign {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a foreign device at {} bit/s sends ", self.bit_per_s)?;
        match self.traffic {
            Traffic::OneASecond => f.write_str("a frame a second")?,
            Traffic::WithoutPause => f.write_str("without a pause")?,
            Traffic::Load(percent) => write!(f, "{percent} % load")?,
            Traffic::Requests => f.write_str("LSS requests every 50 ms")?,
        }
        f.write_str(if self.has_companion { ", a second one acknowledges" } else { "" })
    }
}

/// The whole list.
impl fmt::Display for Situation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (number, board) in self.boards.iter().enumerate() {
            let Node { node_id, stored, heartbeat_ms } = board;
            let node_id = node_id.map_or("no node-ID".to_owned(), |id| format!("node-ID {id}"));
            let kbit_per_s = stored.kbit_per_s();
            writeln!(
                f,
                "  board {number}: {node_id}, {kbit_per_s} kbit/s stored, heartbeat {heartbeat_ms} ms"
            )?;
        }
        for event in &self.events {
            writeln!(f, "  {event}")?;
        }
        let Probe { at, rate, listens } = self.probe;
        let how = if listens { "listens for heartbeats" } else { "asks each board every 20 ms" };
        write!(f, "  {at:>6}           ms  the master {how} at {} kbit/s", rate.kbit_per_s())
    }
}

/// A number of milliseconds as the emulation's time.
pub fn ms(ms: u32) -> Time {
    Time::from_ms(u64::from(ms))
}
