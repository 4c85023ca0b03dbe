//! The loader answers while the flash is busy, with the slowest flash.

use emulator::{
    Time,
    can::{Frame, Id},
    chip::Timing,
    network::{AdapterId, Source},
};
use testkit::{frames, image_rig::Sent, wire::on_the_wire};

use super::rig::{RATE, Rig, file};

/// The board with the slowest flash, in the loader.
fn stopped() -> Rig {
    let mut rig = Rig::new();
    rig.0.network.permit_misuse();
    rig.0.network.board(0).chip().flash_mut().set_timing(Timing::Worst);
    assert!(rig.try_control(0).unwrap());
    rig
}

#[test]
fn a_download_right_after_clear_has_each_answer_within_100_ms() {
    let mut rig = stopped();
    rig.1 = Time::from_ms(100);
    let stalls = rig.0.network.board(0).flash_stalls();
    assert!(rig.try_control(3).unwrap());
    assert!(rig.try_download(&file("0.2.0")).unwrap());
    assert_eq!(rig.0.network.board(0).flash_stalls(), stalls);
    assert!(rig.try_control(1).unwrap());
    rig.0.network.run_for(Time::from_s(1));
    assert_eq!(rig.version(), "0.2.0");
}

/// The period of the heartbeat.
const PERIOD: Time = Time::from_ms(100);

/// Fills the bus: requests of an LSS master, each with two frames for nobody behind it.
pub fn flood(rig: &mut Rig, by: AdapterId, requests: usize) {
    let request = on_the_wire(&frames::request("5E"));
    let other = Frame::data(Id::Standard(0x7FF), &[0x55; 8]);
    for frame in [request, other, other].iter().cycle().take(3 * requests) {
        rig.0.network.send(by, *frame);
    }
}

/// The longest time to the answer of an LSS master, each request having one, and the number of requests: from the end of
/// the request, or of an own frame that the board had to send before, until the answer is in a mailbox.
pub fn slowest_answer(rig: &Rig, since: Time) -> (Time, usize) {
    let request = on_the_wire(&frames::request("5E"));
    let sent: Vec<Sent> = rig.0.sent(since).collect();
    let asked = sent.iter().filter(|sent| sent.frame == request).map(|sent| sent.end);
    let own: Vec<Time> =
        sent.iter().filter(|sent| sent.by == Source::Board(0)).map(|sent| sent.end).collect();
    let answers = rig.0.requested(0, since).filter(|(_, frame)| frame.id == Id::Standard(0x7E4));
    let answers: Vec<Time> = answers.map(|(time, _)| time).collect();
    assert_eq!(answers.len(), asked.clone().count(), "a frame was lost");
    let times = asked.zip(&answers).map(|(asked, answer)| {
        let before = own.partition_point(|end| end < answer);
        *answer - before.checked_sub(1).map_or(asked, |last| asked.max(own[last]))
    });
    (times.max().expect("requests"), answers.len())
}

/// Checks that each heartbeat was in a mailbox within 1 ms of its time. On the bus it has to wait for the segments of a
/// block, which come first.
fn check_heartbeat(rig: &Rig, since: Time) {
    let heartbeats = rig.0.requested(0, since).filter(|(_, frame)| frame.id == Id::Standard(0x705));
    let heartbeats: Vec<Time> = heartbeats.map(|(time, _)| time).collect();
    assert!(heartbeats.len() > 5, "{} heartbeats", heartbeats.len());
    for pair in heartbeats.windows(2) {
        let period = pair[1] - pair[0];
        let is_in_time = period + Time::from_ms(1) > PERIOD && period < PERIOD + Time::from_ms(1);
        assert!(is_in_time, "{} ns", period.as_ps() / 1000);
    }
}

#[test]
fn on_a_full_bus_a_busy_loader_answers_lss_in_15_us_and_loses_no_frame() {
    let mut rig = stopped();
    let [by, _] = rig.0.add_others(RATE);
    // 1017h = 100 ms.
    assert_eq!(rig.ask([0x2B, 0x17, 0x10, 0, 100, 0, 0, 0]).unwrap()[0], 0x60);
    rig.0.transmit_request("04 01");
    let stalls = rig.0.network.board(0).flash_stalls();
    let from = rig.0.network.now();
    assert!(rig.try_control(3).unwrap());
    while rig.try_number(0x1F57, 1).unwrap() & 1 == 1 {
        if rig.0.network.adapter_mut(by).unsent() < 300 {
            flood(&mut rig, by, 200);
        }
        rig.0.network.run_for(Time::from_ms(20));
    }
    let cleared = rig.0.network.now();
    assert!(cleared - from > Time::from_s(4), "it was busy for long");
    flood(&mut rig, by, 5_000);
    // A lost segment would be missed at the end.
    assert!(rig.try_download(&file("0.2.0")).unwrap());
    let end = rig.0.network.now();
    assert!(rig.0.network.adapter_mut(by).unsent() > 0, "the bus was not full all the time");
    rig.0.network.adapter_mut(by).close();
    rig.0.network.run_for(Time::from_ms(5));
    for span in [from..cleared, cleared..end] {
        let load = rig.0.bus_load(span);
        assert!(load > 95, "{load} %");
    }
    let (slowest, requests) = slowest_answer(&rig, from);
    println!("{requests} requests, LSS answers within {} ns", slowest.as_ps() / 1000);
    assert!(requests > 9_000, "{requests} requests");
    // Of which 11.3 us are one acknowledge of a block that was held back.
    assert!(slowest < Time::from_us(15), "{} ns", slowest.as_ps() / 1000);
    check_heartbeat(&rig, from);
    assert_eq!(rig.0.network.board(0).flash_stalls(), stalls);
    assert_eq!(rig.0.network.board(0).misuse(), None);
}

#[test]
fn a_store_while_the_loader_is_busy_is_answered_as_failed() {
    let mut rig = stopped();
    assert!(rig.try_control(3).unwrap());
    rig.0.ask("04 01, 17", "17 02");
    rig.0.transmit_request("04 00");
    assert_eq!(rig.number(0x1F57, 1) & 1, 1, "it was not busy");
}
