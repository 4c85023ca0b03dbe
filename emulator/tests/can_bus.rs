//! Controllers on a wire: frames, arbitration, acknowledgement, errors, bus-off, bit rates and crystals.

use std::collections::VecDeque;

use emulator::{
    Time,
    can::{BitTiming, Bus, Clock, Controller, ErrorKind, Event, Frame, Id, Level, Mode, Station},
};

/// 1 Mbit/s at 32 MHz with the sample point at 87.5 %; other rates by prescaler.
const MEGABIT: BitTiming = BitTiming { prescaler: 2, segment_1: 13, segment_2: 2, jump_width: 1 };

/// A controller that sends what is queued and writes down what happens.
struct Node {
    controller: Controller,
    queue: VecDeque<Frame>,
    log: Vec<(Time, Event)>,
}

impl Node {
    fn new(ppm: i32, bit_timing: BitTiming) -> Self {
        let mut node = Self::stopped(ppm, bit_timing);
        node.controller.start(Time::ZERO);
        node
    }

    fn stopped(ppm: i32, bit_timing: BitTiming) -> Self {
        let controller = Controller::new(Clock { hz: 32_000_000, ppm }, bit_timing);
        Self { controller, queue: VecDeque::new(), log: Vec::new() }
    }

    fn with_mode(mode: Mode) -> Self {
        let mut node = Self::stopped(0, MEGABIT);
        node.controller.configure(MEGABIT, mode);
        node.controller.start(Time::ZERO);
        node
    }

    fn send(&mut self, frame: Frame) {
        self.queue.push_back(frame);
        self.controller.offer(self.queue.front().copied(), self.controller.now());
    }

    fn withdraw(&mut self) {
        self.queue.clear();
        self.controller.offer(None, self.controller.now());
    }

    fn received(&self) -> Vec<Frame> {
        self.log
            .iter()
            .filter_map(
                |(_, event)| if let Event::Received(frame) = event { Some(*frame) } else { None },
            )
            .collect()
    }

    fn errors(&self) -> Vec<(ErrorKind, bool)> {
        let error = |event: &Event| match *event {
            Event::Error { kind, transmitting } => Some((kind, transmitting)),
            _ => None,
        };
        self.log.iter().filter_map(|(_, event)| error(event)).collect()
    }

    fn transmitted(&self) -> Vec<(Time, Time)> {
        let span = |event: &Event| match *event {
            Event::Transmitted { start, end, .. } => Some((start, end)),
            _ => None,
        };
        self.log.iter().filter_map(|(_, event)| span(event)).collect()
    }

    fn time_of(&self, wanted: Event) -> Time {
        self.log.iter().find(|(_, event)| *event == wanted).expect("no such event").0
    }

    fn tec(&self) -> u16 {
        self.controller.counters().transmit
    }

    fn rec(&self) -> u16 {
        self.controller.counters().receive
    }
}

impl Station for Node {
    fn controller(&mut self) -> &mut Controller {
        &mut self.controller
    }

    fn handle(&mut self, event: &Event, now: Time) -> bool {
        self.log.push((now, *event));
        if matches!(event, Event::Transmitted { .. }) {
            self.queue.pop_front();
            self.controller.offer(self.queue.front().copied(), now);
        }
        false
    }
}

fn run<const N: usize>(bus: &mut Bus, nodes: [&mut Node; N], span: Time) {
    let until = bus.now() + span;
    bus.advance(until, &mut nodes.map(|node| node as &mut dyn Station), |_, _, _| {});
}

fn standard(id: u16, payload: &[u8]) -> Frame {
    Frame::data(Id::Standard(id), payload)
}

fn at(kilobits: u16) -> BitTiming {
    BitTiming { prescaler: 2 * (1000 / kilobits), ..MEGABIT }
}

#[test]
fn a_frame_takes_exactly_its_bits_and_arrives_before_its_last_bit() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    for frame in [
        standard(0, &[]),
        standard(0x7E5, &[4, 1, 0, 0, 0, 0, 0, 0]),
        Frame::data(Id::Extended(0x1234_5678), &[0xFF; 8]),
        Frame::remote(Id::Standard(0x555), 4),
    ] {
        a.send(frame);
        run(&mut bus, [&mut a, &mut b], Time::from_us(200));
        let (start, end) = a.transmitted().pop().unwrap();
        assert_eq!(end - start, Time::from_us(u64::from(frame.wire_bits())), "{frame}");
        assert_eq!(b.received().pop(), Some(frame));
        // The sample point of the last but one bit: 1.125 bits before the end.
        assert_eq!(end - b.time_of(Event::Received(frame)), Time::from_ns(1_125));
    }
    assert_eq!(a.errors(), []);
    assert_eq!(b.errors(), []);
}

#[test]
fn frames_follow_each_other_after_three_bits_of_intermission() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    (0..5).for_each(|n| a.send(standard(0x100 + n, &[])));
    run(&mut bus, [&mut a, &mut b], Time::from_ms(1));
    let spans = a.transmitted();
    assert_eq!(spans.len(), 5);
    for pair in spans.windows(2) {
        assert_eq!(pair[1].0 - pair[0].1, Time::from_us(3));
    }
}

#[test]
fn of_frames_that_start_together_the_lowest_identifier_goes_first_and_none_is_lost() {
    let mut nodes = [0x123, 0x122, 0x7FF, 0x000, 0x555].map(|id| {
        let mut node = Node::new(0, MEGABIT);
        node.send(standard(id, &[id as u8; 3]));
        node
    });
    let [a, b, c, d, e] = &mut nodes;
    let mut listener = Node::new(0, MEGABIT);
    run(&mut Bus::new(), [a, b, c, d, e, &mut listener], Time::from_ms(1));
    let order: Vec<Id> = listener.received().iter().map(|frame| frame.id).collect();
    assert_eq!(order, [0, 0x122, 0x123, 0x555, 0x7FF].map(Id::Standard));
    assert!(
        nodes.iter().all(|node| node.errors().is_empty() && node.tec() == 0 && node.rec() == 0)
    );
    assert!(nodes[2].log.iter().filter(|(_, event)| *event == Event::ArbitrationLost).count() == 4);
}

#[test]
fn data_beats_remote_and_base_beats_extended_of_the_same_identifier() {
    let frames = [
        Frame::remote(Id::Extended(0x100 << 18), 0),
        Frame::data(Id::Extended(0x100 << 18), &[]),
        Frame::remote(Id::Standard(0x100), 0),
        Frame::data(Id::Standard(0x100), &[]),
    ];
    let mut nodes = frames.map(|frame| {
        let mut node = Node::new(0, MEGABIT);
        node.send(frame);
        node
    });
    let mut listener = Node::new(0, MEGABIT);
    let [a, b, c, d] = &mut nodes;
    run(&mut Bus::new(), [a, b, c, d, &mut listener], Time::from_ms(1));
    let mut expected = frames;
    expected.reverse();
    assert_eq!(listener.received(), expected);
    assert_eq!(listener.errors(), []);
}

#[test]
fn equal_frames_of_two_senders_merge_into_one() {
    let (mut bus, mut a, mut b, mut c) =
        (Bus::new(), Node::new(20, MEGABIT), Node::new(-30, MEGABIT), Node::new(0, MEGABIT));
    run(&mut bus, [&mut a, &mut b, &mut c], Time::from_us(100));
    a.send(standard(0x7E4, &[0x4F, 0, 0, 0, 0, 0, 0, 0]));
    b.send(standard(0x7E4, &[0x4F, 0, 0, 0, 0, 0, 0, 0]));
    run(&mut bus, [&mut a, &mut b, &mut c], Time::from_ms(1));
    assert_eq!(c.received().len(), 1);
    assert_eq!((a.transmitted().len(), b.transmitted().len()), (1, 1));
    assert_eq!((a.errors().len(), b.errors().len(), c.errors().len()), (0, 0, 0));
}

#[test]
fn senders_of_one_identifier_and_different_data_collide() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    a.send(standard(0x100, &[0x00]));
    b.send(standard(0x100, &[0x80]));
    run(&mut bus, [&mut a, &mut b], Time::from_us(60));
    assert_eq!(b.errors(), [(ErrorKind::BitRecessive, true)]);
    assert_eq!(b.tec(), 8);
    assert_eq!(a.errors().len(), 1, "the error flag of b destroys the frame of a");
}

#[test]
fn alone_on_the_bus_the_transmit_error_counter_stops_at_128_and_the_frame_is_repeated() {
    let (mut bus, mut a) = (Bus::new(), Node::new(0, MEGABIT));
    let frame = standard(0x700, &[0]);
    a.send(frame);
    run(&mut bus, [&mut a], Time::from_ms(20));
    assert_eq!(a.tec(), 128);
    assert!(a.errors().len() > 150);
    assert!(a.errors().iter().all(|error| *error == (ErrorKind::Acknowledgement, true)));
    // Error passive: frame up to the ACK slot, six bits of flag, eight of delimiter, three and eight until the next.
    let starts: Vec<Time> =
        a.log.iter().filter(|(_, event)| *event == Event::Started).map(|(time, _)| *time).collect();
    let last = starts[starts.len() - 1] - starts[starts.len() - 2];
    assert_eq!(last, Time::from_us(u64::from(frame.wire_bits()) - 8 + 6 + 8 + 3 + 8));

    let mut b = Node::stopped(0, MEGABIT);
    b.controller.start(bus.now());
    run(&mut bus, [&mut a, &mut b], Time::from_ms(2));
    assert_eq!(b.received(), [frame], "an acknowledgement ends the repetition");
    assert_eq!(a.tec(), 127);
}

#[test]
fn a_frame_is_repeated_only_while_it_is_offered() {
    let (mut bus, mut a) = (Bus::new(), Node::new(0, MEGABIT));
    a.send(standard(0x700, &[0]));
    run(&mut bus, [&mut a], Time::from_us(50));
    a.withdraw();
    run(&mut bus, [&mut a], Time::from_ms(5));
    assert_eq!(a.errors().len(), 1);
    assert_eq!(bus.next_action(), Time::MAX, "an idle bus costs nothing");
}

#[test]
fn colliding_transmitters_go_bus_off_and_recover_after_128_times_11_recessive_bits() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    a.send(standard(0x100, &[0x00, 0x80]));
    b.send(standard(0x100, &[0x80, 0x00]));
    // Error passive, b's flag no longer destroys the frame of a: only b, which starts with the recessive bit, falls.
    run(&mut bus, [&mut a, &mut b], Time::from_ms(10));
    assert_eq!(a.transmitted().len(), 1);
    assert_eq!(b.transmitted().len(), 1);

    // Alone but for a wire that a third party disturbs: bit errors in the data field, 8 a time, 32 times.
    let (mut bus, mut a) = (Bus::new(), Node::new(0, MEGABIT));
    let mut noise = Node::new(0, at(500));
    a.send(standard(0x7FF, &[0xFF; 8]));
    while !a.controller.counters().bus_off() {
        noise.send(standard(0, &[0; 8]));
        run(&mut bus, [&mut a, &mut noise], Time::from_us(100));
        assert!(bus.now() < Time::from_ms(500), "TEC {}", a.tec());
    }
    let off = a.time_of(Event::BusOff);
    noise.controller.reset();
    let started = a.log.iter().filter(|(_, event)| *event == Event::Started).count();
    run(&mut bus, [&mut a, &mut noise], Time::from_ms(10));
    assert_eq!(
        a.log.iter().filter(|(_, event)| *event == Event::Started).count(),
        started,
        "bus-off is silent"
    );
    assert!(bus.now() > off);

    a.withdraw();
    a.controller.recover();
    let began = bus.now();
    run(&mut bus, [&mut a, &mut noise], Time::from_ms(2));
    let took = a.time_of(Event::Recovered) - began;
    assert!((Time::from_us(1407)..=Time::from_us(1409)).contains(&took), "{took}");
    assert_eq!((a.tec(), a.rec()), (0, 0));
}

#[test]
fn a_node_is_error_passive_above_127_and_then_its_flags_are_recessive() {
    let (mut bus, mut a) = (Bus::new(), Node::new(0, MEGABIT));
    a.send(standard(0x700, &[]));
    while a.tec() < 128 {
        assert!(!a.controller.counters().passive());
        run(&mut bus, [&mut a], Time::from_us(1));
    }
    assert!(a.controller.counters().warning() && a.controller.counters().passive());
    // Join late enough to miss SOF, early enough to see the ACK slot without an error flag after it.
    let errors = a.errors().len();
    while a.errors().len() == errors {
        run(&mut bus, [&mut a], Time::from_us(1));
    }
    let mut dominant = 0;
    for _ in 0..6 {
        run(&mut bus, [&mut a], Time::from_us(1));
        dominant += u32::from(bus.level() == Level::Dominant);
    }
    assert_eq!(dominant, 1 - 1);
}

#[test]
fn two_bit_rates_on_one_bus_raise_errors_and_pass_no_frame() {
    for (fast, slow) in [(1000, 500), (1000, 250), (500, 125), (250, 125), (1000, 10)] {
        let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, at(fast)), Node::new(0, at(slow)));
        run(&mut bus, [&mut a, &mut b], Time::from_ms(2));
        for n in 0..20 {
            a.send(standard(0x7E5, &[0x04, n, 0, 0, 0, 0, 0, 0]));
            b.send(standard(0x7E4, &[0x44, n, 0, 0, 0, 0, 0, 0]));
        }
        run(&mut bus, [&mut a, &mut b], Time::from_ms(500));
        assert_eq!((a.received(), b.received()), (vec![], vec![]), "{fast} and {slow}");
        assert!(!a.errors().is_empty() && !b.errors().is_empty(), "{fast} and {slow}");
        assert!(
            a.controller.counters().passive() || b.controller.counters().passive(),
            "{fast} and {slow}"
        );
    }
}

#[test]
fn a_quiet_node_at_another_rate_destroys_the_frames_of_others() {
    let (mut bus, mut a, mut b, mut odd) =
        (Bus::new(), Node::new(0, at(250)), Node::new(0, at(250)), Node::new(0, at(125)));
    run(&mut bus, [&mut a, &mut b, &mut odd], Time::from_ms(1));
    a.send(standard(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]));
    run(&mut bus, [&mut a, &mut b, &mut odd], Time::from_us(400));
    assert!(!odd.errors().is_empty() && !a.errors().is_empty());
    assert_eq!(b.received(), []);
}

#[test]
fn crystals_that_are_half_a_percent_off_understand_each_other() {
    let wide = BitTiming { jump_width: 2, ..MEGABIT };
    for (sender, receiver) in
        [(5_000, 0), (-5_000, 0), (2_500, -2_500), (-2_500, 2_500), (0, 5_000), (0, -5_000)]
    {
        let (mut bus, mut a, mut b) =
            (Bus::new(), Node::new(sender, wide), Node::new(receiver, wide));
        let mut sent = Vec::new();
        for n in 0..50u8 {
            // The longest runs without an edge to synchronise on: five dominant, five recessive bits.
            for frame in [
                standard(0x7E0 | u16::from(n & 15), &[n, 0xF8, 0x3E, 0, 0xFF, 0x0F, 0x83]),
                standard(0, &[0; 8]),
            ] {
                a.send(frame);
                sent.push(frame);
            }
        }
        run(&mut bus, [&mut a, &mut b], Time::from_ms(20));
        assert_eq!(b.received(), sent, "{sender} and {receiver} ppm");
        assert_eq!((a.errors(), b.errors()), (vec![], vec![]), "{sender} and {receiver} ppm");
    }
}

#[test]
fn crystals_that_are_three_percent_apart_do_not() {
    let (mut bus, mut a, mut b) =
        (Bus::new(), Node::new(15_000, MEGABIT), Node::new(-15_000, MEGABIT));
    run(&mut bus, [&mut a, &mut b], Time::from_us(50));
    a.send(standard(0, &[0; 8]));
    run(&mut bus, [&mut a, &mut b], Time::from_us(150));
    assert!(!b.errors().is_empty());
}

#[test]
fn a_silent_node_hears_all_and_never_drives_the_wire() {
    let silent = Mode { silent: true, loopback: false };
    let (mut bus, mut a, mut listener) =
        (Bus::new(), Node::new(0, MEGABIT), Node::with_mode(silent));
    listener.send(standard(1, &[]));
    a.send(standard(0x123, &[1]));
    run(&mut bus, [&mut a, &mut listener], Time::from_ms(5));
    assert_eq!(a.tec(), 128, "nobody acknowledges");
    assert!(
        listener.transmitted().is_empty()
            && !listener.log.iter().any(|(_, event)| *event == Event::Started)
    );

    let mut b = Node::stopped(0, MEGABIT);
    b.controller.start(bus.now());
    run(&mut bus, [&mut a, &mut listener, &mut b], Time::from_ms(1));
    assert_eq!((b.received().len(), a.transmitted().len()), (1, 1));
    assert_eq!(listener.received().last(), Some(&standard(0x123, &[1])));
    assert_eq!(listener.controller.counters().transmit, 0);
}

#[test]
fn a_silent_node_at_another_rate_disturbs_nobody() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    let mut odd = Node::stopped(0, at(500));
    odd.controller.configure(at(500), Mode { silent: true, loopback: false });
    odd.controller.start(Time::ZERO);
    (0..20).for_each(|n| a.send(standard(n, &[0; 8])));
    run(&mut bus, [&mut a, &mut b, &mut odd], Time::from_ms(5));
    assert_eq!(b.received().len(), 20);
    assert!(!odd.errors().is_empty());
    assert_eq!((a.tec(), b.rec()), (0, 0));
}

#[test]
fn loopback_receives_its_own_frame_without_an_acknowledgement() {
    let (mut bus, mut a) = (Bus::new(), Node::with_mode(Mode { silent: false, loopback: true }));
    a.send(standard(0x123, &[1, 2, 3]));
    run(&mut bus, [&mut a], Time::from_us(200));
    assert_eq!(a.received(), [standard(0x123, &[1, 2, 3])]);
    assert_eq!((a.transmitted().len(), a.errors().len()), (1, 0));
}

#[test]
fn silent_loopback_leaves_the_wire_alone() {
    let (mut bus, mut a) = (Bus::new(), Node::with_mode(Mode { silent: true, loopback: true }));
    let mut witness = Node::new(0, MEGABIT);
    a.send(standard(0x123, &[1, 2, 3]));
    run(&mut bus, [&mut a, &mut witness], Time::from_us(200));
    assert_eq!(a.received().len(), 1);
    assert_eq!((witness.received().len(), witness.errors().len(), witness.rec()), (0, 0, 0));
}

#[test]
fn a_node_joins_after_eleven_recessive_bits_and_not_within_a_frame() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    run(&mut bus, [&mut a, &mut b], Time::from_us(50));
    assert_eq!(a.time_of(Event::Joined), Time::from_ns(10_875));
    a.send(standard(0x123, &[0x55; 8]));
    run(&mut bus, [&mut a, &mut b], Time::from_us(30));
    let mut late = Node::stopped(0, MEGABIT);
    late.controller.start(bus.now());
    run(&mut bus, [&mut a, &mut b, &mut late], Time::from_us(300));
    let (_, end) = a.transmitted()[0];
    // ACK delimiter, seven bits of EOF and three of intermission are the eleven.
    assert_eq!(late.time_of(Event::Joined) - end, Time::from_ns(2_875));
    assert_eq!(late.errors(), []);
}

#[test]
fn a_stop_waits_for_the_frame_under_way() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    run(&mut bus, [&mut a, &mut b], Time::from_us(50));
    a.send(standard(0x123, &[0x55; 8]));
    a.send(standard(0x124, &[0x55; 8]));
    run(&mut bus, [&mut a, &mut b], Time::from_us(30));
    a.controller.stop();
    assert!(!a.controller.is_stopped());
    run(&mut bus, [&mut a, &mut b], Time::from_ms(1));
    assert_eq!(b.received().len(), 1);
    assert_eq!(a.time_of(Event::Stopped), a.transmitted()[0].1 - Time::from_ns(125));
    b.controller.stop();
    assert!(b.controller.is_stopped(), "at once on an idle bus");
}

#[test]
fn codes_above_eight_travel_as_they_are_with_eight_bytes() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    for dlc in 9..=15 {
        a.send(standard(0x123, &[dlc; 8]).with_dlc(dlc));
    }
    run(&mut bus, [&mut a, &mut b], Time::from_ms(2));
    assert_eq!(
        b.received(),
        (9..=15).map(|dlc| standard(0x123, &[dlc; 8]).with_dlc(dlc)).collect::<Vec<_>>()
    );
}

#[test]
fn a_frame_is_not_sent_before_its_time() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    a.controller.offer(Some(standard(1, &[])), Time::from_us(777));
    run(&mut bus, [&mut a, &mut b], Time::from_ms(1));
    let (start, _) = a.transmitted()[0];
    assert!((Time::from_us(777)..Time::from_us(778)).contains(&start));
}

#[test]
fn the_same_run_gives_the_same_events() {
    let events = || {
        let mut nodes = [0, 13, -40, 77].map(|ppm| Node::new(ppm, MEGABIT));
        for (n, node) in nodes.iter_mut().enumerate() {
            (0..50)
                .for_each(|k| node.send(standard(0x700 + (k * 7 + n as u16) % 30, &[k as u8; 4])));
        }
        let [a, b, c, d] = &mut nodes;
        run(&mut Bus::new(), [a, b, c, d], Time::from_ms(50));
        nodes.map(|node| node.log)
    };
    assert_eq!(events(), events());
}
