//! Errors on a bus: collisions and missing acknowledgement.

use emulator::{
    Time,
    can::{Bus, ErrorKind, Event},
};

use crate::node::{MEGABIT, Node, run, standard};

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
fn a_collision_ends_when_the_recessive_starter_is_error_passive() {
    let (mut bus, mut a, mut b) = (Bus::new(), Node::new(0, MEGABIT), Node::new(0, MEGABIT));
    a.send(standard(0x100, &[0x00, 0x80]));
    b.send(standard(0x100, &[0x80, 0x00]));
    run(&mut bus, [&mut a, &mut b], Time::from_ms(10));
    assert_eq!((a.transmitted().len(), b.transmitted().len()), (1, 1));
    assert!(b.errors().len() > 15);
    assert_eq!(b.errors()[0], (ErrorKind::BitRecessive, true));
}
