//! A program connected by TCP, and its adapter on the bus.

use std::{
    io::{BufRead, BufReader, Write},
    net::{TcpListener, TcpStream},
    sync::mpsc::{self, Sender, SyncSender},
    thread,
};

use emulator::{
    can::{Adapter, Station},
    network::{AdapterId, Network},
};

use super::slcan::{self, Command};

/// The longest line that is read; every command is shorter.
const LINE: u64 = 64;
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
    while let Ok(1..) = std::io::Read::take(&mut reader, LINE).read_until(slcan::END, &mut line) {
        if line.len() as u64 == LINE && !line.ends_with(&[slcan::END]) {
            // The rest of the line is no command either.
            if reader.skip_until(slcan::END).is_err() {
                break;
            }
        } else if !line.ends_with(&[slcan::END]) {
            // The program disconnected within a line.
            break;
        }
        line.retain(|byte| ![b'\n', slcan::END].contains(byte));
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
            self.write(slcan::received(&frame, milliseconds).into());
        }
    }

    /// Carries out a line of the program and answers it.
    pub fn execute(&mut self, line: &[u8], network: &mut Network) {
        let answer = Command::parse(line).and_then(|command| self.carry_out(command, network));
        self.write(answer.unwrap_or_else(|| slcan::REFUSED.to_vec()));
    }

    /// Carries out a command and returns the answer; `None` if it is not possible now.
    fn carry_out(&mut self, command: Command, network: &mut Network) -> Option<Vec<u8>> {
        let adapter = network.adapter_mut(self.adapter);
        match command {
            Command::Nothing => {}
            Command::BitRate(_) | Command::Open | Command::ListenOnly if self.is_open => {
                return None;
            }
            Command::BitRate(bit_rate) => adapter.set_bit_rate(bit_rate),
            Command::Open => {
                adapter.open();
                (self.is_open, self.may_transmit) = (true, true);
            }
            Command::ListenOnly => {
                adapter.listen_only();
                (self.is_open, self.may_transmit) = (true, false);
            }
            Command::Close => {
                adapter.close();
                (self.is_open, self.may_transmit) = (false, false);
            }
            Command::Transmit(frame) if self.may_transmit && adapter.unsent() < QUEUE => {
                network.send(self.adapter, frame);
                return Some(slcan::queued(&frame).to_vec());
            }
            Command::Transmit(_) => return None,
            Command::Timestamps(wanted) => self.has_timestamps = wanted,
            Command::Version => return Some(b"V1013\r".to_vec()),
            Command::SerialNumber => return Some(b"NEMUL\r".to_vec()),
            Command::Status => {
                let has_errors = adapter.errors() > self.known_errors;
                self.known_errors = adapter.errors();
                return Some(slcan::status(adapter.controller().counters(), has_errors).into());
            }
        }
        Some(vec![slcan::END])
    }

    /// Sends a line to the program. If it has disconnected, the line is lost; the disconnection arrives as an
    /// [`Input`].
    fn write(&mut self, line: Vec<u8>) {
        let _ = self.output.send(line);
    }
}
