//! The tool's adapter on the bus within the process, as firmwares of SLCAN adapters behave: its serial line, in virtual
//! time.

use std::{
    collections::VecDeque,
    io::{self, Read, Write},
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, Place, Port, Slcan},
    slcan::{BUS_ERROR, END, Frame, RATES, REFUSED},
    stop::Stop,
};
use canopen_node::{Application, BitRate};

use super::{BusAdapter, NEVER, Source};

/// How the firmware of an adapter behaves.
#[derive(Clone, Copy, Debug)]
pub struct Firmware {
    /// The answer to `V`, if it answers.
    pub version: Option<&'static str>,
    /// Whether it answers to commands and frames that it takes, and refuses others.
    pub answers: bool,
    /// The command that lets it listen only.
    pub listen: &'static str,
    /// The digits of `S` that it takes.
    pub rates: &'static str,
    /// The time in ms after its line is opened in which it hears nothing.
    pub deaf_ms: u64,
    /// What it prints at the end of that time.
    pub banner: &'static str,
    /// Whether it reports errors by `F`; otherwise it always says that there are none.
    pub reports_errors: bool,
    /// The end of its lines.
    pub end: &'static str,
    /// The number of frames that may wait to be sent, with the one that is on the bus.
    pub queue: usize,
    /// The time in ms that a line from it takes.
    pub latency_ms: u64,
    /// It forwards the frames that it sends.
    pub echoes: bool,
    /// It forwards each frame twice.
    pub doubles: bool,
    /// It sends its lines once in a latency.
    pub gathers: bool,
}

impl Firmware {
    /// The CANUSB, whose commands others imitate.
    pub const CANUSB: Self = Self {
        version: Some("V1013"),
        answers: true,
        listen: "L",
        rates: "012345678",
        deaf_ms: 0,
        banner: "",
        reports_errors: true,
        end: "\r",
        queue: 1_000,
        latency_ms: 1,
        echoes: false,
        doubles: false,
        gathers: false,
    };
    /// CANable 1.x and 2.0 with the firmware `slcan`: only `V` is answered.
    pub const CANABLE: Self = Self {
        version: Some("b158aa7 github.com/normaldotcom/canable-fw.git"),
        answers: false,
        listen: "M1",
        ..Self::CANUSB
    };
    /// The same without an answer to `V`.
    pub const MUTE: Self = Self { version: None, ..Self::CANABLE };
    /// An ESP32 with the firmware of mintynet, and a CANable 2.5.
    pub const ESP32: Self = Self { listen: "", rates: "345678", ..Self::NO_ERRORS };
    /// Any of those that never report an error.
    pub const NO_ERRORS: Self = Self { reports_errors: false, ..Self::CANUSB };
    /// An Arduino, which opening its line resets.
    pub const ARDUINO: Self =
        Self { deaf_ms: 2_500, banner: "CAN BUS Shield init ok!", ..Self::NO_ERRORS };
    /// The transmit queue is short.
    pub const SHORT_QUEUE: Self = Self { queue: 1, ..Self::CANUSB };
    /// The lines end with a line feed alone.
    pub const LINE_FEEDS: Self = Self { end: "\n", ..Self::CANUSB };
    /// A serial chip of FTDI is in between.
    pub const FTDI: Self = Self { latency_ms: 16, ..Self::CANUSB };
    /// It forwards what it sends.
    pub const ECHO: Self = Self { echoes: true, ..Self::CANUSB };
    /// It forwards each frame twice.
    pub const DOUBLE: Self = Self { doubles: true, ..Self::CANUSB };
}

/// The line to the adapter.
struct Line<A: Application> {
    firmware: Firmware,
    adapter: BusAdapter<A>,
    /// The time at which the adapter hears, in microseconds since the beginning.
    ready_at: u64,
    command: Vec<u8>,
    /// What is on its way to the computer, and when it is there.
    output: VecDeque<(u64, Vec<u8>)>,
    wait: Duration,
    rate: BitRate,
    is_silent: bool,
}

impl<A: Application + Clone + 'static> BusAdapter<A> {
    /// The adapter with this firmware.
    ///
    /// # Errors
    /// The program does not take it for one.
    pub fn with_firmware(&self, firmware: Firmware) -> Result<Box<dyn Adapter>, Stop> {
        let now = self.bus().now();
        let mut line = Line {
            firmware,
            adapter: self.clone(),
            ready_at: now + 1_000 * firmware.deaf_ms,
            command: Vec::new(),
            output: VecDeque::new(),
            wait: Duration::ZERO,
            rate: BitRate::Kbit125,
            is_silent: false,
        };
        if !firmware.banner.is_empty() {
            line.output.push_back((line.ready_at, format!("{}\r\n", firmware.banner).into()));
        }
        let place = Place::Serial { device: firmware.version.unwrap_or("mute").into(), baud: 0 };
        Ok(Box::new(Slcan::new(place, Box::new(line))?))
    }
}

impl<A: Application + Clone> Line<A> {
    fn answer(&mut self, line: &[u8]) {
        let latency_us = 1_000 * self.firmware.latency_ms;
        let now = self.adapter.bus().now();
        let at = match self.firmware.gathers {
            true => (now / latency_us + 1) * latency_us,
            false => now + latency_us,
        };
        self.output.push_back((at, line.to_vec()));
    }

    /// Lets at most this time pass, in microseconds; returns whether a frame has come.
    fn pass(&mut self, us: u64) -> bool {
        let received = {
            let mut bus = self.adapter.bus();
            let until = bus.now() + us;
            bus.run(until)
        };
        let Some((_, frame)) = received else { return false };
        let line = Frame::new(frame.cob_id().into(), false, frame.data()).to_string();
        for _ in 0..=usize::from(self.firmware.doubles) {
            self.end(&line);
        }
        true
    }

    fn end(&mut self, line: &str) {
        self.answer(format!("{line}{}", self.firmware.end).as_bytes());
    }

    /// Carries out a command; returns its answer, or `None` if it is refused.
    fn carry_out(&mut self, line: &str) -> Option<String> {
        let Firmware { listen, rates, queue, reports_errors, .. } = self.firmware;
        let mut bus = self.adapter.bus();
        match line.split_at_checked(1)? {
            ("C", "") if bus.is_open => (bus.is_open, bus.may_send) = (false, false),
            ("M", "0" | "1") if listen == "M1" => self.is_silent = line == "M1",
            ("L", "") if listen == "L" && !bus.is_open => bus.open(self.rate, false),
            ("O", "") if !bus.is_open => bus.open(self.rate, !self.is_silent),
            ("S", digit) if rates.contains(digit) && !bus.is_open => {
                let kbit = *RATES.get(digit.parse::<usize>().ok()?)?;
                self.rate = BitRate::ALL.into_iter().find(|rate| rate.kbit_per_s() == kbit)?;
            }
            ("F", "") if bus.is_open => {
                let has_errors = std::mem::take(&mut bus.is_unacknowledged) && reports_errors;
                return Some(format!("F{:02X}", if has_errors { BUS_ERROR } else { 0 }));
            }
            ("t", _) if bus.is_open => {
                let (frame, _) = Frame::parse(line)?;
                let waiting =
                    bus.waiting.range(..=(bus.now, u64::MAX)).map(|(_, (source, _))| *source);
                let sources = waiting.chain(bus.flight.as_ref().map(|flight| flight.source));
                if sources.filter(|source| *source == Source::Tool).count() >= queue {
                    return None;
                }
                bus.send(canopen_node::Frame::new(frame.id as u16, frame.data())?);
                drop(bus);
                if self.firmware.echoes {
                    self.end(line);
                }
                return Some("z".into());
            }
            _ => return None,
        }
        Some(String::new())
    }
}

impl<A: Application + Clone> Write for Line<A> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        for byte in bytes {
            // About the time of a byte at 1 Mbit/s.
            self.pass(10);
            if self.adapter.bus().now() < self.ready_at {
                continue;
            }
            if *byte != END {
                self.command.push(*byte);
                continue;
            }
            let line = String::from_utf8_lossy(&std::mem::take(&mut self.command)).into_owned();
            match (&*line, self.firmware.version) {
                ("V", Some(version)) => self.end(version),
                ("V", None) => {}
                _ => match self.carry_out(&line) {
                    _ if !self.firmware.answers => {}
                    Some(answer) => self.end(&answer),
                    None => self.answer(&[REFUSED]),
                },
            }
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl<A: Application + Clone> Read for Line<A> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let until = self.adapter.bus().now() + self.wait.as_micros() as u64;
        loop {
            let ready = self.output.front().map_or(NEVER, |(at, _)| *at);
            if ready <= self.adapter.bus().now() {
                let Some((_, line)) = self.output.pop_front() else { continue };
                bytes[..line.len()].copy_from_slice(&line);
                return Ok(line.len());
            }
            let now = self.adapter.bus().now();
            if !self.pass(until.min(ready).saturating_sub(now)) && ready > until {
                return Err(io::ErrorKind::TimedOut.into());
            }
        }
    }
}

impl<A: Application + Clone> Port for Line<A> {
    fn set_wait(&mut self, wait: Duration) -> io::Result<()> {
        self.wait = wait;
        Ok(())
    }

    fn now(&self) -> Instant {
        self.adapter.now()
    }
}
