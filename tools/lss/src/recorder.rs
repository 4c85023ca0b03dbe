//! An adapter that writes down each frame: for `candump` and in words.

use std::{
    cell::RefCell,
    fs::File,
    io::Write,
    path::Path,
    rc::Rc,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use can_bus::{
    adapter::{Adapter, Mode, Received, Status},
    explain::explain,
    stop::Stop,
};
use canopen_node::{BitRate, Frame};

/// The name of the bus in a log.
const INTERFACE: &str = "can0";

/// What an adapter did, with the time since the start.
#[derive(Clone, Debug)]
pub struct Entry {
    pub at: Duration,
    pub what: What,
}

#[derive(Clone, Debug)]
pub enum What {
    Opened(BitRate),
    Sent(Frame),
    Received(Frame),
}

/// The record of a run, for a picture.
#[derive(Clone, Debug, Default)]
pub struct Record {
    pub entries: Rc<RefCell<Vec<Entry>>>,
    /// The time of day at the start, since 1970.
    pub time_of_day: Duration,
}

/// An adapter, and the record of its frames.
pub struct Recorder {
    adapter: Box<dyn Adapter>,
    log: Option<File>,
    explains: bool,
    start: Instant,
    /// The time of day at the start.
    time_of_day: Duration,
    record: Option<Record>,
}

impl Recorder {
    /// Records to a new file `log`, and in words to the standard error if it `explains`.
    pub fn new(
        adapter: Box<dyn Adapter>,
        log: Option<&Path>,
        explains: bool,
    ) -> Result<Self, Stop> {
        let create = |path: &Path| {
            let file = File::create(path);
            file.map_err(|error| Stop::Bench(format!("cannot write {}: {error}", path.display())))
        };
        let log = log.map(create).transpose()?;
        let start = adapter.now();
        let time_of_day = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Ok(Self { adapter, log, explains, start, time_of_day, record: None })
    }

    /// Keeps everything from now on.
    pub fn keep(&mut self) -> Record {
        let record = Record { time_of_day: self.time_of_day, ..Record::default() };
        self.record.insert(record).clone()
    }

    fn note(&self, here: Instant, what: What) {
        if let Some(Record { entries, .. }) = &self.record {
            let at = here.saturating_duration_since(self.start);
            entries.borrow_mut().push(Entry { at, what });
        }
    }

    fn record(&mut self, frame: &Frame, here: Instant) -> Result<(), Stop> {
        let span = here.saturating_duration_since(self.start);
        if let Some(log) = &mut self.log {
            log.write_all(candump(frame, self.time_of_day + span).as_bytes())
                .map_err(|error| Stop::Bench(format!("cannot write the log: {error}")))?;
        }
        if self.explains {
            eprintln!("{}", line(frame, span));
        }
        Ok(())
    }
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

impl Adapter for Recorder {
    fn open(&mut self, rate: BitRate, mode: Mode) -> Result<(), Stop> {
        self.adapter.open(rate, mode)?;
        self.note(self.adapter.now(), What::Opened(rate));
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        self.adapter.close()
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        let now = self.adapter.now();
        self.record(frame, now)?;
        self.note(now, What::Sent(*frame));
        self.adapter.send(frame)
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        let received = self.adapter.receive(wait)?;
        if let Some(received) = &received {
            self.record(&received.frame, received.here)?;
            self.note(received.here, What::Received(received.frame));
        }
        Ok(received)
    }

    fn status(&mut self) -> Result<Option<Status>, Stop> {
        self.adapter.status()
    }

    fn settle(&mut self) -> Result<(), Stop> {
        self.adapter.settle()
    }

    fn now(&self) -> Instant {
        self.adapter.now()
    }

    fn clock(&self) -> &'static str {
        self.adapter.clock()
    }

    fn fixed_rate(&self) -> Option<BitRate> {
        self.adapter.fixed_rate()
    }

    fn latency(&self) -> Option<Duration> {
        self.adapter.latency()
    }

    fn description(&self) -> String {
        self.adapter.description()
    }

    fn doubts(&self) -> Vec<String> {
        self.adapter.doubts()
    }
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
