//! The bench of a case: the line to the device, its data sheet, the frames so far, and the steps that cases share.

use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, Mode},
    stop,
};
use canopen_node::{BitRate, Frame};
pub use testkit::sdo_messages::Address;
use testkit::sdo_messages::{expedited, initiate, segment};

use crate::{Lab, Line, Step, eds::Eds, lss::Target};

/// The wait for an answer that must come. A store may erase a sector of flash first.
const PATIENCE: Duration = ms(5_000);
/// The wait for an answer that must not come.
const SILENCE: Duration = ms(200);
/// The longest wait between two looks at Ctrl-C.
const SLICE: Duration = ms(50);

/// Why a case ends early.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Stop {
    /// What was expected.
    Failed(String),
    /// Why the device cannot be asked.
    Skipped(String),
    /// The line has broken.
    Broken(String),
}

impl From<stop::Stop> for Stop {
    fn from(stop: stop::Stop) -> Self {
        Self::Broken(stop.to_string())
    }
}

impl fmt::Display for Stop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self::Failed(text) | Self::Skipped(text) | Self::Broken(text)) = self;
        f.write_str(text)
    }
}

impl std::error::Error for Stop {}

/// A line of a case's protocol.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Seen {
    Sent(Frame),
    /// In words, since it is no data frame of CANopen.
    SentOther(String),
    Received(Frame),
    /// A remark of the case.
    Note(String),
}

/// An NMT command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Command {
    Start = 1,
    Stop = 2,
    EnterPreOperational = 128,
    ResetNode = 129,
    ResetCommunication = 130,
}

/// A number of milliseconds.
pub const fn ms(count: u64) -> Duration {
    Duration::from_millis(count)
}

/// The device on its line, and what was seen of it.
pub struct Bench<'a> {
    line: Line<'a>,
    /// The adapter's time at the beginning.
    start: Instant,
    /// How much earlier or later than on the bus a frame can be seen.
    pub jitter: Duration,
    /// Ends the run.
    pub is_interrupted: Arc<AtomicBool>,
    /// The data sheet of the device.
    pub eds: &'a Eds,
    /// The node-ID of the device.
    pub node: u8,
    /// The devices for the LSS chapter; none unless a program sets them.
    pub lss: Target,
    seen: Vec<(Duration, Seen)>,
}

impl<'a> Bench<'a> {
    /// The device on an open adapter.
    pub fn new(line: Line<'a>, eds: &'a Eds, node: u8) -> Self {
        let mut bench = Self {
            line,
            start: Instant::now(),
            jitter: ms(1),
            is_interrupted: Arc::default(),
            eds,
            node,
            lss: Target::default(),
            seen: Vec::new(),
        };
        bench.start = bench.adapter().now();
        bench
    }

    pub(crate) fn begin(&mut self) {
        self.seen.clear();
    }

    pub(crate) fn take_seen(&mut self) -> Vec<(Duration, Seen)> {
        std::mem::take(&mut self.seen)
    }

    /// The number of lines of the case's protocol so far.
    pub fn seen_len(&self) -> usize {
        self.seen.len()
    }

    /// The frames that were received since then.
    pub fn received_since(&self, from: usize) -> impl Iterator<Item = Frame> {
        self.seen[from..].iter().filter_map(|(_, seen)| match seen {
            Seen::Received(frame) => Some(*frame),
            _ => None,
        })
    }

    fn adapter(&mut self) -> &mut dyn Adapter {
        match &mut self.line {
            Line::Adapter(adapter) => *adapter,
            Line::Lab(lab) => *lab,
        }
    }

    /// The laboratory; the case is skipped if there is none, because the line cannot do this.
    pub fn lab(&mut self, cannot: &str) -> Step<&mut dyn Lab> {
        match &mut self.line {
            Line::Adapter(_) => Err(Stop::Skipped(format!("this line cannot {cannot}"))),
            Line::Lab(lab) => Ok(*lab),
        }
    }

    /// The time since the beginning.
    pub fn now(&self) -> Duration {
        let now = match &self.line {
            Line::Adapter(adapter) => adapter.now(),
            Line::Lab(lab) => lab.now(),
        };
        now.saturating_duration_since(self.start)
    }

    fn saw(&mut self, what: Seen) {
        let now = self.now();
        self.seen.push((now, what));
    }

    /// Adds a remark to the frames of the case.
    pub fn note(&mut self, text: impl Into<String>) {
        self.saw(Seen::Note(text.into()));
    }

    /// Fails the case unless `is_good`.
    pub fn check(&self, is_good: bool, expected: impl Into<String>) -> Step {
        if is_good { Ok(()) } else { self.fail(expected) }
    }

    pub fn fail<T>(&self, expected: impl Into<String>) -> Step<T> {
        Err(Stop::Failed(expected.into()))
    }

    pub fn skip<T>(&self, reason: impl Into<String>) -> Step<T> {
        Err(Stop::Skipped(reason.into()))
    }

    /// Skips the case if the EDS lacks an object.
    pub fn needs(&self, (index, sub_index): Address) -> Step {
        match self.eds.get((index, sub_index)) {
            Some(_) => Ok(()),
            None => self.skip(format!("the EDS has no {index:04X}h sub {sub_index}")),
        }
    }

    /// Sends a data frame with this COB-ID and at most eight bytes.
    pub fn send(&mut self, cob_id: u16, data: &[u8]) -> Step {
        let frame = Frame::new(cob_id, data).expect("an 11-bit COB-ID and at most eight bytes");
        self.adapter().send(&frame)?;
        self.saw(Seen::Sent(frame));
        Ok(())
    }

    /// Sends a remote frame; the case is skipped if the line cannot.
    pub fn send_remote(&mut self, cob_id: u16, length: u8) -> Step {
        if !self.adapter().send_remote(cob_id, length)? {
            return self.skip("this line sends no remote frames");
        }
        self.saw(Seen::SentOther(format!("{cob_id:03X} remote, {length} bytes")));
        Ok(())
    }

    /// Sends a data frame with a 29-bit identifier; the case is skipped if the line cannot.
    pub fn send_extended(&mut self, id: u32, data: &[u8]) -> Step {
        if !self.adapter().send_extended(id, data)? {
            return self.skip("this line sends no frames with 29-bit identifiers");
        }
        self.saw(Seen::SentOther(format!("{id:08X} with 29 bits, {}", hex(data))));
        Ok(())
    }

    /// Cuts the supply of the device for `span`; the case is skipped if the line cannot.
    pub fn cut_power(&mut self, span: Duration) -> Step {
        self.lab("switch the supply")?.power(false);
        self.note(format!("no power for {} ms", span.as_millis()));
        self.pass(span)?;
        self.lab("switch the supply")?.power(true);
        Ok(())
    }

    /// Skips the case if the line has a fixed bit rate.
    pub fn needs_bit_rates(&mut self) -> Step {
        match self.adapter().fixed_rate() {
            Some(_) => self.skip("this line cannot change its bit rate"),
            None => Ok(()),
        }
    }

    /// Joins the bus at another bit rate; the case is skipped if the line cannot.
    pub fn open(&mut self, rate: BitRate) -> Step {
        self.needs_bit_rates()?;
        match stop::Stop::without_rate(self.adapter().open(rate, Mode::Normal))? {
            Some(()) => Ok(()),
            None => self.skip(format!("this adapter lacks {rate}")),
        }
    }

    /// The next frame that comes before `until`.
    pub fn receive(&mut self, until: Duration) -> Step<Option<(Duration, Frame)>> {
        loop {
            if self.is_interrupted.load(Ordering::Relaxed) {
                return Err(stop::Stop::Interrupted.into());
            }
            let wait = until.saturating_sub(self.now()).min(SLICE);
            if let Some(received) = self.adapter().receive(wait)? {
                self.saw(Seen::Received(received.frame));
                let time = received.here.saturating_duration_since(self.start);
                return Ok(Some((time, received.frame)));
            }
            if self.now() >= until {
                return Ok(None);
            }
        }
    }

    /// The first frame within `span` that `is_it`, with its time; others are passed over.
    pub fn wait_for(
        &mut self,
        span: Duration,
        is_it: impl Fn(&Frame) -> bool,
    ) -> Step<Option<(Duration, Frame)>> {
        let until = self.now() + span;
        while let Some(received) = self.receive(until)? {
            if is_it(&received.1) {
                return Ok(Some(received));
            }
        }
        Ok(None)
    }

    /// The frames with this COB-ID that come within `span`, with their times.
    pub fn collect(&mut self, span: Duration, cob_id: u16) -> Step<Vec<(Duration, Frame)>> {
        let until = self.now() + span;
        let mut all = Vec::new();
        while let Some(received) = self.receive(until)? {
            if received.1.cob_id() == cob_id {
                all.push(received);
            }
        }
        Ok(all)
    }

    /// Lets time pass.
    pub fn pass(&mut self, span: Duration) -> Step {
        let until = self.now() + span;
        while self.receive(until)?.is_some() {}
        Ok(())
    }

    /// Sends a SYNC, with these bytes: none, or a counter.
    pub fn sync(&mut self, counter: &[u8]) -> Step {
        self.send(0x080, counter)
    }

    /// Sends an NMT command to the device.
    pub fn nmt(&mut self, command: Command) -> Step {
        self.nmt_to(command, self.node)
    }

    /// Sends an NMT command to a node; 0 is all nodes.
    pub fn nmt_to(&mut self, command: Command, node: u8) -> Step {
        self.send(0x000, &[command as u8, node])
    }

    /// Sends an NMT command after which the device must boot up, and waits for that.
    pub fn reset(&mut self, command: Command) -> Step {
        self.nmt(command)?;
        self.boot_up()
    }

    /// Waits for the boot-up of the device.
    pub fn boot_up(&mut self) -> Step {
        let cob_id = 0x700 + u16::from(self.node);
        let is_it = |frame: &Frame| frame.cob_id() == cob_id && frame.data() == [0];
        match self.wait_for(PATIENCE, is_it)? {
            Some(_) => Ok(()),
            None => self.fail(format!("{cob_id:03X} 00: the boot-up within {PATIENCE:?}")),
        }
    }

    /// Resets the device, restores its default parameters by 1011h if it has that, and resets it again.
    pub fn restore(&mut self) -> Step {
        self.reset(Command::ResetNode)?;
        if self.eds.get((0x1011, 1)).is_some() {
            self.write((0x1011, 1), b"load")?;
            self.reset(Command::ResetNode)?;
        }
        Ok(())
    }

    /// Sends a message to the SDO server.
    pub fn say(&mut self, message: [u8; 8]) -> Step {
        self.send(0x600 + u16::from(self.node), &message)
    }

    /// The next message of the SDO server, if one comes within `span`.
    pub fn hear(&mut self, span: Duration) -> Step<Option<[u8; 8]>> {
        let cob_id = 0x580 + u16::from(self.node);
        let Some((_, frame)) = self.wait_for(span, |frame| frame.cob_id() == cob_id)? else {
            return Ok(None);
        };
        match frame.data().try_into() {
            Ok(message) => Ok(Some(message)),
            Err(_) => self.fail("an SDO message has eight bytes"),
        }
    }

    /// The next message of the SDO server, which must come.
    pub fn answer(&mut self) -> Step<[u8; 8]> {
        match self.hear(PATIENCE)? {
            Some(answer) => Ok(answer),
            None => self.fail("an answer of the SDO server"),
        }
    }

    /// Sends a message to the SDO server; returns its answer.
    pub fn ask(&mut self, message: [u8; 8]) -> Step<[u8; 8]> {
        self.say(message)?;
        self.answer()
    }

    /// Sends a message to the SDO server, and expects no answer.
    pub fn expect_silence(&mut self, message: [u8; 8]) -> Step {
        self.say(message)?;
        let answer = self.hear(SILENCE + self.jitter)?;
        self.check(answer.is_none(), "no answer of the SDO server")
    }

    /// The answer to a message that begins a transfer, which must name the same object, or its abort code.
    fn begin_transfer(&mut self, message: [u8; 8]) -> Step<Result<[u8; 8], u32>> {
        let answer = self.ask(message)?;
        self.check(answer[1..4] == message[1..4], "the object of the request in the answer")?;
        Ok(abort_code(&answer).map_or(Ok(answer), Err))
    }

    /// Sends a message that must be aborted with one of these codes; returns the code.
    pub fn expect_abort(&mut self, message: [u8; 8], accepted: &[u32]) -> Step<u32> {
        let answer = self.ask(message)?;
        self.expect_abort_in(&answer, accepted)
    }

    /// The code in an answer, which must be an abort with one of these codes.
    pub fn expect_abort_in(&mut self, answer: &[u8; 8], accepted: &[u32]) -> Step<u32> {
        match abort_code(answer) {
            Some(code) if accepted.contains(&code) => Ok(code),
            _ => self.fail(format!("an abort with {}", codes(accepted))),
        }
    }

    /// Reads an object, expedited or in segments, or the abort code.
    pub fn upload(&mut self, address: Address) -> Step<Result<Vec<u8>, u32>> {
        let answer = match self.begin_transfer(initiate(0x40, address, 0))? {
            Ok(answer) => answer,
            Err(code) => return Ok(Err(code)),
        };
        match answer[0] {
            0x42 => return Ok(Ok(answer[4..].to_vec())),
            command @ (0x43 | 0x47 | 0x4B | 0x4F) => {
                return Ok(Ok(answer[4..8 - usize::from(command >> 2 & 3)].to_vec()));
            }
            0x40 | 0x41 => {}
            _ => return self.fail("40..43, 47, 4B or 4F: the answer to an upload"),
        }
        let mut data = Vec::new();
        for toggle in [0x00, 0x10].into_iter().cycle() {
            let segment = self.ask(segment(0x60 | toggle, &[]))?;
            if let Some(code) = abort_code(&segment) {
                return Ok(Err(code));
            }
            self.check(segment[0] & 0xF0 == toggle, "a segment with the request's toggle bit")?;
            data.extend(&segment[1..8 - usize::from(segment[0] >> 1 & 7)]);
            if segment[0] & 1 == 1 {
                break;
            }
        }
        let size = u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]);
        let is_right = answer[0] == 0x40 || size as usize == data.len();
        self.check(is_right, format!("{size} bytes, as the server said"))?;
        Ok(Ok(data))
    }

    /// Reads an object that must be readable.
    pub fn read(&mut self, address: Address) -> Step<Vec<u8>> {
        match self.upload(address)? {
            Ok(data) => Ok(data),
            Err(_) => self.fail(format!("{} can be read", name(address))),
        }
    }

    /// Reads a number of at most eight bytes.
    pub fn number(&mut self, address: Address) -> Step<u64> {
        let data = self.read(address)?;
        let mut bytes = [0; 8];
        let Some(low) = bytes.get_mut(..data.len()) else {
            return self.fail(format!("{} has at most eight bytes", name(address)));
        };
        low.copy_from_slice(&data);
        Ok(u64::from_le_bytes(bytes))
    }

    /// Writes an object: expedited up to four bytes, longer values in segments. The error is the abort code.
    pub fn download(&mut self, address: Address, data: &[u8]) -> Step<Result<(), u32>> {
        let is_expedited = (1..=4).contains(&data.len());
        if !is_expedited {
            return self.download_segments(address, data);
        }
        Ok(match self.begin_transfer(expedited(address, data))? {
            Err(code) => Err(code),
            Ok(answer) => Ok(self.check(answer[0] == 0x60, "60: the answer to a download")?),
        })
    }

    /// Writes an object in segments. The error is the abort code.
    pub fn download_segments(&mut self, address: Address, data: &[u8]) -> Step<Result<(), u32>> {
        match self.begin_transfer(initiate(0x21, address, data.len() as u32))? {
            Err(code) => return Ok(Err(code)),
            Ok(answer) => self.check(answer[0] == 0x60, "60: the answer to a download")?,
        }
        let count = data.len().div_ceil(7).max(1);
        for number in 0..count {
            let toggle = (number as u8 & 1) << 4;
            let part = &data[number * 7..data.len().min(number * 7 + 7)];
            let is_last = u8::from(number + 1 == count);
            let command = toggle | (7 - part.len() as u8) << 1 | is_last;
            let answer = self.ask(segment(command, part))?;
            if let Some(code) = abort_code(&answer) {
                return Ok(Err(code));
            }
            let expected = format!("{:02X}: the segment is acknowledged", 0x20 | toggle);
            self.check(answer[0] == 0x20 | toggle, expected)?;
        }
        Ok(Ok(()))
    }

    /// Writes an object that must take the value.
    pub fn write(&mut self, address: Address, data: &[u8]) -> Step {
        match self.download(address, data)? {
            Ok(()) => Ok(()),
            Err(_) => self.fail(format!("{} takes {}", name(address), hex(data))),
        }
    }

    /// Writes a value that must be refused with one of these codes; returns the code.
    pub fn refuses(&mut self, address: Address, data: &[u8], accepted: &[u32]) -> Step<u32> {
        match self.download(address, data)? {
            Err(code) if accepted.contains(&code) => Ok(code),
            _ => {
                let codes = codes(accepted);
                self.fail(format!("{} refuses {} with {codes}", name(address), hex(data)))
            }
        }
    }
}

/// An object, for a person.
pub fn name((index, sub_index): Address) -> String {
    format!("{index:04X}h sub {sub_index}")
}

/// Bytes as text.
pub fn hex(data: &[u8]) -> String {
    data.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}

/// The code of an abort.
pub fn abort_code(answer: &[u8; 8]) -> Option<u32> {
    match *answer {
        [0x80, _, _, _, code @ ..] => Some(u32::from_le_bytes(code)),
        _ => None,
    }
}

fn codes(codes: &[u32]) -> String {
    let texts: Vec<_> = codes.iter().map(|code| format!("{code:08X}h")).collect();
    texts.join(" or ")
}
