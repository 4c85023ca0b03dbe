//! The frames of a run: as a log of `candump`, in words, and for a picture.

use std::{
    cell::RefCell,
    fs::File,
    io::Write,
    rc::Rc,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use can_bus::{
    bus::{Bus, What},
    explain::explain,
    stop::Stop,
};
use canopen_node::Frame;

use crate::{arguments::Arguments, failure::Result};

/// The name of the bus in a log.
const INTERFACE: &str = "can0";

/// What the adapter did, with the time since the start.
#[derive(Clone, Debug)]
pub struct Entry {
    pub at: Duration,
    pub what: What,
}

/// The record of a run, for a picture.
pub struct Record {
    pub entries: Rc<RefCell<Vec<Entry>>>,
    /// The time of day at the start, since 1970.
    pub time_of_day: Duration,
}

/// Writes each frame down that comes or goes from now on: to a new file and to the standard error, if the user says so.
/// Returns the record that a picture needs.
pub fn record(bus: &mut Bus, arguments: &Arguments) -> Result<Option<Record>> {
    let mut log = None;
    if let Some(path) = &arguments.log {
        let cannot = |error| Stop::Bench(format!("cannot write {}: {error}", path.display()));
        log = Some(File::create(path).map_err(cannot)?);
    }
    let time_of_day = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let entries = Rc::<RefCell<Vec<Entry>>>::default();
    let record = Record { entries: Rc::clone(&entries), time_of_day };
    let (start, explains, draws) = (bus.time(), arguments.explain, arguments.svg.is_some());
    bus.watch(move |what, now| {
        let at = now.saturating_duration_since(start);
        if let What::Sent(frame) | What::Received(frame) = &what {
            if let Some(log) = &mut log {
                log.write_all(candump(frame, time_of_day + at).as_bytes())
                    .map_err(|error| Stop::Bench(format!("cannot write the log: {error}")))?;
            }
            if explains {
                eprintln!("{}", line(frame, at));
            }
        }
        if draws {
            entries.borrow_mut().push(Entry { at, what });
        }
        Ok(())
    });
    Ok(draws.then_some(record))
}

/// A line of `candump -l`.
fn candump(frame: &Frame, time: Duration) -> String {
    let data: String = frame.data().iter().map(|byte| format!("{byte:02X}")).collect();
    let (seconds, micros) = (time.as_secs(), time.subsec_micros());
    format!("({seconds:010}.{micros:06}) {INTERFACE} {:03X}#{data}\n", frame.cob_id())
}

/// A frame in words, and the time since the start in seconds.
pub fn line(frame: &Frame, span: Duration) -> String {
    format!("{:9.3}  {}", span.as_secs_f64(), words(frame))
}

/// A frame, and what it means.
pub fn words(frame: &Frame) -> String {
    let data: Vec<String> = frame.data().iter().map(|byte| format!("{byte:02X}")).collect();
    let meaning = explain(frame.cob_id(), frame.data());
    format!("{:03X}  {:23}  {meaning}", frame.cob_id(), data.join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_a_line_of_candump_and_a_line_in_words() {
        let frame = Frame::new(0x7E4, &[0x5E, 5, 0, 0, 0, 0, 0, 0]).expect("a frame");
        let time = Duration::from_micros(1_500_000_000_250_000);
        assert_eq!(candump(&frame, time), "(1500000000.250000) can0 7E4#5E05000000000000\n");
        assert_eq!(
            line(&frame, Duration::from_millis(1_250)),
            "    1.250  7E4  5E 05 00 00 00 00 00 00  LSS node-ID is 5"
        );
    }
}
