//! An LSS master on the emulated bus.

use canopen_node::{BitRate, Instant};
use emulator::{
    Time,
    network::{AdapterId, Network},
};
use lss_master::{Error, Master, Output, Procedure, Timing};

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
    let mut session = master.start(procedure);
    loop {
        let now = Instant::from_micros(network.now().as_us() as u32);
        match session.poll(now) {
            Output::Transmit(request) => network.send(adapter, on_the_wire(&request)),
            Output::SetBitRate(rate) => network.adapter_mut(adapter).set_bit_rate(bit_per_s(rate)),
            Output::Wait(until) => {
                let wait = Time::from_us(until.micros_after(now).into());
                if let Some((time, frame)) = network.run_until_received(adapter, wait)
                    && let Some(frame) = from_the_wire(&frame)
                {
                    session.handle_frame(&frame, Instant::from_micros(time.as_us() as u32));
                }
            }
            Output::Done(result) => return result,
        }
    }
}
