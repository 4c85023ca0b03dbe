//! Configure and activate bit timing, with both switch delays (CiA 305).

use std::time::Duration;

use canopen_node::BitRate;

use super::{Feature, configured};
use crate::{Bench, Case, Group, Step, Stop, ms};

pub const GROUP: Group = Group {
    name: "LSS bit rate",
    prepare: |bench| {
        bench.needs_feature(Feature::BitTiming)?;
        configured(bench)
    },
    cases: CASES,
};

const CASES: &[Case] = &[
    Case::new("Table 0 accepts the bit rates of the data sheet and refuses the others", table),
    Case::new("The reserved index 5 and those from 10 are refused", |bench| {
        bench.enter()?;
        [5].into_iter().chain(10..=0xFF).try_for_each(|index| bench.refused(&[0x13, 0, index]))
    }),
    Case::new("Index 9 is accepted by a device with automatic detection, else refused", |bench| {
        bench.enter()?;
        match bench.lss.without.contains(&Feature::Detect) {
            true => bench.refused(&[0x13, 0, 9]),
            false => bench.play("13 00 09 = 13"),
        }
    }),
    Case::new("Other tables are refused", |bench| {
        bench.enter()?;
        let index = bench.lss.rate.index();
        [1, 2, 0x7F, 0x80, 0xFF].iter().try_for_each(|table| bench.refused(&[0x13, *table, index]))
    }),
    Case::new("13 alone does not change the bit rate, nor does reset communication", |bench| {
        let new = other_rate(bench);
        bench.enter()?;
        bench.lss(&[0x13, 0, new.index()], &[0x13])?;
        bench.play("5E = 5E NN; reset communication; boot-up NN")
    }),
    Case::new("The first delay: the device leaves the old bit rate to the ms", first_delay),
    Case::new(
        "The second delay: the device answers again, at the new bit rate, to the ms",
        |bench| {
            second_delay(bench, 1)?;
            second_delay(bench, 100)
        },
    ),
    Case::new("Without a delay the device switches at once", |bench| second_delay(bench, 0)),
    Case::new("The longest delay, FFFFh, is twice 65.535 s", |bench| second_delay(bench, 0xFFFF)),
    Case::new("The device sends nothing in both delays, no heartbeat either", |bench| {
        if bench.has_sdo()? {
            // A device without a heartbeat refuses it.
            let _ = bench.download((0x1017, 0), &100_u16.to_le_bytes())?;
        }
        switched(bench, 1_500, |bench, t0, new| {
            wait_until(bench, t0 + ms(2))?;
            silent_until(bench, t0 + ms(1_500))?;
            bench.set_rate(new)?;
            silent_until(bench, t0 + ms(3_000) - ms(1) - bench.jitter)
        })
    }),
    Case::new("The switch changes neither the LSS state nor the NMT state", |bench| {
        switched(bench, 50, |bench, t0, new| {
            follow(bench, t0, 50, new)?;
            bench.expect_configuring()?;
            let boot_up = bench.wait_for(ms(500), |frame| frame.data() == [0])?;
            bench.check(boot_up.is_none(), "no boot-up")
        })
    }),
    Case::new("Reset communication keeps the new bit rate", |bench| {
        switched(bench, 50, |bench, t0, new| {
            follow(bench, t0, 50, new)?;
            bench.play("reset communication; boot-up NN")
        })
    }),
    Case::new("Reset node brings the stored bit rate back", |bench| {
        switched(bench, 50, |bench, t0, new| {
            follow(bench, t0, 50, new)?;
            bench.restart()?;
            bench.set_rate(bench.lss.rate)?;
            let is_there = bench.find(ms(3_000))?.is_some();
            bench.check(is_there, "an answer at the stored bit rate")
        })
    }),
];

/// A bit rate that the device has not stored.
pub fn other_rate(bench: &Bench) -> BitRate {
    match bench.lss.rate {
        BitRate::Kbit250 => BitRate::Kbit125,
        _ => BitRate::Kbit250,
    }
}

fn wait_until(bench: &mut Bench, time: Duration) -> Step {
    bench.pass(time.saturating_sub(bench.now()))
}

fn silent_until(bench: &mut Bench, time: Duration) -> Step {
    let frame = bench.wait_for(time.saturating_sub(bench.now()), |_| true)?;
    bench.check(frame.is_none(), "no frame before twice the delay")
}

/// The time of a frame on the bus, with stuff bits.
fn frame_time(rate: BitRate) -> Duration {
    Duration::from_micros(135_000 / u64::from(rate.kbit_per_s()))
}

/// Sends 15; returns the end of the frame.
pub fn activate(bench: &mut Bench, delay: u16) -> Step<Duration> {
    let [low, high] = delay.to_le_bytes();
    let time = frame_time(bench.lss.now);
    bench.request(&[0x15, low, high])?;
    Ok(bench.now() + time)
}

/// Joins the new bit rate in the second delay, and waits for its end.
pub fn follow(bench: &mut Bench, t0: Duration, delay: u16, new: BitRate) -> Step {
    let delay = ms(delay.into());
    wait_until(bench, t0 + delay + ms(1))?;
    bench.set_rate(new)?;
    let margin = ms(2) + 2 * bench.jitter;
    wait_until(bench, t0 + 2 * delay + margin)
}

/// Skips the case if the line or the device cannot change the bit rate.
pub fn needs_switch(bench: &mut Bench) -> Step {
    bench.needs_feature(Feature::BitTiming)?;
    bench.needs_feature(Feature::Activate)?;
    bench.needs_bit_rates()
}

/// Switches the device to another bit rate; `body` gets the end of the request and that rate. Then it is brought back.
pub fn switched(
    bench: &mut Bench,
    delay: u16,
    body: impl FnOnce(&mut Bench, Duration, BitRate) -> Step,
) -> Step {
    needs_switch(bench)?;
    let new = other_rate(bench);
    bench.enter()?;
    bench.lss(&[0x13, 0, new.index()], &[0x13])?;
    let t0 = activate(bench, delay)?;
    let outcome = body(bench, t0, new);
    if let Err(Stop::Broken(_)) = outcome {
        return outcome;
    }
    bench.note("the stored bit rate again");
    follow(bench, t0, delay, new)?;
    bench.restart()?;
    bench.set_rate(bench.lss.rate)?;
    outcome
}

fn table(bench: &mut Bench) -> Step {
    bench.enter()?;
    for rate in BitRate::ALL {
        let request = [0x13, 0, rate.index()];
        let key = format!("BaudRate_{}", rate.kbit_per_s());
        match bench.eds.number("DeviceInfo", &key) {
            Some(0) => bench.refused(&request)?,
            Some(_) => bench.lss(&request, &[0x13])?,
            None => {
                let answer = bench.ask_lss(&request, super::PATIENCE)?;
                let is_answer = answer.is_some_and(|answer| answer[0] == 0x13);
                bench.check(is_answer, format!("{rate} is accepted or refused"))?;
            }
        }
    }
    Ok(())
}

/// Before the delay has passed the device acknowledges at the old bit rate, afterwards at the new one.
fn first_delay(bench: &mut Bench) -> Step {
    const NO_REQUEST: &[u8] = &[0];
    const UNSENT: &str = "say whether a frame was acknowledged";
    bench.lab(UNSENT)?;
    switched(bench, 100, |bench, t0, new| {
        let switch = t0 + ms(100);
        let early = switch - ms(1) - frame_time(bench.lss.now);
        wait_until(bench, early)?;
        bench.request_at_once(NO_REQUEST)?;
        wait_until(bench, switch - ms(1) + Duration::from_micros(100))?;
        let is_sent = bench.lab(UNSENT)?.unsent() == 0;
        bench.check(is_sent, "an acknowledge at the old bit rate, 1 ms before the switch")?;
        wait_until(bench, switch + ms(1))?;
        bench.set_rate(new)?;
        bench.request_at_once(NO_REQUEST)?;
        wait_until(bench, switch + ms(1) + 2 * frame_time(new))?;
        let is_sent = bench.lab(UNSENT)?.unsent() == 0;
        bench.check(is_sent, "an acknowledge at the new bit rate, 1 ms after the switch")
    })
}

/// Asks every millisecond: the first answer comes as soon as twice the delay has passed, to the millisecond.
fn second_delay(bench: &mut Bench, delay: u16) -> Step {
    switched(bench, delay, |bench, t0, new| {
        wait_until(bench, t0 + ms(delay.into()))?;
        bench.set_rate(new)?;
        let end = t0 + 2 * ms(delay.into());
        wait_until(bench, end.saturating_sub(ms(20)))?;
        // A question that comes too early, the next one, and its answer.
        let latest = end + ms(1) + 2 * frame_time(new) + bench.jitter;
        while bench.now() < latest {
            bench.request_at_once(&[0x5E])?;
            if let Some((time, _)) = bench.wait_for(ms(1), super::is_answer)? {
                let is_late_enough = time + bench.jitter >= end;
                bench.check(is_late_enough, "no answer before twice the delay has passed")?;
                return bench.check(time <= latest, "an answer as soon as it has passed");
            }
        }
        bench.fail("an answer as soon as twice the delay has passed")
    })
}
