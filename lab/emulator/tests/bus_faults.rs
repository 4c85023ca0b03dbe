//! Shorts, broken wires, noise and injected bit errors: their effect on each station, and the recovery.

use emulator::{
    Time,
    can::{Adapter, ErrorKind, Frame, Id},
    network::{AdapterId, Event, Network, Noise, Short, Source, What},
};

const BIT: Time = Time::from_us(4);

fn frame(id: u16) -> Frame {
    Frame::data(Id::Standard(id), &[0x55; 8])
}

/// Adapters at 250 kbit/s that have joined an idle bus.
fn adapters<const N: usize>() -> (Network, [AdapterId; N]) {
    let mut network = Network::new();
    let adapters = [(); N].map(|()| network.add_adapter(Adapter::new(250_000)));
    network.run_for(Time::from_ms(1));
    (network, adapters)
}

/// The time and kind of a station's errors in the trace.
fn errors(network: &Network, of: AdapterId) -> Vec<(Time, ErrorKind)> {
    let error = |event: &Event| match event.what {
        What::Error { kind, .. } if event.source == Source::Adapter(of) => Some((event.time, kind)),
        _ => None,
    };
    network.trace().iter().filter_map(error).collect()
}

fn went_bus_off(network: &Network, who: AdapterId) -> bool {
    let of = |event: &&Event| event.source == Source::Adapter(who);
    network.trace().iter().filter(of).any(|event| event.what == What::BusOff)
}

fn gets_through(network: &mut Network, from: AdapterId, to: AdapterId, id: u16) -> bool {
    network.send(from, frame(id));
    network.run_until_received(to, Time::from_ms(10)).is_some_and(|(_, f)| f == frame(id))
}

#[test]
fn a_recessive_short_silences_the_sender_unnoticed_by_others() {
    let (mut network, [a, b]) = adapters();
    network.set_short(Some(Short::Recessive));
    assert!(!gets_through(&mut network, a, b, 0x123));
    assert!(went_bus_off(&network, a));
    assert!(errors(&network, a).iter().all(|&(_, kind)| kind == ErrorKind::BitDominant));
    assert_eq!(network.adapter_mut(b).errors(), 0);
    network.set_short(None);
    assert!(network.run_until_received(b, Time::from_ms(20)).is_some(), "after the recovery");
}

/// An error active transmitter counts 8 for the SOF and for each bit of its flags.
#[test]
fn a_recessive_short_counts_an_error_for_each_bit_of_an_active_flag() {
    let (mut network, [a, _]) = adapters();
    network.set_short(Some(Short::Recessive));
    network.send(a, frame(0x123));
    network.run_for(BIT * 18);
    let times: Vec<Time> = errors(&network, a).iter().map(|&(time, _)| time).collect();
    assert_eq!(times.len(), 17, "136 makes it error passive");
    assert!(times.windows(2).all(|pair| pair[1] - pair[0] == BIT), "{times:?}");
}

#[test]
fn a_short_in_the_middle_of_a_frame_is_an_error_of_its_sender() {
    for (short, found) in
        [(Short::Dominant, ErrorKind::BitRecessive), (Short::Recessive, ErrorKind::BitDominant)]
    {
        let (mut network, [a, b]) = adapters();
        network.send(a, frame(0x123));
        network.run_for(BIT * 40);
        network.set_short(Some(short));
        network.run_for(BIT * 3);
        assert_eq!(errors(&network, a)[0].1, found);
        network.set_short(None);
        let received = network.run_until_received(b, Time::from_ms(20));
        assert_eq!(received.map(|(_, received)| received), Some(frame(0x123)));
    }
}

#[test]
fn a_station_that_is_cut_off_neither_hears_nor_is_heard() {
    let (mut network, [a, b, c]) = adapters();
    network.cut_wire(Source::Adapter(c));
    assert!(gets_through(&mut network, a, b, 0x123));
    assert_eq!(network.receive(c), None);
    assert!(!gets_through(&mut network, c, a, 0x124));
    let (unheard, _) = errors(&network, c)[0];
    assert_eq!(errors(&network, c)[0].1, ErrorKind::Acknowledgement, "at {unheard}");
    assert_eq!(network.adapter_mut(a).errors() + network.adapter_mut(b).errors(), 0);
    network.mend_wire(Source::Adapter(c));
    assert!(network.run_until_received(a, Time::from_ms(10)).is_some());
    assert!(gets_through(&mut network, a, c, 0x125));
}

#[test]
fn noise_destroys_frames_in_the_same_way_from_the_same_seed() {
    let run = |seed| {
        let (mut network, [a, b]) = adapters();
        let (mean_interval, length) = (Time::from_us(700), Time::from_us(6));
        network.set_noise(Some(Noise { seed, mean_interval, length }));
        (0..20).for_each(|id| network.send(a, frame(id)));
        network.run_for(Time::from_ms(40));
        let count = std::iter::from_fn(|| network.receive(b)).count();
        (count, network.trace().to_vec())
    };
    let (count, trace) = run(1);
    assert!(count > 5, "frames are repeated until they pass: {count}");
    assert!(trace.iter().filter(|event| matches!(event.what, What::Error { .. })).count() > 5);
    assert_eq!((count, &trace), (run(1).0, &run(1).1));
    assert_ne!(trace, run(2).1);
}

#[test]
fn a_flipped_bit_is_an_error_of_one_receiver_and_the_frame_is_repeated() {
    let (mut network, [a, b, c]) = adapters();
    let at = network.now() + BIT * 40;
    network.flip_bit(Source::Adapter(c), at);
    assert!(gets_through(&mut network, a, b, 0x123));
    let first = network.trace()[0].clone();
    assert!(first.time >= at && first.time <= at + BIT * 90, "{first}");
    assert!(matches!(first.what, What::Error { .. }));
    network.run_for(Time::from_ms(1));
    assert_eq!(network.receive(c).map(|(_, frame)| frame), Some(frame(0x123)));
    assert_eq!((network.receive(b), network.receive(c)), (None, None), "it was repeated once");
}
