//! An LSS master on the emulated bus.

use std::convert::Infallible;

use canopen_node::{BitRate, Frame, Instant};
use emulator::{
    Time,
    network::{AdapterId, Network},
};
use lss_master::{Bus, Error, Master, Procedure, Timing};

use super::wire::{bit_per_s, from_the_wire, on_the_wire};

/// More bits than any frame, intermission included.
const FRAME_BITS: u32 = 160;

/// The time-outs for boards with the release image on a bus where other nodes send a frame now and then.
pub fn timing(bit_rate: BitRate) -> Timing {
    let frame = FRAME_BITS * 1_000_000 / bit_per_s(bit_rate);
    let answer = 20_000 + 2 * frame;
    Timing { answer, store: answer, margin: 50 + frame, gap: 0 }
}

/// Carries out a procedure of the master, which uses this adapter alone.
pub fn carry_out<P: Procedure>(
    network: &mut Network,
    adapter: AdapterId,
    master: &mut Master,
    procedure: P,
) -> Result<P::Output, Error> {
    while network.receive(adapter).is_some() {}
    let Ok(result) = lss_master::run(&mut OnBus { network, adapter }, master, procedure);
    result
}

/// An adapter on the emulated bus.
struct OnBus<'a> {
    network: &'a mut Network,
    adapter: AdapterId,
}

impl Bus for OnBus<'_> {
    type Error = Infallible;

    fn now(&self) -> Instant {
        instant(self.network.now())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Infallible> {
        self.network.send(self.adapter, on_the_wire(frame));
        Ok(())
    }

    fn receive(
        &mut self,
        until: Instant,
        mut take: impl FnMut(&Frame, Instant),
    ) -> Result<(), Infallible> {
        let wait = Time::from_us(until.micros_after(self.now()).into());
        if let Some((time, frame)) = self.network.run_until_received(self.adapter, wait)
            && let Some(frame) = from_the_wire(&frame)
        {
            take(&frame, instant(time));
        }
        Ok(())
    }

    fn set_bit_rate(&mut self, bit_rate: BitRate) -> Result<(), Infallible> {
        self.network.adapter_mut(self.adapter).set_bit_rate(bit_per_s(bit_rate));
        Ok(())
    }
}

fn instant(time: Time) -> Instant {
    Instant::from_micros(time.as_us() as u32)
}
