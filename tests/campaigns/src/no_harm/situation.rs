//! A situation: boards and a master on one bus, with a list of timed events that can be printed as text.

use std::fmt;

use canopen_node::{BitRate, lss::Request};
use emulator::{Time, network::Short};

/// The time from `04 01` to `15`, in milliseconds.
pub const SWITCH_LEAD_MS: u32 = 100;

/// Boards, events and the time at which the master starts to look for the boards.
#[derive(Clone, Debug)]
pub struct Situation {
    /// The main subject.
    pub kind: &'static str,
    pub boards: Vec<Node>,
    /// A deviation of the first board's crystal; the second has twice as much, and so on.
    pub drift_ppm: i32,
    /// The events in order of their start.
    pub events: Vec<Event>,
    pub probe: Probe,
}

/// The settings stored in a board; its number in the list is that of its unique id.
#[derive(Clone, Copy, Debug)]
pub struct Node {
    pub node_id: Option<u8>,
    pub stored: BitRate,
    pub heartbeat_ms: u16,
}

/// An event, with its start and end in milliseconds since power-on.
#[derive(Clone, Copy, Debug)]
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
    /// The master selects all boards with `04 01`, sends this `11` or `13` 20 ms later, at the end `17` and 100 ms later
    /// `04 00`.
    Session(Request),
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
#[derive(Clone, Copy, Debug)]
pub struct Probe {
    /// The start in milliseconds.
    pub at: u32,
    pub rate: BitRate,
    /// Whether the master only listens for heartbeats; otherwise it asks each board every 20 ms.
    pub listens: bool,
}

impl Situation {
    /// The end of the last disturbance, in milliseconds. A master at another rate than the probe's counts as one, and
    /// so does a board.
    pub fn calm_at(&self) -> Option<u32> {
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
            ends.push(until);
        }
        // Its boot-up, which nobody acknowledges, is repeated again and again.
        if self.boards.iter().any(|board| board.stored != self.probe.rate) {
            ends.push(self.probe.at);
        }
        ends.into_iter().max()
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

/// The list of boards and events.
impl fmt::Display for Situation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (number, board) in self.boards.iter().enumerate() {
            writeln!(f, "  board {number}: {board:?}")?;
        }
        for Event { at, until, what } in &self.events {
            writeln!(f, "  {at:>6} .. {until:>6} ms  {what:?}")?;
        }
        write!(f, "  {:?}", self.probe)
    }
}

/// The request that makes a bit rate pending.
pub fn configure(rate: BitRate) -> Request {
    Request::ConfigureBitTiming { table: 0, index: rate.index() }
}

/// A number of milliseconds as the emulation's time.
pub fn ms(ms: u32) -> Time {
    Time::from_ms(u64::from(ms))
}
