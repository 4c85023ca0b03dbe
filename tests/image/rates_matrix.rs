//! Switches between all bit rates, with delays, load, slow neighbours and bad crystals: no punctual node is lost.

use canopen_node::bit_rate::BitTiming;
use emulator::{
    can::{BitSegments, Clock},
    network::Network,
};

use crate::{rig::*, switch_delay::assert_switched};

/// The accuracy of the boards' switch delay.
const ACCURACY: Time = Time::from_ms(1);
/// A frame with eight bytes, stuff bits and intermission, in bits.
const LONG_FRAME_BITS: u64 = 122;
/// The clock of the board's CAN controller.
const APB1_HZ: u32 = 40_000_000;
/// The duration of the bus load before and after each switch, in such frames.
const LOAD_FRAMES: u64 = 10;

/// Nodes 1 and 2 in configuration state, and an adapter that loads the bus.
struct Site {
    rig: ImageRig,
    load: AdapterId,
    bit_rate: BitRate,
    is_loaded: bool,
}

impl Site {
    fn new(bit_rate: BitRate, is_loaded: bool) -> Self {
        let boards = [1, 2].map(|number| board_with(number, settings(number, bit_rate)));
        let mut rig = ImageRig::new(bit_rate, boards);
        let load = rig.network.add_adapter(Adapter::new(bit_per_s(bit_rate)));
        rig.lss("04 01");
        Self { rig, load, bit_rate, is_loaded }
    }

    /// Loads the bus to 90 %, and makes the master send a frame in the middle of it.
    fn load_while(&mut self, request: Option<Frame>) {
        let period = self.rig.bit_time() * LONG_FRAME_BITS * 10;
        let period = Time::from_ps(period.as_ps() / 9);
        for count in 0..LOAD_FRAMES {
            if self.is_loaded {
                let data = count.wrapping_mul(0x9E37_79B9_7F4A_7C15).to_le_bytes();
                self.rig.network.send(self.load, Frame::data(Id::Standard(0x181), &data));
            }
            if count == LOAD_FRAMES / 2
                && let Some(request) = request
            {
                self.rig.network.send(self.rig.master, request);
            }
            if self.is_loaded || request.is_some() {
                self.rig.network.run_for(period);
            }
        }
        self.rig.send_all();
    }

    /// Switches all nodes to another rate; the load pauses from the request to the end of the delays.
    fn switch(&mut self, to: BitRate, delay_ms: u16) {
        let configure = frames::request(&format!("13 00 {:02X}", to.index()));
        self.load_while(Some(on_the_wire(&configure)));
        let patience = ACCURACY + self.rig.bit_time() * LONG_FRAME_BITS * 2;
        assert_eq!(self.answers(patience), ["13 00"]);

        let end = self.rig.activate(delay_ms);
        let delay = Time::from_ms(delay_ms.into());
        self.rig.network.run_until(end + delay);
        self.rig.set_master_bit_rate(to);
        self.rig.network.adapter_mut(self.load).set_bit_rate(bit_per_s(to));
        self.bit_rate = to;
        self.rig.network.run_until(end + delay * 2 + ACCURACY);
        // Without a delay the boards switch in the last bit of the request.
        if delay_ms > 0 {
            assert_switched(&self.rig, end, delay, to);
        }

        self.load_while(None);
        self.answers(patience);
    }

    /// The frames that the nodes have sent, without the load.
    fn answers(&mut self, span: Time) -> frames::Frames {
        let mut frames = self.rig.collect(span + self.rig.bit_time() * LONG_FRAME_BITS);
        frames.0.retain(|frame| frame.cob_id() != 0x181);
        frames
    }

    /// Each node answers the master.
    fn assert_all_reached(&mut self, what: &str) {
        for (id, address) in [(1, 0x581), (2, 0x582)] {
            self.rig.transmit(on_the_wire(&sdo::request(id, "40 00 10 00")));
            let answers = self.answers(ACCURACY);
            let is_there = answers.0.iter().any(|frame| frame.cob_id() == address);
            assert!(is_there, "node {id} is lost, {what}");
        }
    }
}

/// A closed walk through all ordered pairs of rates.
fn walk() -> Vec<BitRate> {
    let mut walk = vec![BitRate::ALL[0]];
    for (index, &from) in BitRate::ALL.iter().enumerate() {
        walk.extend((index > 0).then_some(from));
        walk.extend(BitRate::ALL[index + 1..].iter().flat_map(|&to| [to, from]));
    }
    walk
}

#[test]
fn the_walk_goes_through_all_56_pairs() {
    let mut pairs: Vec<_> = walk().windows(2).map(|pair| (pair[0], pair[1])).collect();
    pairs.sort();
    pairs.dedup();
    assert_eq!(pairs.iter().filter(|(from, to)| from != to).count(), 56);
}

#[test]
fn all_pairs_with_short_and_long_delays_on_an_idle_bus_and_under_load() {
    let walk = walk();
    for (delay_ms, is_loaded) in
        [0, 1, 50, 1000].into_iter().flat_map(|ms| [(ms, false), (ms, true)])
    {
        let mut site = Site::new(walk[0], is_loaded);
        for pair in walk.windows(2) {
            let what = format!("{pair:?} after {delay_ms} ms, under load: {is_loaded}");
            site.switch(pair[1], delay_ms);
            site.assert_all_reached(&what);
            assert!(site.rig.errors().is_empty(), "{what}: {:#?}", site.rig.errors());
        }
    }
}

#[test]
fn a_delay_of_50_ms_does_not_disturb_a_neighbour_that_needs_40_ms() {
    for (from, to) in [
        (BitRate::Kbit125, BitRate::Kbit1000),
        (BitRate::Kbit1000, BitRate::Kbit125),
        (BitRate::Kbit500, BitRate::Kbit50),
    ] {
        let (processing, delay) = (Time::from_ms(40), Time::from_ms(50));
        let boards =
            [1, 2].map(|number| board_with(number, settings(number, from).with_heartbeat_ms(5)));
        let mut rig = ImageRig::new(from, boards);
        let slow = rig.network.add_adapter(Adapter::new(bit_per_s(from)));
        rig.lss(&format!("04 01, 13 00 {:02X}", to.index()));
        let frame = Frame::data(Id::Standard(0x183), &[0x5A; 8]);
        let end = rig.activate(50);
        // It continues as before until it has processed the request, and counts both delays from then on.
        while rig.network.now() + Time::from_ms(3) < end + processing {
            rig.network.send(slow, frame);
            rig.network.run_for(Time::from_ms(3));
            assert_eq!(rig.network.adapter_mut(slow).unsent(), 0, "it is acknowledged");
        }
        rig.network.run_until(end + delay);
        rig.set_master_bit_rate(to);
        rig.network.run_until(end + processing + delay);
        rig.network.adapter_mut(slow).set_bit_rate(bit_per_s(to));
        rig.network.run_until(end + processing + delay * 2);
        for _ in 0..10 {
            rig.network.send(slow, frame);
            rig.network.run_for(Time::from_ms(3));
        }
        rig.network.run_for(Time::from_ms(20));
        assert_eq!(rig.network.adapter_mut(slow).unsent(), 0, "it is acknowledged");
        assert!(rig.errors().is_empty(), "{:#?}", rig.errors());
        rig.collect(Time::ZERO);
        let heartbeats = rig.collect(Time::from_ms(12));
        for cob_id in [0x701, 0x702] {
            assert!(heartbeats.0.iter().any(|frame| frame.cob_id() == cob_id), "{cob_id:03X}");
        }
    }
}

/// The bit timing of the firmware.
fn bit_timing(bit_rate: BitRate) -> BitTiming {
    BitTiming::solve(bit_rate, APB1_HZ).expect("every rate is possible")
}

#[test]
fn each_bit_rate_has_its_value_in_can_btr() {
    for (bit_rate, btr) in [
        (BitRate::Kbit1000, 0x022F_0001),
        (BitRate::Kbit800, 0x0116_0004),
        (BitRate::Kbit500, 0x022F_0003),
        (BitRate::Kbit250, 0x022F_0007),
        (BitRate::Kbit125, 0x022F_000F),
        (BitRate::Kbit50, 0x022F_0027),
        (BitRate::Kbit20, 0x022F_0063),
        (BitRate::Kbit10, 0x022F_00C7),
    ] {
        let rig = rig_with(settings(0x40, bit_rate));
        let written = rig.did(0, Time::ZERO).filter_map(|event| match event.what {
            What::BitTiming { btr, .. } => Some(btr),
            _ => None,
        });
        assert_eq!(written.last(), Some(btr), "{bit_rate:?}");
    }
}

/// Whether a board and a master with the same bit timing and these crystal deviations communicate without an error
/// frame.
fn understand_each_other(bit_rate: BitRate, board_ppm: i32, master_ppm: i32) -> bool {
    let crystal = Clock { hz: 8_000_000, ppm: board_ppm };
    let variant = board::Settings { crystal, unique_id: [1; 12], ..Default::default() };
    let mut network = Network::new();
    network.add_board(board_of(variant, settings(1, bit_rate)));
    let timing = bit_timing(bit_rate);
    let master = network.add_adapter(Adapter::with_timing(
        Clock { hz: APB1_HZ, ppm: master_ppm },
        BitSegments {
            prescaler: timing.prescaler,
            segment_1: timing.segment1.into(),
            segment_2: timing.segment2,
            jump_width: timing.sync_jump_width,
        },
    ));
    let frame_time = Time::from_ps(1_000_000_000_000 / u64::from(bit_per_s(bit_rate))) * 160;
    network.run_for(Time::from_ms(20) + frame_time);
    // The longest runs of equal bits, and stuff bits everywhere.
    for data in [[0x00; 8], [0xFF; 8], [0x0F; 8], [0x5A; 8]] {
        network.send(master, Frame::data(Id::Standard(0x400), &data));
        for request in
            [sdo::request(1, "40 00 10 00"), frames::request("04 01"), frames::request("5A")]
        {
            network.send(master, on_the_wire(&request));
        }
        network.run_for(Time::from_ms(2) + frame_time * 7);
    }
    let received = core::iter::from_fn(|| network.receive(master)).count();
    let is_undisturbed =
        network.trace().iter().all(|event| !matches!(event.what, What::Error { .. }));
    is_undisturbed && received == 9
}

#[test]
fn crystals_that_are_half_a_per_cent_off_on_both_ends_work_at_every_rate() {
    for bit_rate in BitRate::ALL {
        for board in [-5_000, 0, 5_000] {
            for master in [-5_000, 0, 5_000] {
                let is_understood = understand_each_other(bit_rate, board, master);
                assert!(is_understood, "{bit_rate:?}: board {board} ppm, master {master} ppm");
            }
        }
    }
}

/// HSI is 1 % off at 25 degrees, up to 4 % between -10 and 85 degrees and up to 8 % between -40 and 105 (data sheets,
/// ACC_HSI).
#[test]
fn a_clock_as_inaccurate_as_hsi_works_at_25_degrees_with_an_exact_master() {
    for bit_rate in BitRate::ALL {
        for (ppm, works) in [
            (10_000, true),
            (-10_000, true),
            (40_000, false),
            (-40_000, false),
            (45_000, false),
            (-80_000, false),
        ] {
            assert_eq!(understand_each_other(bit_rate, ppm, 0), works, "{bit_rate:?}, {ppm} ppm");
        }
    }
}

#[test]
fn the_limit_of_each_rate_follows_from_its_bit_timing() {
    println!("tolerance of both crystals in opposite directions, in ppm");
    for bit_rate in BitRate::ALL {
        let theory = bit_timing(bit_rate).crystal_tolerance_ppm() as i32;
        let limit = [-1, 1].map(|sign| {
            let (mut good, mut bad) = (0, 20_000);
            while bad - good > 250 {
                let middle = (good + bad) / 2;
                if understand_each_other(bit_rate, sign * middle, -sign * middle) {
                    good = middle;
                } else {
                    bad = middle;
                }
            }
            good
        });
        // The theory ignores that an edge is seen with the resolution of a quantum.
        assert!((5_000..=theory * 12 / 10).contains(&limit[0]), "{limit:?}");
        assert!(limit[1] >= theory, "{limit:?}");
        println!(
            "{:>7} kbit/s  theory {theory}  slow board {}, fast board {}",
            bit_rate.kbit_per_s(),
            limit[0],
            limit[1]
        );
    }
}
