//! Bit rates and crystals that match, those that do not, and silent nodes.

use emulator::{
    Time,
    can::{BitSegments, Bus, Event, Mode},
};

use crate::node::{MEGABIT, Node, at, run, standard};

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
fn a_silent_node_at_another_rate_disturbs_no_node() {
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
fn crystals_that_are_half_a_percent_off_understand_each_other() {
    let wide = BitSegments { jump_width: 2, ..MEGABIT };
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
