//! The wire that joins controllers: it is dominant while anyone drives it so, everywhere at once.

use super::{Controller, Event, stream::Level};
use crate::Time;

/// What a [`Bus`] needs of whoever owns a controller.
pub trait Station {
    /// The controller on the wire.
    fn controller(&mut self) -> &mut Controller;

    /// Takes note of an event, and offers the next frame where the event makes that necessary.
    ///
    /// Returns whether the bus shall stop at this instant, so that others can act on what happened.
    fn handle(&mut self, event: &Event, now: Time) -> bool;
}

/// A CAN bus without propagation delay.
///
/// At one instant every station first changes what it drives, then synchronises on the edge that
/// this made, then samples: the outcome does not depend on the order of the stations. A station
/// that hears nothing but a recessive wire and has nothing to send costs no time.
#[derive(Default)]
pub struct Bus {
    now: Time,
    level: Level,
    /// When each station acts next.
    next: Vec<Time>,
}

impl Bus {
    /// A recessive bus at the start of time.
    pub fn new() -> Self {
        Self::default()
    }

    /// How far the bus has come.
    pub fn now(&self) -> Time {
        self.now
    }

    /// Level of the wire.
    pub fn level(&self) -> Level {
        self.level
    }

    /// When a station acts next, as of the latest [`advance`](Self::advance); `Time::MAX` on an
    /// idle bus.
    pub fn next_action(&self) -> Time {
        self.next.iter().copied().min().unwrap_or(Time::MAX)
    }

    /// Lets bus life go on up to and including `until`, or up to the first instant after which a
    /// station wants a stop.
    ///
    /// `observe` hears each event before its station (named by its place in `stations`) does. The
    /// stations may differ from call to call: who is absent is unplugged. Returns the instant
    /// reached.
    pub fn advance(
        &mut self,
        until: Time,
        stations: &mut [&mut dyn Station],
        observe: &mut dyn FnMut(usize, &Controller, &Event),
    ) -> Time {
        self.level = wire_level(stations);
        self.next.clear();
        self.next.extend(stations.iter_mut().map(|station| station.controller().next_action()));

        let mut due = Vec::with_capacity(stations.len());
        let mut stop = false;
        while !stop {
            let earliest = self.find_due(&mut due);
            let now = earliest.max(self.now);
            if now > until || earliest == Time::MAX {
                break;
            }
            self.now = now;
            let mut deliver = |index: usize, station: &mut dyn Station| {
                while let Some(event) = station.controller().take_event() {
                    observe(index, station.controller(), &event);
                    stop |= station.handle(&event, now);
                }
                station.controller().next_action()
            };
            let mut driven = false;
            for &index in &due {
                let station = &mut *stations[index];
                if station.controller().drives_next() {
                    station.controller().drive(now);
                    self.next[index] = deliver(index, station);
                    driven = true;
                }
            }
            if driven {
                let before = std::mem::replace(&mut self.level, wire_level(stations));
                if before == Level::Recessive && self.level == Level::Dominant {
                    for (index, station) in stations.iter_mut().enumerate() {
                        station.controller().falling_edge(now);
                        self.next[index] = deliver(index, *station);
                    }
                }
                continue;
            }
            for &index in &due {
                let station = &mut *stations[index];
                station.controller().sample(now, self.level);
                self.next[index] = deliver(index, station);
            }
        }
        if !stop {
            self.now = self.now.max(until);
        }
        for station in stations {
            station.controller().settle(self.now, self.level);
        }
        self.now
    }

    /// Finds the stations that act next, all at the time that is returned.
    fn find_due(&self, due: &mut Vec<usize>) -> Time {
        let mut earliest = Time::MAX;
        for (index, &next) in self.next.iter().enumerate() {
            if next < earliest {
                earliest = next;
                due.clear();
            }
            if next == earliest {
                due.push(index);
            }
        }
        earliest
    }
}

fn wire_level(stations: &mut [&mut dyn Station]) -> Level {
    let dominant =
        stations.iter_mut().any(|station| station.controller().output() == Level::Dominant);
    if dominant { Level::Dominant } else { Level::Recessive }
}
