//! Stations on a wire: frames, arbitration, errors, bit rates and crystals.

use emulator::{
    Time,
    can::{
        Adapter, BitSegments, Bus, Clock, ErrorKind, Event, Frame, Id, Station,
        fault::ErrorCounters,
    },
};

/// 1 Mbit/s at 32 MHz with the sample point at 87.5 %; other rates by prescaler.
const MEGABIT: BitSegments =
    BitSegments { prescaler: 2, segment_1: 13, segment_2: 2, jump_width: 1 };

/// The bit timing for 1 Mbit/s or less.
fn at(kilobits: u16) -> BitSegments {
    BitSegments { prescaler: 2 * (1000 / kilobits), ..MEGABIT }
}

fn standard(id: u16, payload: &[u8]) -> Frame {
    Frame::data(Id::Standard(id), payload)
}

/// Adapters on a bus, and all that their controllers report.
struct Wire {
    bus: Bus,
    adapters: Vec<Adapter>,
    log: Vec<(usize, Time, Event)>,
}

impl Wire {
    /// Adapters with these bit timings, with exact crystals.
    fn new<const N: usize>(bit_timings: [BitSegments; N]) -> Self {
        Self::with_crystals(bit_timings.map(|bit_timing| (0, bit_timing)))
    }

    /// Adapters with these errors of their crystals, in ppm, and bit timings.
    fn with_crystals<const N: usize>(stations: [(i32, BitSegments); N]) -> Self {
        let adapter =
            |(ppm, bit_timing)| Adapter::with_timing(Clock { hz: 32_000_000, ppm }, bit_timing);
        Self { bus: Bus::new(), adapters: stations.map(adapter).into(), log: Vec::new() }
    }

    fn run(&mut self, span: Time) {
        let until = self.bus.now() + span;
        let mut stations: Vec<&mut dyn Station> =
            self.adapters.iter_mut().map(|adapter| adapter as &mut dyn Station).collect();
        let log = &mut self.log;
        while self.bus.advance(until, &mut stations, &mut |station, controller, event| {
            log.push((station, controller.now(), *event));
        }) < until
        {}
    }

    fn send(&mut self, station: usize, frame: Frame) {
        self.adapters[station].send(frame);
    }

    /// What `choose` takes of the events of a station and their times.
    fn events<T>(&self, station: usize, choose: impl Fn(Time, Event) -> Option<T>) -> Vec<T> {
        let of_station = self.log.iter().filter(|(of, ..)| *of == station);
        of_station.filter_map(|(_, time, event)| choose(*time, *event)).collect()
    }

    fn received(&self, station: usize) -> Vec<Frame> {
        self.events(station, |_, event| match event {
            Event::Received(frame) => Some(frame),
            _ => None,
        })
    }

    /// The kinds of the errors, and whether the station was the transmitter.
    fn errors(&self, station: usize) -> Vec<(ErrorKind, bool)> {
        self.events(station, |_, event| match event {
            Event::Error { kind, transmitting } => Some((kind, transmitting)),
            _ => None,
        })
    }

    /// The start and the end of each transmission.
    fn transmitted(&self, station: usize) -> Vec<(Time, Time)> {
        self.events(station, |_, event| match event {
            Event::Transmitted { start, end, .. } => Some((start, end)),
            _ => None,
        })
    }

    fn times_of(&self, station: usize, wanted: Event) -> Vec<Time> {
        self.events(station, |time, event| (event == wanted).then_some(time))
    }

    fn counters(&mut self, station: usize) -> ErrorCounters {
        self.adapters[station].controller().counters()
    }
}

#[test]
fn a_frame_takes_exactly_its_bits_and_arrives_before_its_last_bit() {
    let mut wire = Wire::new([MEGABIT; 2]);
    for frame in [
        standard(0, &[]),
        standard(0x7E5, &[4, 1, 0, 0, 0, 0, 0, 0]),
        Frame::data(Id::Extended(0x1234_5678), &[0xFF; 8]),
        Frame::remote(Id::Standard(0x555), 4),
    ] {
        wire.send(0, frame);
        wire.run(Time::from_us(200));
        let (start, end) = wire.transmitted(0).pop().unwrap();
        assert_eq!(end - start, Time::from_us(u64::from(frame.wire_bits())), "{frame}");
        // The sample point of the last but one bit: 1.125 bits before the end.
        assert_eq!(wire.times_of(1, Event::Received(frame)), [end - Time::from_ns(1_125)]);
    }
    assert_eq!((wire.errors(0), wire.errors(1)), (vec![], vec![]));
}

#[test]
fn frames_follow_each_other_after_three_bits_of_intermission() {
    let mut wire = Wire::new([MEGABIT; 2]);
    (0..5).for_each(|n| wire.send(0, standard(0x100 + n, &[])));
    wire.run(Time::from_ms(1));
    let spans = wire.transmitted(0);
    assert_eq!(spans.len(), 5);
    assert!(spans.windows(2).all(|pair| pair[1].0 - pair[0].1 == Time::from_us(3)), "{spans:?}");
}

#[test]
fn of_simultaneous_frames_the_one_of_highest_priority_wins_and_none_is_lost() {
    let by_priority = [
        standard(0x000, &[1; 3]),
        standard(0x0FF, &[2; 3]),
        standard(0x100, &[3; 3]),
        Frame::remote(Id::Standard(0x100), 0),
        Frame::data(Id::Extended(0x100 << 18), &[]),
        Frame::remote(Id::Extended(0x100 << 18), 0),
        standard(0x7FF, &[4; 3]),
    ];
    let mut wire = Wire::new([MEGABIT; 8]);
    let stations = [3, 4, 2, 5, 1, 6, 0];
    for (station, frame) in stations.into_iter().zip(by_priority) {
        wire.send(station, frame);
    }
    wire.run(Time::from_ms(1));
    assert_eq!(wire.received(7), by_priority);
    for (place, station) in stations.into_iter().enumerate() {
        assert_eq!(wire.times_of(station, Event::ArbitrationLost).len(), place);
        assert_eq!(wire.errors(station), []);
        assert_eq!(wire.counters(station), ErrorCounters::default());
    }
}

#[test]
fn alone_the_transmit_error_counter_stops_at_128_and_the_frame_repeats() {
    let mut wire = Wire::new([MEGABIT; 2]);
    wire.adapters[1].close();
    let frame = standard(0x700, &[0]);
    wire.send(0, frame);
    wire.run(Time::from_ms(20));
    assert_eq!(wire.counters(0).transmit, 128);
    assert!(wire.errors(0).len() > 150);
    assert!(wire.errors(0).iter().all(|error| *error == (ErrorKind::Acknowledgement, true)));
    // Error passive: frame up to the ACK slot, six bits of flag, eight of delimiter, three and eight until the next
    // frame.
    let starts = wire.times_of(0, Event::Started);
    let last = starts[starts.len() - 1] - starts[starts.len() - 2];
    assert_eq!(last, Time::from_us(u64::from(frame.wire_bits()) - 8 + 6 + 8 + 3 + 8));

    wire.adapters[1].open();
    wire.run(Time::from_ms(2));
    assert_eq!(wire.received(1), [frame], "an acknowledgement ends the repetition");
    assert_eq!(wire.counters(0).transmit, 127);
}

#[test]
fn a_collision_ends_when_the_recessive_starter_is_error_passive() {
    let mut wire = Wire::new([MEGABIT; 2]);
    wire.send(0, standard(0x100, &[0x00, 0x80]));
    wire.send(1, standard(0x100, &[0x80, 0x00]));
    wire.run(Time::from_ms(10));
    assert_eq!((wire.transmitted(0).len(), wire.transmitted(1).len()), (1, 1));
    assert!(wire.errors(1).len() > 15);
    assert_eq!(wire.errors(1)[0], (ErrorKind::BitRecessive, true));
}

#[test]
fn two_bit_rates_on_one_bus_raise_errors_and_pass_no_frame() {
    for (fast, slow) in [(1000, 500), (1000, 250), (500, 125), (250, 125), (1000, 10)] {
        let mut wire = Wire::new([at(fast), at(slow)]);
        wire.run(Time::from_ms(2));
        for n in 0..20 {
            wire.send(0, standard(0x7E5, &[0x04, n, 0, 0, 0, 0, 0, 0]));
            wire.send(1, standard(0x7E4, &[0x44, n, 0, 0, 0, 0, 0, 0]));
        }
        wire.run(Time::from_ms(500));
        for station in 0..2 {
            assert_eq!(wire.received(station), [], "{fast} and {slow}");
            assert!(!wire.errors(station).is_empty(), "{fast} and {slow}");
        }
        let is_passive = wire.counters(0).passive() || wire.counters(1).passive();
        assert!(is_passive, "{fast} and {slow}");
    }
}

#[test]
fn a_silent_node_at_another_rate_disturbs_no_node() {
    let mut wire = Wire::new([MEGABIT, MEGABIT, at(500)]);
    wire.adapters[2].listen_only();
    (0..20).for_each(|n| wire.send(0, standard(n, &[0; 8])));
    wire.run(Time::from_ms(5));
    assert_eq!(wire.received(1).len(), 20);
    assert!(!wire.errors(2).is_empty());
    assert_eq!((wire.counters(0).transmit, wire.counters(1).receive), (0, 0));
}

#[test]
fn a_silent_node_hears_all_and_never_drives_the_wire() {
    let mut wire = Wire::new([MEGABIT; 3]);
    wire.adapters[1].listen_only();
    wire.adapters[2].close();
    wire.send(1, standard(1, &[]));
    wire.send(0, standard(0x123, &[1]));
    wire.run(Time::from_ms(5));
    assert_eq!(wire.counters(0).transmit, 128, "nobody acknowledges");
    assert_eq!((wire.transmitted(1), wire.times_of(1, Event::Started)), (vec![], vec![]));

    wire.adapters[2].open();
    wire.run(Time::from_ms(1));
    assert_eq!((wire.received(2).len(), wire.transmitted(0).len()), (1, 1));
    assert_eq!(wire.received(1).last(), Some(&standard(0x123, &[1])));
    assert_eq!(wire.counters(1).transmit, 0);
}

#[test]
fn crystals_that_are_three_percent_apart_do_not() {
    let mut wire = Wire::with_crystals([(15_000, MEGABIT), (-15_000, MEGABIT)]);
    wire.run(Time::from_us(50));
    wire.send(0, standard(0, &[0; 8]));
    wire.run(Time::from_us(150));
    assert!(!wire.errors(1).is_empty());
}

/// The longest dominant level of a frame without errors has five bits.
#[test]
fn a_dominant_time_out_lets_only_bits_pass_that_are_short_enough() {
    for (us, kilobits, passes) in
        [(450, 10, false), (1_200, 10, true), (240, 20, false), (300, 20, true), (300, 50, true)]
    {
        let mut wire = Wire::new([at(kilobits); 2]);
        wire.adapters[0].controller().set_dominant_time_out(Some(Time::from_us(us)));
        wire.run(Time::from_ms(2));
        wire.send(0, standard(0, &[]));
        wire.run(Time::from_ms(12));
        assert_eq!(!wire.received(1).is_empty(), passes, "{us} us, {kilobits} kbit/s");
        assert_eq!(wire.errors(0).is_empty(), passes, "{us} us, {kilobits} kbit/s");
    }
}
