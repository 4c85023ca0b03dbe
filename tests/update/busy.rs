//! The loader answers while the flash is busy, with the slowest flash.

use emulator::{Time, chip::Timing};

use super::rig::{Rig, file};

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

#[test]
fn while_it_clears_lss_answers_in_25_us_and_the_heartbeat_comes_in_time() {
    const PERIOD_US: u64 = 100_000;
    let mut rig = stopped();
    // 1017h = 100 ms.
    assert_eq!(rig.ask([0x2B, 0x17, 0x10, 0, 100, 0, 0, 0]).unwrap()[0], 0x60);
    let stalls = rig.0.network.board(0).flash_stalls();
    assert!(rig.try_control(3).unwrap());
    let from = rig.0.network.now();
    let mut slowest = Time::ZERO;
    while rig.try_number(0x1F57, 1).unwrap() & 1 == 1 {
        let asked = rig.0.transmit_request("04 01");
        let asked = rig.0.transmit_request("5E").max(asked);
        rig.0.network.run_for(Time::from_ms(1));
        let answer = rig.0.requested(0, asked).find(|(_, frame)| frame.to_string().contains("7E4"));
        let (at, _) = answer.expect("an answer of LSS");
        slowest = slowest.max(at - asked);
        rig.0.transmit_request("04 00");
        rig.0.network.run_for(Time::from_ms(7));
    }
    println!("LSS answers within {} ns", slowest.as_ps() / 1000);
    // A step of the work holds the answer up.
    assert!(slowest < Time::from_us(25), "{} ns", slowest.as_ps() / 1000);
    assert!(rig.0.network.now() - from > Time::from_s(4), "it was busy for long");
    let heartbeats: Vec<Time> = rig
        .0
        .requested(0, from)
        .filter(|(_, frame)| frame.to_string().contains("705"))
        .map(|(time, _)| time)
        .collect();
    assert!(heartbeats.len() > 40, "{} heartbeats", heartbeats.len());
    for pair in heartbeats.windows(2) {
        let period = (pair[1] - pair[0]).as_ps() / 1_000_000;
        assert!(period.abs_diff(PERIOD_US) < 1000, "{period} us");
    }
    assert_eq!(rig.0.network.board(0).flash_stalls(), stalls);
    assert_eq!(rig.0.network.board(0).misuse(), None);
}
