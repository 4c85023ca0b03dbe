//! The line to the device, as the cases see it.

use std::{fmt, time::Duration};

use canopen_node::{BitRate, Frame};

/// A line that no longer works, in words: the run ends.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Broken(pub String);

impl fmt::Display for Broken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Broken {}

/// A CAN adapter on the bus of the device, real or emulated. Times begin at an arbitrary instant.
///
/// What a line cannot do it answers with `false`; the cases that need it are skipped.
pub trait Line {
    fn now(&self) -> Duration;

    /// Queues a frame: it is on the bus as soon as the bus allows.
    ///
    /// # Errors
    /// The line has broken.
    fn send(&mut self, frame: &Frame) -> Result<(), Broken>;

    /// The next data frame with an 11-bit identifier, with its time, if one comes before `until`.
    ///
    /// # Errors
    /// The line has broken.
    fn receive(&mut self, until: Duration) -> Result<Option<(Duration, Frame)>, Broken>;

    /// How much earlier or later than on the bus a frame can be seen.
    fn jitter(&self) -> Duration;

    /// Queues a remote frame.
    ///
    /// # Errors
    /// The line has broken.
    fn send_remote(&mut self, _cob_id: u16, _length: u8) -> Result<bool, Broken> {
        Ok(false)
    }

    /// Queues a data frame with a 29-bit identifier.
    ///
    /// # Errors
    /// The line has broken.
    fn send_extended(&mut self, _id: u32, _data: &[u8]) -> Result<bool, Broken> {
        Ok(false)
    }

    /// Joins the bus at another bit rate.
    ///
    /// # Errors
    /// The line has broken.
    fn set_bit_rate(&mut self, _rate: BitRate) -> Result<bool, Broken> {
        Ok(false)
    }

    /// Cuts or restores the supply of the device.
    ///
    /// # Errors
    /// The line has broken.
    fn power(&mut self, _is_on: bool) -> Result<bool, Broken> {
        Ok(false)
    }

    /// Puts the first `count` devices of an LSS address on the bus, and takes the others off.
    ///
    /// # Errors
    /// The line has broken.
    fn attach(&mut self, count: usize) -> Result<bool, Broken> {
        Ok(count == 1)
    }

    /// The number of queued frames that no device has acknowledged yet, or `None` if the line does not know it.
    ///
    /// # Errors
    /// The line has broken.
    fn unsent(&mut self) -> Result<Option<usize>, Broken> {
        Ok(None)
    }

    /// Makes the storage medium of the device fail, or work again.
    ///
    /// # Errors
    /// The line has broken.
    fn fail_stores(&mut self, _fails: bool) -> Result<bool, Broken> {
        Ok(false)
    }
}
