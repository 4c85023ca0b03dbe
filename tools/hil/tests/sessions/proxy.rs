//! A faulty line between `cargo hil` and the boards: the faults of a broken board or of a broken adapter.

use std::{
    io::{BufReader, Read, Write},
    net::{Shutdown, SocketAddr, TcpListener, TcpStream},
    sync::{Arc, Mutex},
    thread,
    time::Duration,
};

/// What is broken. The frames are those of SLCAN: `t7E58` and the data in hexadecimal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    None,
    /// LSS answers come 40 ms late.
    LateAnswers,
    /// A 5C that comes while other answers are due is lost.
    LostRequest,
    /// 17 is answered, but nothing is stored.
    NoStore,
    /// Nothing is heard of the board from a 15 to a reset.
    SilentAfterSwitch,
    /// Nothing is heard of the board from a 15 on.
    SilentForEver,
    /// The board has the vendor-ID 000001A0h.
    OtherVendor,
    /// The board restarts a second after node-ID 1 was stored, as by a power cut.
    PowerCut,
    /// The board sends one heartbeat after a boot-up, as a port that never says that no frame is pending.
    OneHeartbeat,
    /// An ESP32 is the adapter: it lacks 10, 20 and 50 kbit/s, cannot listen only, and reports no errors.
    Esp32,
    /// The same, and nothing is heard of the board from a 15 to a reset.
    Esp32SilentAfterSwitch,
    /// The connection ends at the first 17, and at each one after it.
    Vanishes,
    /// The connection ends at the first 17.
    VanishesOnce,
}

/// The state of a fault, shared by both directions and all connections.
#[derive(Default)]
struct State {
    requests_due: usize,
    is_silent: bool,
    has_vanished: bool,
    has_sent_heartbeat: bool,
}

/// What becomes of a line.
enum Fate {
    Forward,
    /// Another one arrives.
    Change(String),
    /// Nothing arrives, but this is answered.
    Answer(&'static str),
    Lose,
    /// The connection ends.
    Vanish,
}

/// Starts the faulty line to `boards`; returns the adapter of `cargo hil`.
pub fn start(boards: SocketAddr, fault: Fault) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = listener.local_addr().expect("it is bound");
    thread::spawn(move || {
        let state = Arc::new(Mutex::new(State::default()));
        for master in listener.incoming().flatten() {
            let Ok(bus) = TcpStream::connect(boards) else { return };
            for stream in [&master, &bus] {
                stream.set_nodelay(true).expect("it is connected");
            }
            let clone = |stream: &TcpStream| stream.try_clone().expect("a socket");
            for (fate, from, to) in [
                (of_request as FateOf, clone(&master), clone(&bus)),
                (of_answer, clone(&bus), clone(&master)),
            ] {
                let state = Arc::clone(&state);
                thread::spawn(move || carry(from, to, |line, to| fate(line, fault, &state, to)));
            }
        }
    });
    format!("slcan:tcp:{address}")
}

/// Says what becomes of a line, given the connection that it is on its way to.
type FateOf = fn(&str, Fault, &Mutex<State>, &TcpStream) -> Fate;

/// Carries SLCAN's lines from one connection to the other, until one of them ends; then both do.
fn carry(mut from: TcpStream, mut to: TcpStream, fate: impl Fn(&str, &TcpStream) -> Fate) {
    for line in lines(from.try_clone().expect("a socket")) {
        let carried = match fate(&line, &to) {
            Fate::Forward => to.write_all(line.as_bytes()),
            Fate::Change(line) => to.write_all(line.as_bytes()),
            Fate::Answer(answer) => from.write_all(answer.as_bytes()),
            Fate::Lose => Ok(()),
            Fate::Vanish => break,
        };
        if carried.is_err() {
            break;
        }
    }
    for stream in [from, to] {
        // It may have ended before.
        let _ = stream.shutdown(Shutdown::Both);
    }
}

/// Splits the bytes of a connection at the ends of SLCAN's lines, which stay.
fn lines(stream: TcpStream) -> impl Iterator<Item = String> {
    let mut bytes = BufReader::new(stream).bytes().map_while(Result::ok);
    std::iter::from_fn(move || {
        let mut line = String::new();
        while !line.ends_with(['\r', '\x07']) {
            line.push(char::from(bytes.next()?));
        }
        Some(line)
    })
}

fn of_request(line: &str, fault: Fault, state: &Mutex<State>, bus: &TcpStream) -> Fate {
    let mut state = state.lock().expect("nobody panics");
    let is = |prefix: &str| line.starts_with(prefix);
    match fault {
        Fault::LostRequest if is("t7E585C") && state.requests_due > 0 => Fate::Answer("z\r"),
        Fault::LostRequest if is("t7E585") => {
            state.requests_due += 1;
            Fate::Forward
        }
        Fault::Esp32 | Fault::Esp32SilentAfterSwitch
            if ["S0\r", "S1\r", "S2\r", "L\r"].contains(&line) =>
        {
            Fate::Answer("\x07")
        }
        Fault::Esp32 | Fault::Esp32SilentAfterSwitch if is("F") => Fate::Answer("F00\r"),
        Fault::NoStore if is("t7E5817") => Fate::Answer("z\rt7E481700000000000000\r"),
        Fault::PowerCut if is("t7E581101") => {
            let mut bus = bus.try_clone().expect("a socket");
            thread::spawn(move || {
                thread::sleep(Duration::from_secs(1));
                let _ = bus.write_all(b"t00028100\r");
            });
            Fate::Forward
        }
        Fault::SilentAfterSwitch | Fault::SilentForEver | Fault::Esp32SilentAfterSwitch
            if is("t7E5815") =>
        {
            state.is_silent = true;
            Fate::Forward
        }
        Fault::SilentAfterSwitch | Fault::Esp32SilentAfterSwitch if is("t000281") => {
            state.is_silent = false;
            Fate::Forward
        }
        Fault::OtherVendor if is("t7E5840") || is("t7E5846") => {
            let is_known = line[7..].starts_with("A0010000");
            Fate::Change(with_vendor(line, if is_known { "00000000" } else { "FFFFFFFF" }))
        }
        Fault::Vanishes if is("t7E5817") => Fate::Vanish,
        Fault::VanishesOnce if is("t7E5817") && !state.has_vanished => {
            state.has_vanished = true;
            Fate::Vanish
        }
        _ => Fate::Forward,
    }
}

fn of_answer(line: &str, fault: Fault, state: &Mutex<State>, _: &TcpStream) -> Fate {
    if fault == Fault::LateAnswers && line.starts_with("t7E4") {
        thread::sleep(Duration::from_millis(40));
    }
    let mut state = state.lock().expect("nobody panics");
    if line.starts_with("t7E485") {
        state.requests_due = state.requests_due.saturating_sub(1);
    }
    match fault {
        _ if state.is_silent && line.starts_with('t') => Fate::Lose,
        Fault::OneHeartbeat if line.starts_with("t7051") => {
            let is_boot_up = line.starts_with("t705100");
            let is_lost = !is_boot_up && state.has_sent_heartbeat;
            state.has_sent_heartbeat = !is_boot_up;
            if is_lost { Fate::Lose } else { Fate::Forward }
        }
        Fault::OtherVendor if line.starts_with("t7E485A") => {
            Fate::Change(with_vendor(line, "A0010000"))
        }
        _ => Fate::Forward,
    }
}

/// A frame of LSS with another number.
fn with_vendor(line: &str, number: &str) -> String {
    format!("{}{number}{}", &line[..7], &line[15..])
}
