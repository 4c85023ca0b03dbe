//! The line to the device: an adapter. That of a laboratory also has a hand on power and memory.

use can_bus::adapter::Adapter;

/// An adapter on a bus of emulated devices, or of devices in the process.
pub trait Lab: Adapter {
    /// Cuts or restores the supply of the devices on the bus.
    fn power(&mut self, is_on: bool);
    /// Puts the first `count` devices of an LSS address on the bus, and takes the others off.
    fn attach(&mut self, count: usize);
    /// The number of queued frames that no device has acknowledged yet.
    fn unsent(&mut self) -> usize;
    /// Makes the storage medium of the first device fail, or work again.
    fn fail_stores(&mut self, fails: bool);
}

/// The line to the device. The cases that need a laboratory are skipped on another adapter.
pub enum Line<'a> {
    Adapter(&'a mut dyn Adapter),
    Lab(&'a mut dyn Lab),
}
