//! Errors on a bus: collisions, missing acknowledgement, bus-off.

use emulator::{
    Time,
    can::{Bus, ErrorKind, Event},
};

use crate::node::{MEGABIT, Node, at, run, standard};

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
fn alone_the_transmit_error_counter_stops_at_128_and_the_frame_repeats() {
    let (mut bus, mut a) = (Bus::new(), Node::new(0, MEGABIT));
    let frame = standard(0x700, &[0]);
    a.send(frame);
    run(&mut bus, [&mut a], Time::from_ms(20));
    assert_eq!(a.tec(), 128);
    assert!(a.errors().len() > 150);
    assert!(a.errors().iter().all(|error| *error == (ErrorKind::Acknowledgement, true)));
    // Error passive: frame up to the ACK slot, six bits of flag, eight of delimiter, three and eight until the next
    // frame.
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
fn a_collision_ends_when_the_recessive_starter_is_error_passive() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    a.send(standard(0x100, &[0x00, 0x80]));
    b.send(standard(0x100, &[0x80, 0x00]));
    run(&mut bus, [&mut a, &mut b], Time::from_ms(10));
    assert_eq!((a.transmitted().len(), b.transmitted().len()), (1, 1));
    assert!(b.errors().len() > 15);
}

#[test]
fn a_disturbed_transmitter_goes_bus_off_and_recovers_after_1408_bits() {
    let (mut bus, mut a, mut noise) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, at(500)));
    a.send(standard(0x7FF, &[0xFF; 8]));
    while !a.controller.counters().bus_off() {
        noise.send(standard(0, &[0; 8]));
        run(&mut bus, [&mut a, &mut noise], Time::from_us(100));
        assert!(bus.now() < Time::from_ms(500), "TEC {}", a.tec());
    }
    noise.controller.reset();
    let starts =
        |node: &Node| node.log.iter().filter(|(_, event)| *event == Event::Started).count();
    let started = starts(&a);
    run(&mut bus, [&mut a, &mut noise], Time::from_ms(10));
    assert_eq!(starts(&a), started, "bus-off is silent");

    a.withdraw();
    a.controller.recover(bus.now());
    let began = bus.now();
    run(&mut bus, [&mut a, &mut noise], Time::from_ms(2));
    assert_eq!(a.time_of(Event::Recovered) - began, Time::from_ns(128 * 11 * 1_000 - 125));
    assert_eq!((a.tec(), a.rec()), (0, 0));
}
