//! SocketCAN: a network interface of Linux, set up with `ip`.

use super::Adapter;
use crate::stop::Stop;

#[cfg(not(target_os = "linux"))]
pub fn connect(_: &str, _: Option<canopen_node::BitRate>) -> Result<Box<dyn Adapter>, Stop> {
    Err(Stop::NoAdapter("socketcan: exists on Linux only; use slcan:".into()))
}

#[cfg(target_os = "linux")]
pub use linux::connect;

#[cfg(target_os = "linux")]
mod linux {
    use std::{
        fs, io, mem,
        process::Command,
        thread,
        time::{Duration, Instant, UNIX_EPOCH},
    };

    use canopen_node::{BitRate, Frame};
    use socketcan::{CanFrame, CanSocket, EmbeddedFrame, Socket, SocketOptions, StandardId};

    use super::{Adapter, Stop};
    use crate::adapter::{Mode, Received, Status, is_timeout};

    /// The wait for room in the interface's queue.
    const QUEUE: Duration = Duration::from_millis(200);
    /// Classes of error frames: all but those of the transceiver and of a lost arbitration.
    const ERRORS: u32 = 0x1FFF_FFFF & !(0x10 | 0x02);
    /// The class "controller problem" of error frames, and its bits for error passive in data byte 1.
    const CONTROLLER: u32 = 0x04;
    const PASSIVE: u8 = 0x10 | 0x20;
    const BUS_OFF: u32 = 0x40;
    /// The error number "no buffer space available".
    const ENOBUFS: i32 = 105;

    struct SocketCan {
        interface: String,
        /// The rate of an interface that is up, and that this program must leave alone.
        fixed_rate: Option<BitRate>,
        /// `None` while the interface is down.
        socket: Option<CanSocket>,
        status: Status,
        reports_errors: bool,
    }

    /// Finds the interface.
    pub fn connect(interface: &str, fixed_rate: Option<BitRate>) -> Result<Box<dyn Adapter>, Stop> {
        let none = |why: &str| Err(Stop::NoAdapter(format!("socketcan:{interface}: {why}")));
        match fs::read_to_string(format!("/sys/class/net/{interface}/type")) {
            // ARPHRD_CAN
            Ok(kind) if kind.trim() == "280" => {}
            Ok(_) => return none("it is no CAN interface"),
            Err(_) => {
                return none("there is no such interface; `ip link show type can` lists them");
            }
        }
        Ok(Box::new(SocketCan {
            interface: interface.to_owned(),
            fixed_rate,
            socket: None,
            status: Status::default(),
            reports_errors: false,
        }))
    }

    impl SocketCan {
        fn ip(&self, arguments: &[&str]) -> Result<(), Stop> {
            let output =
                Command::new("ip").args(["link", "set", &self.interface]).args(arguments).output();
            let why = match output {
                Ok(output) if output.status.success() => return Ok(()),
                Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
                Err(error) => error.to_string(),
            };
            Err(Stop::NoAdapter(format!(
                "`ip link set {} {}` fails: {why}. Run as root, or with the capability NET_ADMIN",
                self.interface,
                arguments.join(" ")
            )))
        }

        fn set_up(&self, rate: BitRate, mode: Mode) -> Result<(), Stop> {
            let bit_per_s = format!("{}000", rate.kbit_per_s());
            self.ip(&["type", "can", "bitrate", &bit_per_s])?;
            let listen = if mode == Mode::ListenOnly { "on" } else { "off" };
            if let Err(error) = self.ip(&["type", "can", "listen-only", listen])
                && mode == Mode::ListenOnly
            {
                return Err(error);
            }
            // Not every driver can recover from bus-off by itself, and report each error.
            let _ = self.ip(&["type", "can", "restart-ms", "100"]);
            let _ = self.ip(&["type", "can", "berr-reporting", "on"]);
            self.ip(&["up"])
        }

        fn gone(&self, why: &str) -> Stop {
            Stop::AdapterGone(format!("socketcan:{}: {why}", self.interface))
        }

        fn lose(&mut self, error: &io::Error) -> Stop {
            self.socket = None;
            self.gone(&error.to_string())
        }

        fn socket(&self) -> Result<&CanSocket, Stop> {
            self.socket.as_ref().ok_or_else(|| self.gone("it is down"))
        }

        fn note(&mut self, error: &socketcan::CanErrorFrame) {
            let class = error.error_bits();
            let is_passive = class & CONTROLLER != 0
                && error.data().get(1).is_some_and(|flags| flags & PASSIVE != 0);
            self.status.is_error_passive |= is_passive || class & BUS_OFF != 0;
            self.status.has_errors = true;
        }
    }

    impl Adapter for SocketCan {
        fn open(&mut self, rate: BitRate, mode: Mode) -> Result<(), Stop> {
            self.close()?;
            match self.fixed_rate {
                None => self.set_up(rate, mode)?,
                Some(fixed) if fixed == rate => {}
                Some(_) => return Err(Stop::NoAdapter("its bit rate is fixed".into())),
            }
            let lost = |error: io::Error| {
                Stop::NoAdapter(format!("socketcan:{}: {error}", self.interface))
            };
            let socket = CanSocket::open(&self.interface).map_err(lost)?;
            socket.set_recv_timestamp(true).map_err(lost)?;
            socket.set_error_filter(ERRORS).map_err(lost)?;
            socket.set_write_timeout(QUEUE).map_err(lost)?;
            self.socket = Some(socket);
            self.status = Status::default();
            Ok(())
        }

        fn close(&mut self) -> Result<(), Stop> {
            self.socket = None;
            if self.fixed_rate.is_none() { self.ip(&["down"]) } else { Ok(()) }
        }

        fn fixed_rate(&self) -> Option<BitRate> {
            self.fixed_rate
        }

        fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
            let id = StandardId::new(frame.cob_id()).unwrap_or(StandardId::ZERO);
            let Some(frame) = CanFrame::new(id, frame.data()) else { return Ok(()) };
            let until = Instant::now() + QUEUE;
            loop {
                match self.socket()?.write_frame(&frame) {
                    Ok(()) => return Ok(()),
                    // The queue is full of frames that nobody acknowledges: the status shows it.
                    Err(error) if is_full(&error) && Instant::now() < until => {
                        thread::sleep(Duration::from_millis(1));
                    }
                    Err(error) if is_full(&error) => return Ok(()),
                    Err(error) => return Err(self.lose(&error)),
                }
            }
        }

        fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
            let until = Instant::now() + wait;
            loop {
                let wait = until.saturating_duration_since(Instant::now());
                let socket = self.socket()?;
                // Zero would mean no limit.
                let read = socket
                    .set_read_timeout(wait.max(Duration::from_millis(1)))
                    .and_then(|()| socket.read_frame_with_timestamp());
                match read {
                    Ok((CanFrame::Error(error), _)) => self.note(&error),
                    Ok((frame, at)) => {
                        if let Some(frame) = Frame::received(&frame) {
                            let at = at.duration_since(UNIX_EPOCH).unwrap_or_default();
                            return Ok(Some(Received { frame, at, here: Instant::now() }));
                        }
                    }
                    Err(error) if is_timeout(&error) => {}
                    Err(error) => return Err(self.lose(&error)),
                }
                if wait.is_zero() {
                    return Ok(None);
                }
            }
        }

        fn status(&mut self) -> Result<Option<Status>, Stop> {
            // A driver that has reported no error may be one that reports none.
            let status = mem::take(&mut self.status);
            self.reports_errors |= status.has_errors;
            Ok(self.reports_errors.then_some(status))
        }

        fn clock(&self) -> &'static str {
            "the kernel's time stamps"
        }

        fn description(&self) -> String {
            format!("socketcan:{}", self.interface)
        }
    }

    fn is_full(error: &io::Error) -> bool {
        error.raw_os_error() == Some(ENOBUFS) || is_timeout(error)
    }
}
