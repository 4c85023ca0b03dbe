//! A program connected by TCP, and its adapter on the bus.

use std::{
    io::{BufRead, BufReader, Write},
    net::{TcpListener, TcpStream},
    sync::mpsc::{self, Sender, SyncSender},
    thread,
};

use can_bus::slcan::{self, END, LINE};
use emulator::{
    can::{Adapter, Frame, Id, Station},
    network::{AdapterId, Network},
};

/// The number of frames that may wait for the bus; more are refused.
const QUEUE: usize = 1000;

/// The number of lines that may wait to be carried out; further ones block their programs.
pub const WAITING: usize = 1000;

/// The number of a client, counted from the first; never reused.
pub type ClientId = u64;

/// An input to the emulation.
pub enum Input {
    /// A program has connected.
    Connected(ClientId, TcpStream),
    /// It sent a line, given without its end.
    Line(ClientId, Vec<u8>),
    /// It has disconnected.
    Gone(ClientId),
    /// A line on the standard input.
    Console(String),
    /// Ctrl-C.
    Stop,
}

/// Waits for programs, in the background.
pub fn accept(listener: TcpListener, inputs: SyncSender<Input>) {
    thread::spawn(move || {
        for (id, stream) in (0..).zip(listener.incoming().flatten()) {
            let Ok(reader) = stream.try_clone() else { continue };
            if inputs.send(Input::Connected(id, stream)).is_err() {
                return;
            }
            let inputs = inputs.clone();
            thread::spawn(move || read(id, reader, &inputs));
        }
    });
}

fn read(id: ClientId, stream: TcpStream, inputs: &SyncSender<Input>) {
    let mut reader = BufReader::new(stream);
    let mut line = Vec::new();
    while let Ok(1..) = std::io::Read::take(&mut reader, LINE as u64).read_until(END, &mut line) {
        if line.len() == LINE && !line.ends_with(&[END]) {
            // The rest of the line is no command either.
            if reader.skip_until(END).is_err() {
                break;
            }
        } else if !line.ends_with(&[END]) {
            // The program disconnected within a line.
            break;
        }
        line.retain(|byte| ![b'\n', END].contains(byte));
        if inputs.send(Input::Line(id, std::mem::take(&mut line))).is_err() {
            return;
        }
    }
    // The emulation may have ended; then the message is not needed.
    let _ = inputs.send(Input::Gone(id));
}

/// Adds an adapter to the bus; it is closed.
pub fn new_adapter(network: &mut Network) -> AdapterId {
    let adapter = network.add_adapter(Adapter::new(1_000_000));
    network.adapter_mut(adapter).close();
    adapter
}

/// A connected program.
pub struct Client {
    /// The queue to the thread that writes to the program, so that a slow program blocks no others.
    output: Sender<Vec<u8>>,
    adapter: AdapterId,
    is_open: bool,
    may_transmit: bool,
    has_timestamps: bool,
    /// The adapter's error count at the previous `F`.
    known_errors: u64,
}

impl Client {
    /// A program that commands `adapter`, which is closed and set to `bit_rate` bit/s.
    pub fn new(
        mut stream: TcpStream,
        adapter: AdapterId,
        bit_rate: u32,
        network: &mut Network,
    ) -> Self {
        // Without this option only the latency is worse.
        let _ = stream.set_nodelay(true);
        let (output, lines) = mpsc::channel::<Vec<u8>>();
        thread::spawn(move || lines.iter().try_for_each(|line| stream.write_all(&line)));
        let on_bus = network.adapter_mut(adapter);
        on_bus.set_bit_rate(bit_rate);
        let known_errors = on_bus.errors();
        Self {
            output,
            adapter,
            is_open: false,
            may_transmit: false,
            has_timestamps: false,
            known_errors,
        }
    }

    /// Takes the program's adapter off the bus and returns it.
    pub fn leave(self, network: &mut Network) -> AdapterId {
        network.adapter_mut(self.adapter).close();
        while network.receive(self.adapter).is_some() {}
        self.adapter
    }

    /// Sends the frames received by the adapter to the program.
    pub fn deliver(&mut self, network: &mut Network) {
        while let Some((time, frame)) = network.receive(self.adapter) {
            let milliseconds = self.has_timestamps.then_some(time.as_ms());
            self.write(received(&frame, milliseconds));
        }
    }

    /// Carries out a line of the program and answers it.
    pub fn execute(&mut self, line: &[u8], network: &mut Network) {
        let answer = str::from_utf8(line).ok().and_then(|line| self.carry_out(line, network));
        self.write(answer.unwrap_or_else(|| char::from(slcan::REFUSED).into()));
    }

    /// Carries out a command and returns the answer; `None` if it is unknown or not possible now.
    fn carry_out(&mut self, line: &str, network: &mut Network) -> Option<String> {
        let adapter = network.adapter_mut(self.adapter);
        match line {
            // Some programs send a few of them to end any earlier line.
            "" => {}
            "O" | "L" if self.is_open => return None,
            "O" | "L" => {
                (self.is_open, self.may_transmit) = (true, line == "O");
                if self.may_transmit { adapter.open() } else { adapter.listen_only() }
            }
            "C" => {
                adapter.close();
                (self.is_open, self.may_transmit) = (false, false);
            }
            "Z0" | "Z1" => self.has_timestamps = line == "Z1",
            "V" => return Some("V1013\r".into()),
            "N" => return Some("NEMUL\r".into()),
            "F" => {
                let has_errors = adapter.errors() > self.known_errors;
                self.known_errors = adapter.errors();
                let counters = adapter.controller().counters();
                let flag = |is, flag| if is { flag } else { 0 };
                let flags = flag(counters.warning(), slcan::WARNING)
                    | flag(counters.passive(), slcan::ERROR_PASSIVE)
                    | flag(has_errors, slcan::BUS_ERROR);
                return Some(format!("F{flags:02X}\r"));
            }
            _ => match line.split_at_checked(1)? {
                ("S", digit) if digit.len() == 1 && !self.is_open => {
                    let kbit = *slcan::RATES.get(slcan::hex(digit)? as usize)?;
                    adapter.set_bit_rate(u32::from(kbit) * 1000);
                }
                // The acceptance filter of an SJA1000.
                ("M" | "m", filter) if filter.len() == 8 => {
                    slcan::hex(filter)?;
                }
                _ => match slcan::Frame::parse(line)? {
                    (frame, None) if self.may_transmit && adapter.unsent() < QUEUE => {
                        network.send(self.adapter, on_the_bus(&frame));
                        return Some(if frame.is_extended { "Z\r" } else { "z\r" }.into());
                    }
                    _ => return None,
                },
            },
        }
        Some(char::from(END).into())
    }

    /// Sends a line to the program. If it has disconnected, the line is lost; the disconnection arrives as an
    /// [`Input`].
    fn write(&mut self, line: String) {
        let _ = self.output.send(line.into());
    }
}

fn on_the_bus(frame: &slcan::Frame) -> Frame {
    let id = match frame.is_extended {
        true => Id::Extended(frame.id),
        false => Id::Standard(frame.id as u16),
    };
    match frame.is_remote {
        true => Frame::remote(id, frame.length),
        false => Frame::data(id, frame.data()),
    }
}

/// The line for a received frame, including its end.
fn received(frame: &Frame, milliseconds: Option<u64>) -> String {
    let (id, is_extended) = match frame.id {
        Id::Standard(id) => (id.into(), false),
        Id::Extended(id) => (id, true),
    };
    let (length, data) = (frame.dlc.min(8), frame.data);
    let frame = slcan::Frame { id, is_extended, is_remote: frame.remote, length, data };
    match milliseconds {
        Some(ms) => format!("{frame}{:04X}\r", ms % slcan::STAMPS_MS),
        None => format!("{frame}\r"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_stamps_wrap_and_a_data_length_code_above_eight_is_reported_as_eight() {
        let frame = Frame::data(Id::Standard(0x7E5), &[0; 8]).with_dlc(15);
        assert_eq!(received(&frame, None), "t7E580000000000000000\r");
        assert_eq!(received(&frame, Some(60_255)), "t7E58000000000000000000FF\r");
    }
}
