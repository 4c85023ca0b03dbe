//! Frames on the bus: length, order, arbitration, repetition.

use emulator::{
    Time,
    can::{Bus, Event, Frame, Id},
};

use crate::node::{MEGABIT, Node, run, standard};

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
    let mut nodes = by_priority.map(|frame| {
        let mut node = Node::new(0, MEGABIT);
        node.send(frame);
        node
    });
    let mut listener = Node::new(0, MEGABIT);
    let [a, b, c, d, e, f, g] = &mut nodes;
    run(&mut Bus::new(), [g, e, c, a, b, d, f, &mut listener], Time::from_ms(1));
    assert_eq!(listener.received(), by_priority);
    for (place, node) in nodes.iter().enumerate() {
        assert_eq!((node.errors(), node.tec(), node.rec()), (vec![], 0, 0), "{place}");
        let is_loss = |(_, event): &&(Time, Event)| *event == Event::ArbitrationLost;
        assert_eq!(node.log.iter().filter(is_loss).count(), place);
    }
}

#[test]
fn a_frame_is_not_sent_before_its_time() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    a.controller.offer(Some(standard(1, &[])), Time::from_us(777));
    run(&mut bus, [&mut a, &mut b], Time::from_ms(1));
    let (start, _) = a.transmitted()[0];
    assert!((Time::from_us(777)..Time::from_us(778)).contains(&start));
}
