//! The three places from which a peripheral sends frames, and their order.

use super::Frame;
use crate::Time;

/// The number of places.
pub const PLACES: usize = 3;

#[derive(Clone, Copy, Debug)]
struct Request {
    frame: Frame,
    since: Time,
    /// The running number of the request.
    number: u64,
}

/// The frames whose transmission is requested.
#[derive(Debug, Default)]
pub struct Requests {
    places: [Option<Request>; PLACES],
    made: u64,
    /// The place whose frame was offered to the controller, and the one whose frame is under way.
    scheduled: Option<usize>,
    sending: Option<usize>,
}

impl Requests {
    pub fn add(&mut self, place: usize, frame: Frame, now: Time) {
        self.made += 1;
        self.places[place] = Some(Request { frame, since: now, number: self.made });
    }

    /// Empties a place and returns its frame.
    pub fn remove(&mut self, place: usize) -> Option<Frame> {
        self.places[place].take().map(|request| request.frame)
    }

    pub fn is_pending(&self, place: usize) -> bool {
        self.places[place].is_some()
    }

    /// The lowest number of a place that is free.
    pub fn free(&self) -> Option<usize> {
        self.places.iter().position(Option::is_none)
    }

    /// The place whose frame cannot be withdrawn: it is under way or, if it was `chosen`, about to be.
    pub fn spared(&self, chosen: bool) -> Option<usize> {
        if chosen { self.scheduled } else { self.sending }
    }

    /// The places that are not free, highest priority first: by identifier and then number, or by order of request.
    pub fn order(&self, chronological: bool) -> Vec<usize> {
        let requests = self.places.iter().enumerate();
        let keyed = requests.filter_map(|(place, request)| {
            let Request { frame, number, .. } = (*request)?;
            Some((if chronological { number } else { frame.arbitration().into() }, place))
        });
        let mut keyed: Vec<(u64, usize)> = keyed.collect();
        keyed.sort_unstable();
        keyed.into_iter().map(|(_, place)| place).collect()
    }

    /// Chooses the next frame to send; returns it and the time of its request.
    pub fn schedule(&mut self, chronological: bool) -> Option<(Frame, Time)> {
        self.scheduled = self.order(chronological).first().copied();
        self.places[self.scheduled?].map(|request| (request.frame, request.since))
    }

    /// Notes that the scheduled frame is under way.
    pub fn started(&mut self) {
        self.sending = self.scheduled;
    }

    /// Notes that no frame is under way any more; returns the place of the one that was.
    pub fn ended(&mut self) -> Option<usize> {
        self.sending.take()
    }
}
