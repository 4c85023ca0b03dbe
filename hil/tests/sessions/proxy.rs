//! A faulty line between `cargo hil` and the boards: the faults of a broken board or of a broken adapter.

use std::{
    io::{BufReader, Read, Write},
    net::{Shutdown, SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
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
    /// The board has the vendor-ID 000001A0h.
    OtherVendor,
    /// The board restarts a second after node-ID 1 was stored, as by a power cut.
    PowerCut,
    /// The connection ends at the first 17, and at each one after it.
    Vanishes,
    /// The connection ends at the first 17.
    VanishesOnce,
}

/// The state of a fault, shared by both directions and all connections.
#[derive(Default)]
struct State {
    requests_due: AtomicUsize,
    is_silent: AtomicBool,
    has_vanished: AtomicBool,
}

/// Starts the faulty line to `boards`; returns the adapter of `cargo hil`.
pub fn start(boards: SocketAddr, fault: Fault) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = listener.local_addr().expect("it is bound");
    thread::spawn(move || {
        let state = Arc::new(State::default());
        for master in listener.incoming().flatten() {
            let Ok(bus) = TcpStream::connect(boards) else { return };
            for stream in [&master, &bus] {
                stream.set_nodelay(true).expect("it is connected");
            }
            let (to_master, to_bus) =
                (master.try_clone().expect("a socket"), bus.try_clone().expect("a socket"));
            let (requests, answers) = (Arc::clone(&state), Arc::clone(&state));
            thread::spawn(move || requests_to(to_bus, master, fault, &requests));
            thread::spawn(move || answers_to(to_master, bus, fault, &answers));
        }
    });
    format!("slcan:tcp:{address}")
}

/// Splits the bytes of a connection at the ends of SLCAN's lines, which stay.
fn lines(stream: TcpStream) -> impl Iterator<Item = String> {
    let mut reader = BufReader::new(stream);
    std::iter::from_fn(move || {
        let mut line = Vec::new();
        let mut byte = [0];
        while reader.read_exact(&mut byte).is_ok() {
            line.push(byte[0]);
            if [b'\r', 0x07].contains(&byte[0]) {
                return Some(String::from_utf8_lossy(&line).into_owned());
            }
        }
        None
    })
}

fn requests_to(mut bus: TcpStream, master: TcpStream, fault: Fault, state: &State) {
    let mut to_master = master.try_clone().expect("a socket");
    for line in lines(master) {
        let is = |prefix: &str| line.starts_with(prefix);
        let mut forwarded = line.clone();
        match fault {
            Fault::LostRequest if is("t7E585") => {
                let due = state.requests_due.fetch_add(1, Ordering::SeqCst);
                if due > 0 && is("t7E585C") {
                    state.requests_due.fetch_sub(1, Ordering::SeqCst);
                    let _ = to_master.write_all(b"z\r");
                    continue;
                }
            }
            Fault::NoStore if is("t7E5817") => {
                let _ = to_master.write_all(b"z\rt7E481700000000000000\r");
                continue;
            }
            Fault::PowerCut if is("t7E581101") => {
                let mut bus = bus.try_clone().expect("a socket");
                thread::spawn(move || {
                    thread::sleep(Duration::from_secs(1));
                    let _ = bus.write_all(b"t00028100\r");
                });
            }
            Fault::SilentAfterSwitch if is("t7E5815") => {
                state.is_silent.store(true, Ordering::SeqCst)
            }
            Fault::SilentAfterSwitch if is("t000281") => {
                state.is_silent.store(false, Ordering::SeqCst)
            }
            Fault::OtherVendor if is("t7E5840") || is("t7E5846") => {
                let vendor =
                    if line[7..].starts_with("A0010000") { "00000000" } else { "FFFFFFFF" };
                forwarded.replace_range(7..15, vendor);
            }
            Fault::Vanishes | Fault::VanishesOnce if is("t7E5817") => {
                let is_first = !state.has_vanished.swap(true, Ordering::SeqCst);
                if is_first || fault == Fault::Vanishes {
                    for stream in [&bus, &to_master] {
                        let _ = stream.shutdown(Shutdown::Both);
                    }
                    return;
                }
            }
            _ => {}
        }
        if bus.write_all(forwarded.as_bytes()).is_err() {
            return;
        }
    }
    let _ = bus.shutdown(Shutdown::Both);
}

fn answers_to(mut master: TcpStream, bus: TcpStream, fault: Fault, state: &State) {
    for line in lines(bus) {
        let mut line = line;
        match fault {
            Fault::LateAnswers if line.starts_with("t7E4") => {
                thread::sleep(Duration::from_millis(40))
            }
            Fault::LostRequest if line.starts_with("t7E485") => {
                let due = &state.requests_due;
                let _ =
                    due.try_update(Ordering::SeqCst, Ordering::SeqCst, |due| due.checked_sub(1));
            }
            Fault::SilentAfterSwitch
                if line.starts_with('t') && state.is_silent.load(Ordering::SeqCst) =>
            {
                continue;
            }
            Fault::OtherVendor if line.starts_with("t7E485A") => {
                line.replace_range(7..15, "A0010000")
            }
            _ => {}
        }
        if master.write_all(line.as_bytes()).is_err() {
            return;
        }
    }
    let _ = master.shutdown(Shutdown::Both);
}
