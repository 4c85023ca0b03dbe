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
fn of_simultaneous_frames_the_lowest_identifier_wins_and_none_is_lost() {
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
