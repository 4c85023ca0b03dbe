//! The loop that connects a procedure of the master to a bus.

use lss_slave::{BitRate, Frame, Instant};

use crate::{Error, Master, Output, Procedure};

/// A CAN adapter and a clock, on which [`run`] carries out procedures.
pub trait Bus {
    /// A failure of the adapter, which ends the procedure.
    type Error;

    /// The present time.
    fn now(&self) -> Instant;

    /// Sends a frame.
    fn send(&mut self, frame: &Frame) -> Result<(), Self::Error>;

    /// Waits for a frame, at most until this instant, which may be past; gives `take` what was received, and when.
    fn receive(
        &mut self,
        until: Instant,
        take: impl FnMut(&Frame, Instant),
    ) -> Result<(), Self::Error>;

    /// Joins the bus at another bit rate.
    fn set_bit_rate(&mut self, bit_rate: BitRate) -> Result<(), Self::Error>;
}

/// Carries out a procedure of the master on a bus. Its result is within that of the adapter.
pub fn run<B: Bus, P: Procedure>(
    bus: &mut B,
    master: &mut Master,
    procedure: P,
) -> Result<Result<P::Output, Error>, B::Error> {
    let mut session = master.start(procedure);
    loop {
        match session.poll(bus.now()) {
            Output::Transmit(frame) => bus.send(&frame)?,
            Output::SetBitRate(bit_rate) => bus.set_bit_rate(bit_rate)?,
            Output::Wait(until) => {
                bus.receive(until, |frame, now| session.handle_frame(frame, now))?;
            }
            Output::Done(result) => return Ok(result),
        }
    }
}
