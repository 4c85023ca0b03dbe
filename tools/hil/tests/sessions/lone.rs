//! Benches without a board: a diagnosis in time, and programs that act as adapters.

use std::{
    io::{BufReader, Read, Write},
    net::{SocketAddr, TcpListener, TcpStream},
    thread,
    time::Duration,
};

use crate::run::{self, Run};

/// The longest diagnosis.
const LIMIT: Duration = Duration::from_secs(40);

/// Another program with an adapter on the bus.
pub struct Program(pub TcpStream);

impl Program {
    pub fn connect(address: SocketAddr) -> Self {
        Self(TcpStream::connect(address).expect("it listens"))
    }

    pub fn send(&mut self, line: &str) {
        assert!(self.try_send(line));
    }

    pub fn try_send(&mut self, line: &str) -> bool {
        self.0.write_all(format!("{line}\r").as_bytes()).is_ok()
    }
}

/// An adapter with nothing on its bus, which answers each command with what `answer` returns.
fn adapter(answer: fn(&str) -> &'static [u8]) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = listener.local_addr().expect("it is bound");
    thread::spawn(move || {
        for mut stream in listener.incoming().flatten() {
            let mut reader = BufReader::new(stream.try_clone().expect("a socket")).bytes();
            let mut line = String::new();
            while let Some(Ok(byte)) = reader.next() {
                if byte != b'\r' {
                    line.push(char::from(byte));
                } else if stream.write_all(answer(&std::mem::take(&mut line))).is_err() {
                    break;
                }
            }
        }
    });
    format!("slcan:tcp:{address}")
}

#[track_caller]
fn assert_diagnosed(run: &Run, words: &str) {
    run.assert_named(words);
    run.assert_left("untouched");
    assert!(run.took < LIMIT, "{:?}", run.took);
}

#[test]
fn no_adapter_is_diagnosed() {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = listener.local_addr().expect("it is bound");
    drop(listener);
    assert_diagnosed(&run::run("none", &format!("slcan:tcp:{address}"), &[]), "no adapter");
    assert_diagnosed(
        &run::run("none-serial", "slcan:/dev/ttyNone", &[]),
        "no adapter: slcan:/dev/ttyNone",
    );
    let run = run::run("none-socketcan", "socketcan:none0", &[]);
    assert_diagnosed(&run, "no adapter: socketcan:none0");
}

#[test]
fn a_device_that_answers_nothing_may_be_an_adapter_and_is_told() {
    let adapter = adapter(|_| b"");
    let run = run::run("mute", &adapter, &[]);
    assert!(run.output.contains("which reports no version"));
    assert_diagnosed(&run, "no answer at any bit rate");
}

#[test]
fn an_adapter_alone_on_the_bus_is_diagnosed() {
    // Errors are reported from the first frame to send on; this adapter is asked after it listened.
    static HAS_SENT: std::sync::atomic::AtomicBool = std::sync::atomic::AtomicBool::new(false);
    use std::sync::atomic::Ordering::SeqCst;
    let adapter = adapter(|line| match line.chars().next() {
        Some('V') => b"V1013\r",
        Some('t') => {
            HAS_SENT.store(true, SeqCst);
            b"z\r"
        }
        Some('F') if HAS_SENT.load(SeqCst) => b"FA4\r",
        Some('F') => b"F00\r",
        Some('C') => {
            HAS_SENT.store(false, SeqCst);
            b"\r"
        }
        _ => b"\r",
    });
    assert_diagnosed(&run::run("alone", &adapter, &[]), "nobody acknowledges at any bit rate");
}

#[test]
fn an_adapter_without_a_status_is_diagnosed_too() {
    let adapter = adapter(|line| match line.chars().next() {
        Some('V') => b"V0001\r",
        Some('F' | 'Z') => b"\x07",
        // Slow bit rates are not to be had either.
        Some('S') if line < "S3" => b"\x07",
        _ => b"\r",
    });
    let run = run::run("statusless", &adapter, &[]);
    assert_diagnosed(&run, "no answer at any bit rate");
    assert_diagnosed(&run, "lacks 50 kbit/s, 20 kbit/s, 10 kbit/s: nobody was asked there");
}
