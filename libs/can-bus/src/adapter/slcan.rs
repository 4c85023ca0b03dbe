//! An adapter that speaks SLCAN, over a serial line or TCP.

use std::{
    collections::VecDeque,
    io::{self, Read, Write},
    net::{TcpStream, ToSocketAddrs},
    time::{Duration, Instant},
};

use canopen_node::{BitRate, Frame};

use super::{Adapter, HOST_CLOCK, Mode, Place, Received, Status, is_timeout};
use crate::{
    slcan::{self, END, LF, LINE, RATES, REFUSED, STAMPS_MS},
    stop::Stop,
};

/// The wait for the answer to a command; some adapters answer none.
const ANSWER: Duration = Duration::from_millis(300);
/// The time in which an adapter starts that is reset when its line is opened.
const START: Duration = Duration::from_secs(3);
/// The number of questions by which the latency is measured.
const QUESTIONS: usize = 5;
/// The wait for a connection, and for a line to take what is written.
const CONNECTION: Duration = Duration::from_secs(3);

/// A line to the adapter, with bounded waits.
pub trait Port: Read + Write {
    /// Bounds the reads that follow.
    fn set_wait(&mut self, wait: Duration) -> io::Result<()>;
    /// The time, which passes while it waits.
    fn now(&self) -> Instant {
        Instant::now()
    }
}

impl Port for TcpStream {
    fn set_wait(&mut self, wait: Duration) -> io::Result<()> {
        self.set_read_timeout(Some(wait))
    }
}

impl Port for Box<dyn serialport::SerialPort> {
    fn set_wait(&mut self, wait: Duration) -> io::Result<()> {
        Ok(self.set_timeout(wait)?)
    }
}

pub struct Slcan {
    place: Place,
    /// `None` after an error.
    port: Option<Box<dyn Port>>,
    /// Bytes of an incomplete line.
    line: Vec<u8>,
    /// The last line has ended with a carriage return.
    has_return: bool,
    inbox: VecDeque<Received>,
    /// The line in which the adapter reports its version.
    version: Option<String>,
    /// It has answered nothing at all.
    is_mute: bool,
    /// It was to listen only, and cannot.
    drives_bus: bool,
    /// Whether it answers to frames, if that is known.
    confirms: Option<bool>,
    /// The frames that it has not answered to, and until when each is sent again if it finds the queue full.
    unconfirmed: VecDeque<(String, Instant)>,
    /// The queue was full: so that frames keep their order, each waits for the answer to the one before.
    is_narrow: bool,
    /// It refused a frame until that time was over, and has taken none since.
    is_full: bool,
    latency: Option<Duration>,
    reports_status: bool,
    has_reported_status: bool,
    stamps: Option<Stamps>,
}

/// The adapter's clock, continued over its wraps.
struct Stamps {
    last_ms: u64,
    last_here: Instant,
}

/// A line from the adapter.
#[derive(Debug, PartialEq, Eq)]
enum Line {
    /// A frame that this program can hold, and the adapter's time in ms.
    Frame(Frame, Option<u64>),
    /// Any other frame.
    Other,
    /// The answer to a command: the line without its end, which is empty if it has only taken it.
    Answer(Vec<u8>),
    /// The answer to a command that is unknown, or not possible now.
    Refused,
}

impl Slcan {
    /// The adapter at the other end of a line, which is asked for its version.
    pub fn new(place: Place, port: Box<dyn Port>) -> Result<Self, Stop> {
        let mut adapter = Self::unasked(place, Some(port));
        adapter.greet()?;
        Ok(adapter)
    }

    fn unasked(place: Place, port: Option<Box<dyn Port>>) -> Self {
        Self {
            place,
            port,
            line: Vec::new(),
            has_return: false,
            inbox: VecDeque::new(),
            version: None,
            is_mute: false,
            drives_bus: false,
            confirms: None,
            unconfirmed: VecDeque::new(),
            is_narrow: false,
            is_full: false,
            latency: None,
            reports_status: true,
            has_reported_status: false,
            stamps: None,
        }
    }

    fn greet(&mut self) -> Result<(), Stop> {
        self.line.clear();
        self.unconfirmed.clear();
        (self.stamps, self.version) = (None, None);
        // End any earlier line, and leave the bus.
        self.write(b"\r\rC\r")?;
        self.is_mute = self.skip(ANSWER)? == 0;
        // What an adapter prints at its start is no version: that comes twice.
        let until = self.now() + START;
        let mut last = None;
        while self.now() < until {
            let answer = self.command("V", is_version)?;
            self.is_mute &= answer.is_none();
            if answer.is_some() && answer == last {
                break;
            }
            last = answer;
        }
        if let Some(Line::Answer(line)) = last {
            self.version = Some(String::from_utf8_lossy(&line).into_owned());
        }
        let mut latencies = Vec::new();
        for _ in 0..QUESTIONS * usize::from(self.version.is_some()) {
            let begin = self.now();
            if self.command("V", is_version)?.is_some() {
                latencies.push(self.now().duration_since(begin));
            }
        }
        latencies.sort();
        self.latency = latencies.get(latencies.len() / 2).copied();
        // It may have missed the first.
        self.tell("C")?;
        self.tell("Z1")?;
        Ok(())
    }

    /// Skips what comes within `wait`; returns the number of lines.
    fn skip(&mut self, wait: Duration) -> Result<usize, Stop> {
        let until = self.now() + wait;
        let mut count = 0;
        while self.read_line(until)?.is_some() {
            count += 1;
        }
        Ok(count)
    }

    /// Sends a command and waits for the line that answers it; others are skipped. Frames that come before are kept.
    fn command(
        &mut self,
        command: &str,
        is_answer: fn(&[u8]) -> bool,
    ) -> Result<Option<Line>, Stop> {
        self.wait_for_confirmation()?;
        self.write(format!("{command}\r").as_bytes())?;
        let until = self.now() + ANSWER;
        loop {
            match self.read_line(until)? {
                None => return Ok(None),
                Some(Line::Refused) => return Ok(Some(Line::Refused)),
                Some(Line::Answer(line)) if is_answer(&line) => {
                    return Ok(Some(Line::Answer(line)));
                }
                Some(_) => {}
            }
        }
    }

    /// Sends a command or a frame; returns whether the adapter takes it, `None` if it answers nothing. The version, for
    /// which it is asked right behind, ends the wait.
    fn tell(&mut self, command: &str) -> Result<Option<bool>, Stop> {
        self.wait_for_confirmation()?;
        let question = if self.version.is_some() { "V\r" } else { "" };
        self.write(format!("{command}\r{question}").as_bytes())?;
        let until = self.now() + ANSWER;
        let mut takes = None;
        while takes.is_none() || self.version.is_some() {
            match self.read_line(until)? {
                None => break,
                Some(Line::Refused) => takes = Some(false),
                Some(Line::Answer(line)) if line.is_empty() => takes = takes.or(Some(true)),
                Some(Line::Answer(line)) if is_version(&line) => break,
                Some(_) => {}
            }
        }
        Ok(takes)
    }

    fn transmit(&mut self, frame: slcan::Frame) -> Result<(), Stop> {
        let line = frame.to_string();
        if self.confirms.is_none() {
            let takes = self.tell(&line)?;
            self.confirms = Some(takes.is_some());
            if takes != Some(false) {
                return Ok(());
            }
        }
        if self.is_narrow {
            self.wait_for_confirmation()?;
        }
        self.write(format!("{line}\r").as_bytes())?;
        if self.confirms == Some(true) {
            let wait = if self.is_full { Duration::ZERO } else { ANSWER };
            self.unconfirmed.push_back((line, self.now() + wait));
        }
        Ok(())
    }

    /// Waits for the answers to all frames.
    fn wait_for_confirmation(&mut self) -> Result<(), Stop> {
        let until = self.now() + ANSWER;
        while !self.unconfirmed.is_empty() && self.read_line(until)?.is_some() {}
        self.unconfirmed.clear();
        Ok(())
    }

    /// Takes an answer for that to the first frame without one. A frame that found the queue full is sent again.
    fn confirm(&mut self, line: &Line) -> Result<(), Stop> {
        let is_refused = *line == Line::Refused;
        if !is_refused && *line != Line::Answer(Vec::new()) {
            return Ok(());
        }
        let Some((frame, until)) = self.unconfirmed.pop_front() else { return Ok(()) };
        self.is_full = is_refused && self.now() >= until;
        self.is_narrow |= is_refused;
        if is_refused && !self.is_full {
            self.write(format!("{frame}\r").as_bytes())?;
            self.unconfirmed.push_back((frame, until));
        }
        Ok(())
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), Stop> {
        let Some(port) = &mut self.port else { return Err(self.gone("it was closed")) };
        port.write_all(bytes).and_then(|()| port.flush()).map_err(|error| self.lose(error))
    }

    /// The next line, if it is complete before `until`. A frame is also put in the inbox.
    fn read_line(&mut self, until: Instant) -> Result<Option<Line>, Stop> {
        loop {
            let end = self.line.iter().position(|byte| [END, LF, REFUSED].contains(byte));
            if let Some(end) = end {
                let line: Vec<u8> = self.line.drain(..=end).collect();
                // Some adapters end their lines with both.
                if line == [LF] && std::mem::take(&mut self.has_return) {
                    continue;
                }
                self.has_return = line.ends_with(&[END]);
                let line = parse(&line);
                if let Line::Frame(frame, stamp) = line {
                    let here = self.now();
                    let at = self.time(stamp, here);
                    self.inbox.push_back(Received { frame, at, here });
                }
                self.confirm(&line)?;
                return Ok(Some(line));
            }
            if self.line.len() > LINE {
                self.line.clear();
            }
            let wait = until.saturating_duration_since(self.now());
            if wait.is_zero() {
                return Ok(None);
            }
            let Some(port) = &mut self.port else { return Err(self.gone("it was closed")) };
            let mut bytes = [0; 512];
            let read = port
                .set_wait(wait.max(Duration::from_millis(1)))
                .and_then(|()| port.read(&mut bytes));
            match read {
                Ok(0) => return Err(self.lose(io::Error::other("the connection was closed"))),
                Ok(count) => self.line.extend(&bytes[..count]),
                Err(error) if is_timeout(&error) => {}
                Err(error) => return Err(self.lose(error)),
            }
        }
    }

    /// The time of a frame on the clock of [`Adapter::clock`].
    fn time(&mut self, stamp: Option<u64>, here: Instant) -> Duration {
        static START: std::sync::OnceLock<Instant> = std::sync::OnceLock::new();
        let start = *START.get_or_init(Instant::now);
        let Some(stamp) = stamp else { return here.saturating_duration_since(start) };
        let last = self.stamps.get_or_insert(Stamps { last_ms: stamp, last_here: here });
        let passed = here.duration_since(last.last_here).as_millis() as u64;
        let step = (stamp + STAMPS_MS - last.last_ms % STAMPS_MS) % STAMPS_MS;
        // The multiple of the range that is closest to the time passed here.
        let wraps = (passed + STAMPS_MS / 2).saturating_sub(step) / STAMPS_MS;
        last.last_ms += step + wraps * STAMPS_MS;
        last.last_here = here;
        Duration::from_millis(last.last_ms)
    }

    fn lose(&mut self, error: io::Error) -> Stop {
        self.port = None;
        self.gone(&error.to_string())
    }

    fn gone(&self, why: &str) -> Stop {
        Stop::AdapterGone(format!("{}: {why}", self.place))
    }
}

/// Connects to the adapter at this place.
pub fn connect(place: &Place) -> Result<Box<dyn Port>, Stop> {
    let none = |why: String| Stop::NoAdapter(format!("{place}: {why}"));
    match place {
        Place::Tcp(address) => {
            let addresses = address.to_socket_addrs().map_err(|error| none(error.to_string()))?;
            let mut last = none("the host has no address".into());
            for address in addresses {
                match TcpStream::connect_timeout(&address, CONNECTION) {
                    Ok(stream) => {
                        // Without this option only the latency is worse.
                        let _ = stream.set_nodelay(true);
                        let bounded = stream.set_write_timeout(Some(CONNECTION));
                        bounded.map_err(|error| none(error.to_string()))?;
                        return Ok(Box::new(stream));
                    }
                    Err(error) => last = none(format!("{error}. Does `cargo emulate` run there?")),
                }
            }
            Err(last)
        }
        Place::Serial { device, baud } => match serialport::new(device, *baud)
            .timeout(CONNECTION)
            .open()
        {
            Ok(port) => Ok(Box::new(port)),
            Err(error) => {
                let ports = serialport::available_ports().unwrap_or_default();
                let names: Vec<_> = ports.into_iter().map(|port| port.port_name).collect();
                let there = match names.is_empty() {
                    true => "there is no serial port at all: is the adapter plugged in?".to_owned(),
                    false => format!("the serial ports are {}", names.join(", ")),
                };
                Err(none(format!("{error}; {there}")))
            }
        },
        Place::SocketCan { .. } => Err(none("it is no serial line".into())),
    }
}

impl Adapter for Slcan {
    fn open(&mut self, rate: BitRate, mode: Mode) -> Result<(), Stop> {
        match self.port {
            None => {
                self.port = Some(connect(&self.place)?);
                self.greet()?;
            }
            Some(_) => self.close()?,
        }
        self.confirms = None;
        let index = RATES.iter().position(|kbit| *kbit == rate.kbit_per_s()).unwrap_or_default();
        let answer = self.tell(&format!("S{index}"))?;
        if answer == Some(false) {
            return Err(Stop::NoBitRate(format!("{} refuses {rate}", self.place)));
        }
        let listens = mode == Mode::ListenOnly;
        let has_listen_only = listens && self.tell("L")? == Some(true);
        // The firmware of a CANable answers no command, and has a mode for it. Another one refuses or ignores this.
        if answer.is_none() {
            self.tell(if listens { "M1" } else { "M0" })?;
        }
        self.drives_bus |= listens && !has_listen_only && answer.is_some();
        if !has_listen_only && self.tell("O")? == Some(false) {
            return Err(Stop::NoAdapter(format!("{} refuses to open its channel", self.place)));
        }
        // Errors before this moment do not count.
        self.status()?;
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        // It is refused if the channel is closed. Answers to frames that were dropped may precede it.
        self.unconfirmed.clear();
        self.tell("C")?;
        if self.version.is_none() {
            self.skip(ANSWER / 4)?;
        }
        self.inbox.clear();
        Ok(())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        self.transmit(slcan::Frame::new(frame.cob_id().into(), false, frame.data()))
    }

    fn send_remote(&mut self, cob_id: u16, length: u8) -> Result<bool, Stop> {
        let frame = slcan::Frame::new(cob_id.into(), false, &[]);
        self.transmit(slcan::Frame { is_remote: true, length, ..frame })?;
        Ok(true)
    }

    fn send_extended(&mut self, id: u32, data: &[u8]) -> Result<bool, Stop> {
        self.transmit(slcan::Frame::new(id, true, data))?;
        Ok(true)
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        let until = self.now() + wait;
        while self.inbox.is_empty() && self.read_line(until)?.is_some() {}
        Ok(self.inbox.pop_front())
    }

    fn status(&mut self) -> Result<Option<Status>, Stop> {
        if !self.reports_status {
            return Ok(None);
        }
        let flags = match self.command("F", |line| line.starts_with(b"F"))? {
            Some(Line::Answer(line)) => parse_flags(&line),
            _ => None,
        };
        // A refusal may also belong to a frame that found the queue full.
        self.reports_status = flags.is_some() || self.has_reported_status;
        self.has_reported_status |= flags.is_some();
        Ok(flags)
    }

    fn settle(&mut self) -> Result<(), Stop> {
        if self.version.is_some() {
            self.command("V", is_version)?;
        }
        self.wait_for_confirmation()
    }

    fn now(&self) -> Instant {
        self.port.as_ref().map_or_else(Instant::now, |port| port.now())
    }

    fn clock(&self) -> &'static str {
        match self.stamps {
            Some(_) => "the adapter's time stamps, in steps of 1 ms",
            None => HOST_CLOCK,
        }
    }

    fn latency(&self) -> Option<Duration> {
        self.latency
    }

    fn description(&self) -> String {
        match &self.version {
            Some(version) => {
                format!("{}, version {}", self.place, version.trim_start_matches('V'))
            }
            None => format!("{}, which reports no version", self.place),
        }
    }

    fn doubts(&self) -> Vec<String> {
        let place = &self.place;
        let mut doubts = Vec::new();
        if self.is_mute {
            let speed = match place {
                Place::Serial { device, .. } => {
                    format!(" Does its line need another speed (slcan:{device}@BAUD)?")
                }
                _ => String::new(),
            };
            doubts.push(format!(
                "{place} opens, but answers no SLCAN command within 3 s. Is it the CAN adapter, and does its firmware speak \
                 SLCAN?{speed}"
            ));
        }
        if self.drives_bus {
            doubts.push(format!(
                "{place} cannot listen only: at a wrong bit rate it disturbs the network while it listens"
            ));
        }
        doubts
    }
}

/// Whether a line is the answer to `V`, which need not begin so.
fn is_version(line: &[u8]) -> bool {
    !line.is_empty() && parse_flags(line).is_none()
}

/// The flags in the answer to `F`.
fn parse_flags(line: &[u8]) -> Option<Status> {
    let flags = slcan::hex(str::from_utf8(line.strip_prefix(b"F")?).ok()?)? as u8;
    let is = |flag| flags & flag != 0;
    Some(Status { is_error_passive: is(slcan::ERROR_PASSIVE), has_errors: is(slcan::BUS_ERROR) })
}

/// A line with its end.
fn parse(line: &[u8]) -> Line {
    let Some((&end, line)) = line.split_last() else { return Line::Refused };
    if end == REFUSED {
        return Line::Refused;
    }
    match line.first() {
        Some(b't') => parse_frame(line).unwrap_or(Line::Other),
        // The answers to a frame that is sent.
        Some(b'z' | b'Z') => Line::Answer(Vec::new()),
        Some(b'T' | b'r' | b'R') => Line::Other,
        _ => Line::Answer(line.to_vec()),
    }
}

fn parse_frame(line: &[u8]) -> Option<Line> {
    let (frame, stamp) = slcan::Frame::parse(str::from_utf8(line).ok()?)?;
    Some(Line::Frame(Frame::new(frame.id as u16, frame.data())?, stamp))
}

#[cfg(test)]
mod tests {
    use std::{cell::RefCell, rc::Rc};

    use super::*;

    /// An adapter that answers its commands with these lines, one for each.
    struct Script {
        answers: VecDeque<&'static [u8]>,
        unread: Vec<u8>,
        commands: Rc<RefCell<String>>,
    }

    impl Read for Script {
        fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
            let answer = std::mem::take(&mut self.unread);
            bytes[..answer.len()].copy_from_slice(&answer);
            Ok(answer.len())
        }
    }

    impl Write for Script {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.unread.extend(self.answers.pop_front().expect("it is asked no more"));
            *self.commands.borrow_mut() += &String::from_utf8_lossy(bytes).replace('\r', " ");
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Port for Script {
        fn set_wait(&mut self, _: Duration) -> io::Result<()> {
            Ok(())
        }
    }

    /// The adapter that answers so, and the commands that it gets.
    fn adapter(answers: &[&'static [u8]]) -> (Slcan, Rc<RefCell<String>>) {
        let commands = Rc::<RefCell<String>>::default();
        let answers = answers.iter().copied().collect();
        let script = Script { answers, unread: Vec::new(), commands: Rc::clone(&commands) };
        (Slcan::unasked(Place::Tcp("a test".into()), Some(Box::new(script))), commands)
    }

    #[test]
    fn an_adapter_is_opened_at_a_rate_and_sends_each_kind_of_frame() {
        // It was closed before. Behind each answer is the version.
        const TAKEN: &[u8] = b"\rV1013\r";
        let opened = [b"\x07V1013\r", TAKEN, TAKEN, b"F00\r"];
        let answers = [&opened[..], &[b"z\rV1013\r", b"z\r", b"Z\r"]].concat();
        let (mut adapter, commands) = adapter(&answers);
        adapter.version = Some("V1013".into());
        adapter.open(BitRate::Kbit500, Mode::ListenOnly).expect("it is opened");
        let frame = Frame::new(0x7E5, &[0x5E, 5]).expect("a frame");
        adapter.send(&frame).expect("it is sent");
        assert_eq!(adapter.send_remote(0x701, 1).ok(), Some(true));
        assert_eq!(adapter.send_extended(0x7E5, &[4]).ok(), Some(true));
        assert_eq!(*commands.borrow(), "C V S6 V L V F t7E525E05 V r7011 T000007E5104 ");
    }

    #[test]
    fn what_an_adapter_refuses_is_named() {
        for (refused, what) in [(1, "500 kbit/s"), (2, "to open its channel")] {
            let mut answers = [b"\rV1013\r".as_slice(); 3];
            answers[refused] = b"\x07V1013\r";
            let (mut adapter, commands) = adapter(&answers);
            adapter.version = Some("V1013".into());
            let error = adapter.open(BitRate::Kbit500, Mode::Normal).expect_err("a refusal");
            assert!(error.to_string().ends_with(&format!(" refuses {what}")), "{error}");
            assert!("C V S6 V O V ".starts_with(&*commands.borrow()));
        }
    }

    #[test]
    fn a_frame_that_finds_the_queue_full_is_sent_again_before_the_next() {
        const FULL: &[u8] = b"\x07";
        let answers = [b"z\r".as_slice(), b"z\r", FULL, FULL, b"z\r", FULL, b"z\r", b"z\r"];
        let (mut adapter, commands) = adapter(&answers);
        for byte in 1..=5 {
            adapter.send(&Frame::new(0x7E5, &[byte]).expect("a frame")).expect("it is sent");
            // It is known from the first refusal on.
            if byte == 3 {
                adapter.settle().expect("it is there");
            }
        }
        adapter.settle().expect("it is there");
        assert_eq!(
            *commands.borrow(),
            "t7E5101 t7E5102 t7E5103 t7E5103 t7E5103 t7E5104 t7E5104 t7E5105 "
        );
    }

    #[test]
    fn time_stamps_go_on_over_their_wraps() {
        let (mut adapter, _) = adapter(&[]);
        let begin = Instant::now();
        // The stamp, the time passed here and the time that is to be found, in ms.
        let cases = [
            (59_990, 0, 59_990),
            (59_999, 7, 59_999),
            // A wrap; 60 s here that are a little less or more there; five minutes; and frames that came together.
            (1, 11, 60_001),
            (59_981, 60_011, 119_981),
            (20, 120_011, 180_020),
            (21, 420_011, 480_021),
            (121, 420_011, 480_121),
        ];
        for (stamp, here, time) in cases {
            let found = adapter.time(Some(stamp), begin + Duration::from_millis(here));
            assert_eq!(found, Duration::from_millis(time), "{stamp} after {here} ms");
        }
    }

    #[test]
    fn an_adapter_that_reported_its_status_once_is_asked_again() {
        let passive = Some(Status { is_error_passive: true, has_errors: false });
        // A refusal, as of a frame that found the queue full.
        let (mut reports, _) = adapter(&[b"F00\r", b"\x07", b"F20\r"]);
        let found = [(); 3].map(|()| reports.status().expect("it is there"));
        assert_eq!(found, [Some(Status::default()), None, passive]);
        let (mut reports_never, _) = adapter(&[b"\x07"]);
        let found = [(); 2].map(|()| reports_never.status().expect("it is there"));
        assert_eq!(found, [None, None]);
    }

    #[test]
    fn lines_of_adapters_are_read() {
        let frame = Frame::new(0x7E4, &[0x5E, 5]).expect("a frame");
        assert_eq!(parse(b"t7E425E05\r"), Line::Frame(frame, None));
        assert_eq!(parse(b"t7E425E05EA5F\r"), Line::Frame(frame, Some(59_999)));
        assert_eq!(parse(b"\r"), Line::Answer(vec![]));
        assert_eq!(parse(b"\x07"), Line::Refused);
        assert_eq!(parse(b"V1013\r"), Line::Answer(b"V1013".to_vec()));
        assert_eq!(parse(b"z\r"), Line::Answer(vec![]));
        for other in ["T000007E50\r", "r7E40\r", "t7E4\r"] {
            assert_eq!(parse(other.as_bytes()), Line::Other, "{other:?}");
        }
        assert_eq!(parse_flags(b"FA4"), Some(Status { is_error_passive: true, has_errors: true }));
        assert_eq!(parse_flags(b"F00"), Some(Status::default()));
        assert_eq!(parse_flags(b"V1013"), None);
    }
}
