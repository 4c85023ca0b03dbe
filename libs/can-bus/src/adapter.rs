//! The CAN adapter: one interface to SLCAN over a serial line or TCP, and to SocketCAN.

#[cfg(feature = "adapters")]
mod slcan;
#[cfg(feature = "adapters")]
mod socketcan;

use std::{
    fmt,
    str::FromStr,
    time::{Duration, Instant},
};

use canopen_node::{BitRate, Frame};

use crate::stop::Stop;

#[cfg(feature = "adapters")]
pub use slcan::{Port, Slcan};

/// The part that an adapter takes on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Sends, receives and acknowledges.
    Normal,
    /// Receives and never drives the bus.
    ListenOnly,
}

/// A frame from the bus.
#[derive(Clone, Copy, Debug)]
pub struct Received {
    pub frame: Frame,
    /// The time of reception on the clock of [`Adapter::clock`], since an arbitrary instant.
    pub at: Duration,
    /// The time at which this program got the frame.
    pub here: Instant,
}

/// The clock of [`Received::at`] if the adapter has none: its latency and that of the computer are in the times.
pub const HOST_CLOCK: &str = "the computer's clock, since the adapter has no time stamps";

/// The adapter's view of the bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// Its error counters are above 127, or it is bus-off.
    pub is_error_passive: bool,
    /// It has found errors since the last question.
    pub has_errors: bool,
}

/// A CAN adapter. After an error it can be opened again, which connects to it again.
pub trait Adapter {
    /// Joins the bus at `rate`. An open adapter leaves the bus first and drops its waiting frames.
    fn open(&mut self, rate: BitRate, mode: Mode) -> Result<(), Stop>;
    /// Leaves the bus.
    fn close(&mut self) -> Result<(), Stop>;
    fn send(&mut self, frame: &Frame) -> Result<(), Stop>;
    /// Sends a remote frame; false if this adapter cannot.
    fn send_remote(&mut self, _cob_id: u16, _length: u8) -> Result<bool, Stop> {
        Ok(false)
    }
    /// Sends a data frame with a 29-bit identifier; false if this adapter cannot.
    fn send_extended(&mut self, _id: u32, _data: &[u8]) -> Result<bool, Stop> {
        Ok(false)
    }
    /// The next frame, if one comes within `wait`. Remote frames and those with 29-bit identifiers are skipped.
    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop>;
    /// The adapter's errors, if it can report them.
    fn status(&mut self) -> Result<Option<Status>, Stop> {
        Ok(None)
    }
    /// Waits until the adapter has carried out what it was told before, if it answers questions.
    fn settle(&mut self) -> Result<(), Stop> {
        Ok(())
    }
    /// The time of this program, which passes while it waits for frames.
    fn now(&self) -> Instant {
        Instant::now()
    }
    /// The clock of [`Received::at`], for a person.
    fn clock(&self) -> &'static str {
        HOST_CLOCK
    }
    /// The only bit rate that the adapter can be opened at.
    fn fixed_rate(&self) -> Option<BitRate> {
        None
    }
    /// The time from a question to the adapter itself to its answer, if that is known.
    fn latency(&self) -> Option<Duration> {
        None
    }
    /// The adapter and its version, for a person.
    fn description(&self) -> String;
    /// What a person must know of it, as far as that has shown.
    fn doubts(&self) -> Vec<String> {
        Vec::new()
    }
}

/// Whether a read or a write has only come to the end of its wait.
#[cfg(feature = "adapters")]
fn is_timeout(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    [TimedOut, WouldBlock, Interrupted].contains(&error.kind())
}

/// The place of an adapter, as on the command line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// `slcan:DEVICE`, with `@BAUD` if the line is no USB device.
    Serial { device: String, baud: u32 },
    /// `slcan:tcp:HOST:PORT`.
    Tcp(String),
    /// `socketcan:INTERFACE`, with `@KBIT` if the interface is up and its bit rate cannot be set.
    SocketCan { interface: String, fixed_rate: Option<BitRate> },
}

/// The baud rate of a serial line; USB devices ignore it.
const BAUD: u32 = 115_200;

impl FromStr for Place {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        const USE: &str = "use slcan:/dev/ttyACM0, slcan:tcp:HOST:PORT or socketcan:can0";
        let (kind, rest) = text.split_once(':').filter(|(_, rest)| !rest.is_empty()).ok_or(USE)?;
        let (name, option) = match rest.rsplit_once('@') {
            Some((name, option)) => (name.to_owned(), Some(option)),
            None => (rest.to_owned(), None),
        };
        match kind {
            "slcan" if let Some(address) = rest.strip_prefix("tcp:") => {
                let port = address.rsplit_once(':').and_then(|(_, port)| port.parse::<u16>().ok());
                port.map(|_| Self::Tcp(address.to_owned()))
                    .ok_or("slcan:tcp: needs HOST:PORT".into())
            }
            "slcan" => {
                let baud = option.map_or(Ok(BAUD), str::parse).map_err(|_| "@BAUD is a number")?;
                Ok(Self::Serial { device: name, baud })
            }
            "socketcan" => Ok(Self::SocketCan {
                interface: name,
                fixed_rate: option.map(bit_rate).transpose()?,
            }),
            _ => Err(USE.into()),
        }
    }
}

/// The bit rate with this number of kbit/s: `125`, `125k` or `125000`.
pub fn bit_rate(kbit: &str) -> Result<BitRate, String> {
    let is_it = |rate: &BitRate| {
        let rest = kbit.strip_prefix(&rate.kbit_per_s().to_string());
        rest.is_some_and(|rest| ["", "k", "000"].contains(&rest))
    };
    let rate = BitRate::ALL.into_iter().find(is_it);
    rate.ok_or_else(|| {
        format!("{kbit} is no bit rate of CiA 301 in kbit/s: 1000, 800, 500, 250, 125, 50, 20, 10")
    })
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Serial { device, .. } => write!(f, "slcan:{device}"),
            Self::Tcp(address) => write!(f, "slcan:tcp:{address}"),
            Self::SocketCan { interface, .. } => write!(f, "socketcan:{interface}"),
        }
    }
}

impl Place {
    /// Whether it is an interface that the system has up, and whose bit rate is not named. To set its bit rate would
    /// take it down.
    pub fn is_up(&self) -> bool {
        /// IFF_UP of Linux.
        const UP: u32 = 1;
        let Self::SocketCan { interface, fixed_rate: None } = self else { return false };
        let flags = std::fs::read_to_string(format!("/sys/class/net/{interface}/flags"));
        let flags = flags
            .ok()
            .and_then(|text| u32::from_str_radix(text.trim().trim_start_matches("0x"), 16).ok());
        flags.is_some_and(|flags| flags & UP != 0)
    }

    /// Connects to the adapter, which stays off the bus.
    #[cfg(feature = "adapters")]
    pub fn connect(&self) -> Result<Box<dyn Adapter>, Stop> {
        Ok(match self {
            Self::Serial { .. } | Self::Tcp(_) => {
                Box::new(Slcan::new(self.clone(), slcan::connect(self)?)?)
            }
            Self::SocketCan { interface, fixed_rate } => {
                socketcan::connect(interface, *fixed_rate)?
            }
        })
    }
}

/// The adapters that this computer has, with what is known of each: USB devices with a serial port, and interfaces of
/// SocketCAN.
#[cfg(feature = "adapters")]
pub fn list() -> Vec<(Place, String)> {
    use serialport::SerialPortType::UsbPort;
    let ports = serialport::available_ports().unwrap_or_default().into_iter();
    let usb = ports.filter_map(|port| {
        let UsbPort(usb) = port.port_type else { return None };
        let words = usb.product.unwrap_or_else(|| format!("{:04X}:{:04X}", usb.vid, usb.pid));
        Some((Place::Serial { device: port.port_name, baud: BAUD }, words))
    });
    /// ARPHRD_CAN of Linux.
    const CAN: &str = "280";
    let interfaces = std::fs::read_dir("/sys/class/net").into_iter().flatten().flatten();
    let is_can = |folder: &std::path::Path| {
        std::fs::read_to_string(folder.join("type")).is_ok_and(|number| number.trim() == CAN)
    };
    let can = interfaces.filter(|entry| is_can(&entry.path())).map(|entry| {
        let interface = entry.file_name().to_string_lossy().into_owned();
        (Place::SocketCan { interface, fixed_rate: None }, "SocketCAN".to_owned())
    });
    usb.chain(can).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_three_kinds_of_adapters_are_recognised() {
        let serial = |device: &str, baud| Ok(Place::Serial { device: device.into(), baud });
        assert_eq!("slcan:/dev/ttyACM0".parse(), serial("/dev/ttyACM0", BAUD));
        assert_eq!("slcan:COM3@1000000".parse(), serial("COM3", 1_000_000));
        assert_eq!("slcan:tcp:[::1]:29536".parse(), Ok(Place::Tcp("[::1]:29536".into())));
        let socketcan = |fixed_rate| Ok(Place::SocketCan { interface: "can0".into(), fixed_rate });
        assert_eq!("socketcan:can0".parse(), socketcan(None));
        assert_eq!("socketcan:can0@125".parse(), socketcan(Some(BitRate::Kbit125)));
        for text in [
            "",
            "can0",
            "slcan:",
            "slcan:tcp:",
            "slcan:tcp:host",
            "socketcan:",
            "socketcan:can0@100",
            "pcan:1",
        ] {
            assert!(text.parse::<Place>().is_err(), "{text}");
        }
    }
}
