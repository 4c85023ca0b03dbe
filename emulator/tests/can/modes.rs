//! Silent and loopback mode, and joining and leaving the bus.

use emulator::{
    Time,
    can::{Bus, Event, Mode},
};

use crate::node::{MEGABIT, Node, run, standard};

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
