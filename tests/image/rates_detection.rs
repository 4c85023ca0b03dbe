//! The detection time of a release image that detects the bit rate, and its silence until then.

use crate::rig::*;

/// The silent bit of CAN_BTR (RM0090, 32.9.2).
const SILM: u32 = 1 << 31;
/// A frame with eight bytes, stuff bits and intermission, in bits.
const LONG_FRAME_BITS: u64 = 122;

/// Two nodes that exchange frames.
pub struct Traffic {
    others: [AdapterId; 2],
    frame: fn(usize) -> Frame,
    period: Time,
    next: Time,
    count: usize,
}

impl Traffic {
    /// One heartbeat a second.
    pub fn sparse(rig: &mut ImageRig, bit_rate: BitRate) -> Self {
        let heartbeat = |_| Frame::data(Id::Standard(0x705), &[0x05]);
        Self::new(rig, bit_rate, heartbeat, Time::from_s(1))
    }

    /// A bus load of 90 %.
    pub fn dense(rig: &mut ImageRig, bit_rate: BitRate) -> Self {
        let frame = |count: usize| {
            let data = (count as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            Frame::data(Id::Standard(0x181 + count as u16 % 2), &data.to_le_bytes())
        };
        let period = rig.bit_time() * LONG_FRAME_BITS * 10;
        Self::new(rig, bit_rate, frame, Time::from_ps(period.as_ps() / 9))
    }

    fn new(rig: &mut ImageRig, bit_rate: BitRate, frame: fn(usize) -> Frame, period: Time) -> Self {
        let others = rig.add_others(bit_rate);
        Self { others, frame, period, next: rig.network.now(), count: 0 }
    }

    pub fn run_for(&mut self, rig: &mut ImageRig, span: Time) {
        let until = rig.network.now() + span;
        while rig.network.now() < until {
            if self.next <= rig.network.now() {
                let frame = (self.frame)(self.count);
                rig.network.send(self.others[self.count % 2], frame);
                self.count += 1;
                self.next += self.period;
            }
            rig.network.run_until(self.next.min(until));
        }
    }
}

/// A board that detects the bit rate, without power, on a bus at `bit_rate`.
fn rig(bit_rate: BitRate, node_id: u8) -> ImageRig {
    let settings = settings(node_id, BitRateSetting::Automatic);
    let mut rig = ImageRig::new(bit_rate, [board_with(0, settings)]);
    rig.network.power_off(0);
    rig
}

/// Switches the board on while the bus is in use; returns the time.
pub fn switch_on(rig: &mut ImageRig) -> Time {
    rig.network.power_on(0);
    rig.network.now()
}

/// The times at which the board began to take part since `on`, after it had only listened, and its bit rates then.
pub fn takes_part(rig: &ImageRig, on: Time) -> impl Iterator<Item = (Time, u32)> {
    let timings = rig.did(0, on).filter_map(|event| match event.what {
        What::BitTiming { btr, bit_rate } => Some((event.time, btr & SILM != 0, bit_rate)),
        _ => None,
    });
    let since_silent = timings.skip_while(|(_, is_silent, _)| !is_silent);
    since_silent.filter(|(_, is_silent, _)| !is_silent).map(|(time, _, rate)| (time, rate))
}

/// The time at which the board knew the bit rate, and the rate.
fn found(rig: &ImageRig, on: Time) -> Option<(Time, u32)> {
    takes_part(rig, on).next()
}

/// Checks that before `until` the board requested no transmission, raised no error frame, and was always in silent
/// mode, so that it did not acknowledge either.
fn assert_silent(rig: &ImageRig, on: Time, until: Time) {
    let is_loud = |event: &&Event| match event.what {
        What::Requested { .. } | What::Error { .. } | What::Frame { .. } => true,
        What::BitTiming { btr, .. } => btr & SILM == 0,
        _ => false,
    };
    let loud: Vec<_> = rig.did(0, on).filter(|event| event.time < until).filter(is_loud).collect();
    assert!(loud.is_empty(), "{loud:#?}");
}

/// Lets the board find the rate; returns the time from power-on.
fn detect(rig: &mut ImageRig, traffic: &mut Traffic, bit_rate: BitRate) -> Time {
    let on = switch_on(rig);
    let (time, found_rate) = loop {
        traffic.run_for(rig, Time::from_ms(10));
        if let Some(found) = found(rig, on) {
            break found;
        }
        assert!(rig.network.now() < on + Time::from_s(30), "{bit_rate:?} is not found");
    };
    assert_eq!(found_rate, bit_per_s(bit_rate));
    assert_silent(rig, on, time);
    rig.network.power_off(0);
    time - on
}

#[test]
fn every_rate_is_found_in_sparse_and_dense_traffic_without_a_dominant_bit() {
    println!("time from power-on until the bit rate is known, shortest..longest in ms");
    println!("{:>7}  {:>19}  {:>19}", "kbit/s", "a heartbeat/s", "90 % load");
    for bit_rate in BitRate::ALL {
        let mut spans = Vec::new();
        for (make, phases, bound) in [
            (Traffic::sparse as fn(&mut ImageRig, BitRate) -> Traffic, 4, SPARSE_BOUND),
            (Traffic::dense, 4, DENSE_BOUND),
        ] {
            let mut rig = rig(bit_rate, 0x40);
            let mut traffic = make(&mut rig, bit_rate);
            let times: Vec<Time> = (0..phases)
                .map(|phase| {
                    traffic.run_for(&mut rig, Time::from_us(10_000 + phase * 236_770));
                    detect(&mut rig, &mut traffic, bit_rate)
                })
                .collect();
            let shortest = times.iter().min().expect("phases");
            let longest = times.iter().max().expect("phases");
            assert!(*longest < bound, "{bit_rate:?}: {longest} ms");
            spans.push(format!("{}..{}", shortest.as_ms(), longest.as_ms()));
        }
        println!("{:>7}  {:>19}  {:>19}", bit_rate.kbit_per_s(), spans[0], spans[1]);
    }
}

const SPARSE_BOUND: Time = Time::from_s(9);
const DENSE_BOUND: Time = Time::from_s(1);

#[test]
fn a_lone_sender_is_not_acknowledged_before_the_rate_is_known() {
    println!("time from power-on until a lone master is acknowledged, in ms");
    for bit_rate in BitRate::ALL {
        let mut rig = rig(bit_rate, 0x40);
        rig.send("04 01");
        rig.network.run_for(Time::from_ms(5));
        let on = switch_on(&mut rig);
        while rig.network.adapter_mut(rig.master).unsent() > 0 {
            assert!(rig.network.now() < on + Time::from_s(30), "{bit_rate:?} is not found");
            rig.network.run_for(Time::from_ms(1));
        }
        let (time, found_rate) = found(&rig, on).expect("only the board can acknowledge");
        assert_eq!(found_rate, bit_per_s(bit_rate));
        assert_silent(&rig, on, time);
        let of_master = |sent: &Sent| sent.by == Source::Adapter(rig.master);
        let sent = rig.sent(Time::ZERO).find(of_master).expect("it was sent").end;
        assert!(sent > time, "acknowledged at {sent}, known at {time}");
        println!("{:>7} kbit/s  {:>6}", bit_rate.kbit_per_s(), (sent - on).as_ms());
        rig.collect(Time::from_ms(200));
        assert!(answers(&mut rig), "{bit_rate:?}");
    }
}

#[test]
fn on_a_silent_bus_a_board_listens_until_a_frame_gives_the_rate() {
    let bit_rate = BitRate::Kbit20;
    let mut rig = rig(bit_rate, 0x40);
    let on = switch_on(&mut rig);
    rig.network.run_for(Time::from_s(40));
    assert_silent(&rig, on, Time::MAX);
    assert_eq!(found(&rig, on), None);
    let mut traffic = Traffic::dense(&mut rig, bit_rate);
    traffic.run_for(&mut rig, Time::from_s(3));
    assert_eq!(found(&rig, on).expect("a frame was sent").1, bit_per_s(bit_rate));
}

#[test]
fn a_board_without_a_node_id_detects_the_rate_and_is_found_by_the_master() {
    for bit_rate in BitRate::ALL {
        let mut rig = rig(bit_rate, 0xFF);
        let mut traffic = Traffic::dense(&mut rig, bit_rate);
        traffic.run_for(&mut rig, Time::from_ms(5));
        let on = switch_on(&mut rig);
        traffic.run_for(&mut rig, Time::from_s(1));
        let (time, _) = found(&rig, on).expect("dense traffic");
        assert_silent(&rig, on, time);
        rig.collect(Time::from_ms(50));
        assert_eq!(rig.lss("4C"), ["50"], "{bit_rate:?}");
        assert!(rig.errors().is_empty(), "{bit_rate:?}: {:#?}", rig.errors());
    }
}

#[test]
fn automatic_detection_can_be_configured_stored_and_taken_back() {
    let mut rig = rig_with(settings(0x40, BitRate::Kbit1000));
    rig.collect(Time::from_ms(20));
    assert_eq!(rig.lss("04 01, 13 00 09, 17"), ["13 00", "17 00"]);
    rig.network.power_off(0);
    rig.set_master_bit_rate(BitRate::Kbit250);
    rig.power_on(0);
    assert_eq!(rig.collect(Time::from_s(2)), SILENCE, "the bus is silent");
    let mut traffic = Traffic::dense(&mut rig, BitRate::Kbit250);
    traffic.run_for(&mut rig, Time::from_s(1));
    rig.collect(Time::from_ms(100));
    assert!(answers(&mut rig));
    assert_eq!(rig.lss("13 00 02, 17"), ["13 00", "17 00"]);
    traffic.others.iter().for_each(|&other| rig.network.adapter_mut(other).close());
    rig.set_master_bit_rate(BitRate::Kbit500);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
}
