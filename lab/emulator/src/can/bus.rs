//! The bus that joins controllers: it is dominant everywhere at once while any of them drives it dominant.

use std::cell::Cell;

use super::{
    Controller, Event,
    stream::Level,
    wire::{Noise, Short, Wire},
};
use crate::Time;

/// The interface between a [`Bus`] and the owner of a controller.
pub trait Station {
    fn controller(&mut self) -> &mut Controller;

    /// Handles an event, and offers the next frame if the event makes that necessary.
    ///
    /// Returns whether the bus shall stop at this instant, so that others can react to the event.
    fn handle(&mut self, event: &Event, now: Time) -> bool;
}

/// A CAN bus without propagation delay.
///
/// At each instant every station first changes the level that it drives, then synchronises on the resulting edge, then
/// samples: the outcome does not depend on the order of the stations. A station on a recessive wire with nothing to
/// send costs no time.
#[derive(Default)]
pub struct Bus {
    now: Time,
    wire: Wire,
    /// The time of each station's next action.
    next: Vec<Time>,
    has_stopped: bool,
}

impl Bus {
    pub fn new() -> Self {
        Self::default()
    }

    pub(crate) fn at(now: Time) -> Self {
        Self { now, ..Self::default() }
    }

    pub fn now(&self) -> Time {
        self.now
    }

    pub fn level(&self) -> Level {
        self.wire.level
    }

    /// Shorts the wires from `now` on, or repairs them.
    pub fn set_short(&mut self, short: Option<Short>, now: Time) {
        self.settle(now);
        self.wire.short = short;
    }

    /// Puts noise on the wires from `now` on, or ends it.
    pub fn set_noise(&mut self, noise: Option<Noise>, now: Time) {
        self.settle(now);
        self.wire.set_noise(noise, self.now);
    }

    /// Advances to `now` on a bus without any activity until then.
    pub(crate) fn settle(&mut self, now: Time) {
        self.now = self.now.max(now);
    }

    /// The time of the next action of a station or a disturbance, as of the latest [`advance`](Self::advance);
    /// `Time::MAX` on an idle bus.
    pub fn next_action(&self) -> Time {
        self.next.iter().copied().fold(self.wire.next_action(), Time::min)
    }

    /// Whether a station requested the end of the latest [`advance`](Self::advance).
    pub fn has_stopped(&self) -> bool {
        self.has_stopped
    }

    /// Runs the bus up to and including `until`, or up to the first instant after which a station requests a stop.
    ///
    /// `observe` receives each event before its station (given by its place in `stations`) does. The stations may
    /// differ from call to call: an absent station is unplugged. Returns the instant reached.
    pub fn advance(
        &mut self,
        until: Time,
        stations: &mut [&mut dyn Station],
        observe: &mut dyn FnMut(usize, &Controller, &Event),
    ) -> Time {
        let stop = Cell::new(false);
        let mut deliver = |index: usize, station: &mut dyn Station, now: Time| {
            loop {
                let controller = station.controller();
                let Some(event) = controller.take_event() else { return controller.next_action() };
                observe(index, controller, &event);
                stop.set(stop.get() | station.handle(&event, now));
            }
        };
        self.wire.level = self.wire.resolve(anyone_drives(stations));
        self.next.clear();
        for (index, station) in stations.iter_mut().enumerate() {
            station.controller().resume(self.now, self.wire.level);
            self.next.push(deliver(index, *station, self.now));
        }

        let mut due = Vec::with_capacity(stations.len());
        while !stop.get() {
            let earliest = self.find_due(&mut due);
            let now = earliest.max(self.now);
            if now > until || earliest == Time::MAX {
                break;
            }
            self.now = now;
            let mut changed = self.wire.act(now);
            for &index in &due {
                let controller = stations[index].controller();
                if controller.drives_at(now) {
                    controller.drive(now);
                    self.next[index] = deliver(index, &mut *stations[index], now);
                    changed = true;
                }
            }
            if changed {
                let level = self.wire.resolve(anyone_drives(stations));
                let before = std::mem::replace(&mut self.wire.level, level);
                if before == Level::Recessive && level == Level::Dominant {
                    for (index, station) in stations.iter_mut().enumerate() {
                        station.controller().falling_edge(now);
                        self.next[index] = deliver(index, *station, now);
                    }
                }
                continue;
            }
            for &index in &due {
                let station = &mut *stations[index];
                station.controller().sample(now, self.wire.level);
                self.next[index] = deliver(index, station, now);
            }
        }
        self.has_stopped = stop.get();
        if !self.has_stopped {
            self.now = self.now.max(until);
        }
        for station in stations {
            station.controller().settle(self.now, self.wire.level);
        }
        self.now
    }

    /// Finds the stations that act next and returns the time of their action.
    fn find_due(&self, due: &mut Vec<usize>) -> Time {
        let mut earliest = self.wire.next_action();
        due.clear();
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

fn anyone_drives(stations: &mut [&mut dyn Station]) -> bool {
    stations.iter_mut().any(|station| station.controller().output() == Level::Dominant)
}
