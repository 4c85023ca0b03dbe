//! Bit rates and crystals that match, and those that do not.

use emulator::{
    Time,
    can::{BitSegments, Bus, Mode},
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
