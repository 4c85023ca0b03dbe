//! The heartbeat consumer (CiA 301, 7.2.8.3.2): 1016h.

use core::mem;

use crate::{
    Application, Frame, Instant, NodeId,
    application::event::Event,
    declaration_error::DeclarationError,
    emergency::{COMMUNICATION, Emergency, PROCESS_DATA, own},
    nmt,
    numbers::{Element, List, Numbers},
    object_dictionary::{
        Access::{Const, ReadWrite},
        DataType::{Unsigned8, Unsigned32},
        DefaultValue, Description, Entry, Name, Object, row,
    },
    sdo::Abort,
};

/// The most heartbeat producers that a node watches.
pub const MAX_PRODUCERS: usize = 16;
/// Consumer heartbeat time.
pub(crate) const INDEX: u16 = 0x1016;

/// The error code of a heartbeat that is missing.
const LOST: u16 = own::HEARTBEAT_LOST.code;

/// The heartbeat consumer of a node.
#[derive(Clone, Debug)]
pub(crate) struct Consumer<N: Numbers> {
    producers: Producers<N>,
    /// The entries to which a reset returns.
    pub persistent: Producers<N>,
    watches: N::Producers<Watch>,
}

/// The entries of 1016h.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Producers<N: Numbers>(N::Producers<Producer>);

/// The rows of 1016h for this number of producers.
pub(crate) struct Rows<const PRODUCERS: usize>;

impl<const PRODUCERS: usize> Rows<PRODUCERS> {
    const OF_MOST: [Entry; MAX_PRODUCERS + 1] = {
        let highest = Object::HighestSubIndex(PRODUCERS as u8);
        let mut rows = [row(INDEX, 0, Unsigned8, Const, highest); MAX_PRODUCERS + 1];
        let mut at = 1;
        while at <= MAX_PRODUCERS {
            let object = Object::ConsumerHeartbeatTime(at as u8);
            rows[at] = row(INDEX, at as u8, Unsigned32, ReadWrite, object).stored();
            at += 1;
        }
        rows
    };
    /// The rows of the object dictionary.
    pub const ALL: &'static [Entry] =
        if PRODUCERS > 0 { Self::OF_MOST.split_at(PRODUCERS + 1).0 } else { &[] };
}

impl<N: Numbers> Consumer<N> {
    /// A consumer with these entries.
    pub const fn new(producers: Producers<N>) -> Self {
        Self { producers, persistent: producers, watches: List::UNUSED }
    }

    /// Makes the entries in use the persistent ones.
    pub fn keep_current(&mut self) {
        self.persistent = self.producers;
    }

    /// Restarts as after power-on, with the persistent entries.
    pub fn reset(&mut self) {
        self.producers = self.persistent;
        self.watches.as_mut().fill(Watch::Waiting);
    }

    /// The COB-ID of the heartbeat of an entry, if it is watched.
    pub fn cob_id(&self, at: usize) -> Option<u16> {
        self.producers.0.as_ref().get(at)?.cob_id()
    }

    /// Grants all producers a new period, since nobody has sent heartbeats during a switch of the bit rate.
    pub fn restart(&mut self, now: Instant) {
        for (watch, producer) in self.watches.as_mut().iter_mut().zip(self.producers.0.as_ref()) {
            watch.restart(producer, now);
        }
    }

    /// Handles a frame that may be a heartbeat; passes boot-ups and heartbeats that are back to `handle`.
    pub fn handle_frame(&mut self, frame: &Frame, now: Instant, mut handle: impl FnMut(Event)) {
        for (watch, producer) in self.watches.as_mut().iter_mut().zip(self.producers.0.as_ref()) {
            let events = watch.handle(producer, frame, now);
            events.into_iter().flatten().for_each(&mut handle);
        }
    }

    /// The next producer whose heartbeat is missing at `now`.
    pub fn next_lost(&mut self, errors: &mut Emergency, now: Instant) -> Option<NodeId> {
        let at = self.watches.as_mut().iter_mut().position(|watch| watch.poll(now))?;
        let lost = self.producers.0.as_ref().get(at)?.node()?;
        errors.report(PROCESS_DATA, LOST, COMMUNICATION, [lost.get(), 0, 0, 0, 0]);
        Some(lost)
    }

    /// Ends the error of a missing heartbeat, if none is missing.
    pub fn end_errors(&self, errors: &mut Emergency) {
        if !self.watches.as_ref().iter().any(Watch::is_lost) {
            errors.end(PROCESS_DATA, LOST);
        }
    }

    /// The time at which [`next_lost`](Self::next_lost) has something to do.
    pub fn poll_at(&self) -> Option<Instant> {
        self.watches.as_ref().iter().filter_map(Watch::poll_at).reduce(Instant::earlier)
    }

    /// The value of a sub-index of 1016h.
    ///
    /// # Errors
    /// [`Abort::NoObject`] for sub-index 0 and behind the last entry.
    pub fn read(&self, sub_index: u8) -> Result<u32, Abort> {
        let at = usize::from(sub_index.wrapping_sub(1));
        self.producers.0.as_ref().get(at).map(Producer::value).ok_or(Abort::NoObject)
    }

    /// Sets a sub-index of 1016h.
    ///
    /// # Errors
    /// Those of [`Producers::set`].
    pub fn write(&mut self, sub_index: u8, value: u32) -> Result<(), Abort> {
        self.producers.set(sub_index, value)?;
        let at = usize::from(sub_index.wrapping_sub(1));
        if let Some(watch) = self.watches.as_mut().get_mut(at) {
            *watch = Watch::Waiting;
        }
        Ok(())
    }
}

impl<N: Numbers> Producers<N> {
    /// These entries.
    pub const fn new(producers: N::Producers<Producer>) -> Self {
        Self(producers)
    }

    /// Sets a sub-index.
    ///
    /// # Errors
    /// [`Abort::Incompatible`] if another entry watches the same node, [`Abort::InvalidValue`] for a reserved bit.
    pub fn set(&mut self, sub_index: u8, value: u32) -> Result<(), Abort> {
        let at = usize::from(sub_index.wrapping_sub(1));
        if value >> 24 != 0 {
            return Err(Abort::InvalidValue);
        }
        let wanted = Producer { node: (value >> 16) as u8, time_ms: value as u16 };
        let place = self.0.as_mut().get_mut(at).ok_or(Abort::NoSubIndex)?;
        let before = mem::replace(place, wanted);
        let mut same = self.0.as_ref().iter().filter(|other| other.node() == wanted.node());
        if wanted.node().is_some() && same.nth(1).is_some() {
            if let Some(place) = self.0.as_mut().get_mut(at) {
                *place = before;
            }
            return Err(Abort::Incompatible);
        }
        Ok(())
    }
}

/// The description of a row of 1016h.
pub(crate) fn describe(entry: &Entry, default: DefaultValue) -> Description {
    const NAME: &str = "Consumer heartbeat time";
    match entry.sub_index {
        0 => {
            let name = "Highest sub-index supported".into();
            Description { object: Some(NAME.into()), name, default, limits: None }
        }
        number => {
            let name = Name { text: NAME, number: Some(number) };
            Description { object: None, name, default, limits: None }
        }
    }
}

/// The entries of 1016h as an application declares them; panics, at compile time, with what is wrong.
pub(crate) const fn declared<A: Application + ?Sized, const PRODUCERS: usize>()
-> [Producer; PRODUCERS] {
    if PRODUCERS > MAX_PRODUCERS {
        DeclarationError::new("PRODUCERS is ")
            .number(PRODUCERS)
            .text(", at most 16 are possible")
            .raise();
    }
    let mut entries = [Producer::UNUSED; PRODUCERS];
    let mut at = 0;
    while at < A::WATCHED.len() {
        let (node, time_ms) = A::WATCHED[at];
        let error = DeclarationError::new("WATCHED: node ").number(node as usize);
        if at >= PRODUCERS {
            error.text(" is one more than PRODUCERS, which is ").number(PRODUCERS).raise();
        }
        if node == 0 || node > 127 {
            error.text(" does not exist: node-IDs are 1 to 127").raise();
        }
        if time_ms == 0 {
            error.text(" needs a time of 1 to 65535 ms").raise();
        }
        let mut before = 0;
        while before < at {
            if entries[before].node == node {
                error.text(" is watched twice").raise();
            }
            before += 1;
        }
        entries[at] = Producer { node, time_ms };
        at += 1;
    }
    entries
}

/// An entry of 1016h.
#[derive(Clone, Copy, Debug)]
pub struct Producer {
    node: u8,
    time_ms: u16,
}

/// What is known of the node of an entry.
#[derive(Clone, Copy, Debug)]
enum Watch {
    /// Nothing was received yet.
    Waiting,
    Alive {
        until: Instant,
    },
    Lost,
}

impl Watch {
    /// Handles a frame, which may be the producer's heartbeat, and returns what the application must know. A boot-up is
    /// the first heartbeat (CiA 301, 7.2.8.2.2.2).
    pub fn handle(
        &mut self,
        producer: &Producer,
        frame: &Frame,
        now: Instant,
    ) -> [Option<Event>; 2] {
        let (&[state], Some(node)) = (frame.data(), producer.node()) else {
            return [None; 2];
        };
        if producer.cob_id() != Some(frame.cob_id()) {
            return [None; 2];
        }
        let is_back = self.is_lost();
        *self = producer.is_at(now);
        let is_boot_up = state == nmt::State::Initialisation as u8;
        [is_back.then_some(Event::HeartbeatBack(node)), is_boot_up.then_some(Event::BootUp(node))]
    }

    /// Whether the heartbeat begins to be missing at `now`.
    pub fn poll(&mut self, now: Instant) -> bool {
        let is_missing = self.poll_at().is_some_and(|end| end.has_come(now));
        if is_missing {
            *self = Self::Lost;
        }
        is_missing
    }

    /// The time at which a heartbeat is missing.
    pub const fn poll_at(&self) -> Option<Instant> {
        match *self {
            Self::Alive { until } => Some(until),
            Self::Waiting | Self::Lost => None,
        }
    }

    /// Grants a new period.
    pub const fn restart(&mut self, producer: &Producer, now: Instant) {
        if let Self::Alive { .. } = self {
            *self = producer.is_at(now);
        }
    }

    pub const fn is_lost(&self) -> bool {
        matches!(self, Self::Lost)
    }
}

impl Element for Watch {
    const UNUSED: Self = Self::Waiting;
}

impl Element for Producer {
    const UNUSED: Self = Self { node: 0, time_ms: 0 };
}

impl Producer {
    /// The node that is watched. An entry without a time or with another node-ID is not used.
    pub fn node(&self) -> Option<NodeId> {
        NodeId::new(self.node).filter(|_| self.time_ms != 0)
    }

    /// The COB-ID of the heartbeat, if one is expected.
    pub fn cob_id(&self) -> Option<u16> {
        self.node().map(|node| nmt::ERROR_CONTROL_COB_ID + u16::from(node.get()))
    }

    const fn is_at(&self, now: Instant) -> Watch {
        Watch::Alive { until: now.plus_micros(self.time_ms as u32 * 1000) }
    }

    /// The value of the entry.
    pub fn value(&self) -> u32 {
        u32::from(self.node) << 16 | u32::from(self.time_ms)
    }
}
