//! The release image under overload: a full bus, endless errors, endless interrupts, tasks that do nothing.

use crate::rig::*;

/// Longer than the time-out of the watchdog.
const LONG: Time = Time::from_s(4);
/// The longest time from the end of a frame to the start of the next waiting one: three bits at 1 Mbit/s, and the bits
/// of two nodes are not in step.
const INTERMISSION: Time = Time::from_us(4);

#[test]
fn a_heartbeat_too_frequent_for_the_bus_leaves_half_of_it_to_lss() {
    let mut rig = rig_with(settings(0x40, BitRate::Kbit10));
    rig.collect(Time::from_ms(50));
    rig.transmit(on_the_wire(&sdo::request(0x40, "2B 17 10 00 05 00 00 00")));
    rig.collect(Time::from_ms(500));
    let alone = rig.network.now()..rig.network.now() + Time::from_s(2);
    let heartbeats = rig.collect(Time::from_s(2)).0.len();
    let load = rig.bus_load(alone);
    println!("{heartbeats} heartbeats in 2 s, {load} % of the bus");
    assert!((40..=50).contains(&load), "{load} %");
    rig.transmit_request("04 01");
    for _ in 0..20 {
        let asked = rig.network.now();
        rig.transmit_request("5E");
        let is_answer = |frame: &canopen_node::Frame| frame.cob_id() == 0x7E4;
        while !rig.next_frame().1.0.iter().any(is_answer) {}
        // Request and answer take 12 ms each, and a heartbeat of 6 ms may come before each.
        let took = rig.network.now() - asked;
        assert!(took < Time::from_ms(45), "{took} ms");
    }
}

#[test]
fn answers_wait_for_urgent_frames_and_follow_right_behind_in_order() {
    let mut rig = node_40(500);
    rig.lss("04 01, 11 04");
    let since = rig.network.now();
    rig.send("17, 5E");
    let urgent = Frame::data(Id::Standard(0x001), &[0x55; 8]);
    let read = on_the_wire(&sdo::request(0x40, "40 17 10 00"));
    // Frames of eight bytes take at least 0.11 ms.
    let count = LONG.as_ps() / Time::from_us(110).as_ps();
    for number in 0..count {
        let frame = if number == 5 { read } else { urgent };
        rig.network.send(rig.master, frame);
    }
    rig.send_all();
    rig.collect(Time::from_ms(5));
    let frames: Vec<_> = rig.sent(since).collect();
    for pair in frames.windows(2) {
        let (Sent { frame, start, .. }, pause) = (pair[1], pair[1].start - pair[0].end);
        let is_heartbeat = frame.id == Id::Standard(0x740);
        assert!(pause <= INTERMISSION || is_heartbeat, "{frame} at {start}, {pause} ms later");
    }
    let behind = frames.iter().rposition(|sent| sent.frame == urgent).expect("the flood") + 1;
    let is_of_board = |sent: &Sent| matches!(sent.by, Source::Board(_));
    assert!(!frames[..behind].iter().any(is_of_board), "no frame of the board during the flood");
    let sent: Vec<_> = frames[behind..].iter().map(|sent| sent.frame.to_string()).collect();
    // By priority; the two of LSS in the order of the board.
    let answers =
        ["5C0#4B171000F4010000", "740#7F", "7E4#5E40000000000000", "7E4#1700000000000000"];
    assert_eq!(sent, answers);
}

#[test]
fn a_full_bus_of_the_shortest_frames_loses_none_during_a_slow_flash_write() {
    let mut rig = node_40(0);
    rig.network.board(0).chip().flash_mut().set_timing(Timing::Worst);
    rig.send("04 01");
    let shortest = Frame::data(Id::Standard(0x7E5), &[]);
    const STORES: usize = 20;
    for node_id in 1..=STORES {
        rig.send(&format!("11 {node_id:02X}, 17"));
        (0..40).for_each(|_| rig.network.send(rig.master, shortest));
    }
    rig.send_all();
    let answers = rig.collect(Time::from_ms(5)).0;
    let count = |text: &str| {
        let is_one = |frame: &&canopen_node::Frame| frames::text(frame).starts_with(text);
        answers.iter().filter(is_one).count()
    };
    assert_eq!([count("7E4: 11 00"), count("7E4: 17 00")], [STORES; 2]);
    assert!(!rig.has_logged("CAN: overrun"));
}

/// For a long time the other nodes see only errors.
fn disturb(rig: &mut ImageRig) {
    let disturber = rig.add_disturber();
    rig.disturb(disturber, Id::Standard(0), Time::from_us(300), LONG);
}

#[test]
fn after_a_bus_of_error_frames_only_the_board_answers_again() {
    let mut rig = node_40(20);
    rig.lss("04 01");
    disturb(&mut rig);
    let errors = rig.errors().len();
    assert!(errors > 20_000, "{errors} errors");
    rig.collect(Time::from_s(1));
    assert!(answers(&mut rig));
}

#[test]
fn noise_without_end_does_not_end_the_search_for_the_bit_rate() {
    let automatic = settings(0x40, BitRateSetting::Automatic);
    let mut rig = ImageRig::new(BitRate::Kbit500, [board_with(0, automatic)]);
    let since = rig.network.now();
    disturb(&mut rig);
    let tried = rig.bit_rates(0, since).len();
    assert!(tried > 10, "{tried} bit rates were tried");
    for _ in 0..100 {
        rig.send("4C");
        rig.network.run_for(Time::from_ms(20));
    }
    rig.collect(Time::from_ms(100));
    assert_eq!(rig.lss("04 01, 5E"), ["5E 40"]);
}

#[test]
fn an_interrupt_every_50_us_without_end_starves_no_task() {
    let mut rig = node_40(5);
    rig.lss("04 01");
    // No frame that passes the filters is shorter.
    let shortest = Frame::data(Id::Standard(0x7E5), &[]);
    let since = rig.network.now();
    let (cycles, busy) = rig.network.board(0).cycles();
    let mut answers = Vec::new();
    for node_id in 1..=8 {
        for request in [format!("11 {node_id:02X}").as_str(), "17"] {
            rig.send(request);
            (0..LONG.as_ps() / Time::from_us(16 * 50).as_ps())
                .for_each(|_| rig.network.send(rig.master, shortest));
            while rig.network.adapter_mut(rig.master).unsent() > 0 {
                answers.extend(rig.collect(Time::from_ms(10)).0);
            }
        }
    }
    let span = rig.network.now() - since;
    let (cycles, busy) =
        (rig.network.board(0).cycles().0 - cycles, rig.network.board(0).cycles().1 - busy);
    println!("{} ms, busy for {} % of them", span, 100 * busy / cycles);
    assert!(span > Time::from_s(3) && 100 * busy / cycles > 1, "it is busy");
    let count =
        |text: &str| answers.iter().filter(|frame| frames::text(frame).starts_with(text)).count();
    // The tasks of interrupts, of flash, and of deadlines; the watchdog would reveal others.
    assert_eq!([count("7E4: 11 00"), count("7E4: 17 00")], [8; 2]);
    let due = (span.as_ps() / Time::from_ms(5).as_ps()) as usize;
    assert!(
        (due - 2..=due + 2).contains(&count("740: 7F")),
        "{} of {due} heartbeats",
        count("740: 7F")
    );
    assert!(!rig.has_logged("CAN: overrun"));
}
