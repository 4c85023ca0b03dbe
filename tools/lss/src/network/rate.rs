//! The bit rate of a network: what is heard at one, and who answers there.

use std::{collections::BTreeMap, time::Duration};

use can_bus::{bus::bits, explain::explain};
use canopen_node::{BitRate, lss::Request};

use super::nodes;
use crate::{failure::Result, session::Session};

/// The wait for a frame on a bus where nodes send heartbeats, in general one a second.
pub const HEARTBEAT: Duration = Duration::from_millis(1150);

/// The time in which a frame is repeated at any bit rate.
const REPETITION: Duration = Duration::from_millis(20);
/// The time in which a board that looks for the bit rate comes to that of a repeated frame, and the bits of these
/// frames: the adapter must be error passive before they are valid for a listener.
const SEARCH: Duration = Duration::from_millis(100);
const SEARCH_BITS: u32 = 5_500;

/// What a bit rate showed.
#[derive(Default)]
pub struct Sight {
    /// The frames heard, in words, with their number.
    pub heard: BTreeMap<String, usize>,
    /// A board without a node-ID answers.
    pub has_blank: bool,
    /// The node-IDs that answer.
    pub nodes: Vec<u8>,
    pub has_errors: bool,
    /// The adapter has reported no errors: somebody acknowledges its frames, unless it never reports any.
    pub is_acknowledged: bool,
}

impl Sight {
    /// A board answers.
    pub fn has_answer(&self) -> bool {
        self.has_blank || !self.nodes.is_empty()
    }
}

/// The first of these bit rates at which a frame is heard.
pub fn heard_at(session: &mut Session, rates: &[BitRate]) -> Result<Option<BitRate>> {
    for &rate in rates {
        session.progress.say(|| format!("listening at {rate}"));
        session.bus.listen(rate)?;
        if session.bus.wait_for(HEARTBEAT, |_| true)?.is_some() {
            return Ok(Some(rate));
        }
    }
    Ok(None)
}

/// Asks at a bit rate that may be wrong. The adapter stays there.
pub fn answers_at(session: &mut Session, rate: BitRate) -> Result<Sight> {
    let mut sight = Sight::default();
    ask(session, rate, &mut sight)?;
    Ok(sight)
}

/// Listens without a sign of life on the bus.
pub fn listen(session: &mut Session, rate: BitRate) -> Result<Sight> {
    session.bus.listen(rate)?;
    let mut sight = Sight::default();
    for received in session.bus.collect(HEARTBEAT)? {
        let words = explain(received.frame.cob_id(), received.frame.data());
        *sight.heard.entry(words).or_default() += 1;
    }
    sight.has_errors = session.bus.status()?.is_some_and(|status| status.has_errors);
    Ok(sight)
}

/// Asks by identify non-configured remote slave, again and again in the time in which a board comes that looks for the
/// bit rate.
pub fn ask(session: &mut Session, rate: BitRate, sight: &mut Sight) -> Result {
    session.bus.open(rate)?;
    let until = session.bus.time() + SEARCH + bits(SEARCH_BITS, rate);
    let mut status;
    loop {
        sight.has_blank |= session.bus.probe(Request::IdentifyNonConfigured)?.is_some();
        status = session.bus.status()?;
        let has_errors = status.is_some_and(|status| status.has_errors || status.is_error_passive);
        sight.has_errors |= has_errors;
        let is_undisturbed = status.is_some() && !sight.has_errors;
        if is_undisturbed || session.bus.time() >= until {
            break;
        }
        // A frame that nobody acknowledges is repeated without end.
        session.bus.pass(REPETITION)?;
    }
    sight.is_acknowledged = status.is_some_and(|status| !status.has_errors);
    // Nobody answers to frames that nobody acknowledges.
    if !sight.has_blank && status.is_none_or(|status| !status.has_errors) {
        name(session, sight)?;
    }
    Ok(())
}

/// Asks each node for its serial number, if none has answered so far.
pub fn name(session: &mut Session, sight: &mut Sight) -> Result {
    if sight.nodes.is_empty() {
        sight.nodes = nodes::nodes(session)?.into_keys().collect();
    }
    Ok(())
}
