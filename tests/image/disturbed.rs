//! Networks that are disturbed: sessions of an LSS master beside bit errors, boards beside a foreign device.

use emulator::network::Noise;

use crate::{reachable::pairs, rig::*};

const RATE: BitRate = BitRate::Kbit125;

/// A board that the master has selected, with single-bit pulses on the bus from now on.
fn session(node_id: u8, random: &mut Random) -> ImageRig {
    let mut rig = rig_with(settings(node_id, RATE));
    rig.network.record(Recording::Latest(1_000));
    rig.network.run_for(Time::from_ms(50));
    let mean_interval = Time::from_ms(random.within(100..1_500));
    let length = Time::from_us(8);
    rig.network.set_noise(Some(Noise { seed: random.u64(), mean_interval, length }));
    rig.send("04 01");
    rig.network.run_for(Time::from_ms(20));
    rig
}

fn pause(rig: &mut ImageRig, random: &mut Random) {
    rig.network.run_for(Time::from_ms(random.within(3_000..20_000)));
}

/// Sends a request and returns the bytes of the answer, if there is one.
fn ask(rig: &mut ImageRig, request: &str) -> Option<Vec<u8>> {
    rig.collect(Time::ZERO);
    rig.queue(&frames::request(request));
    let sent = rig.collect(Time::from_ms(50)).0;
    let answer = sent.iter().find(|frame| frame.cob_id() == 0x7E4)?;
    Some(answer.data()[..2].to_vec())
}

/// Whether a board gets its node-ID in a session that is interrupted by a pause.
fn gives_the_node_id(random: &mut Random) -> bool {
    let mut rig = session(0xFF, random);
    let is_configured = ask(&mut rig, "11 05") == Some(vec![0x11, 0]);
    pause(&mut rig, random);
    let is_stored = ask(&mut rig, "17") == Some(vec![0x17, 0]);
    rig.send("04 00");
    let sent = rig.collect(Time::from_ms(50)).texts();
    is_configured && is_stored && sent.first().is_some_and(|text| text == "705: 00")
}

/// Whether a board switches after a pause before the request.
fn switches(random: &mut Random) -> bool {
    let mut rig = session(0x40, random);
    let is_configured = ask(&mut rig, "13 00 02") == Some(vec![0x13, 0]);
    pause(&mut rig, random);
    rig.send("15 0A 00");
    rig.network.run_for(Time::from_ms(15));
    rig.set_master_bit_rate(BitRate::Kbit500);
    rig.network.run_for(Time::from_ms(30));
    is_configured && ask(&mut rig, "5E") == Some(vec![0x5E, 0x40])
}

/// Fails unless all of the sessions succeed.
fn all(count: u32, seed: u64, mut session: impl FnMut(&mut Random) -> bool) {
    let mut random = Random::from_seed(seed);
    let succeeded = (0..count).filter(|_| session(&mut random)).count() as u32;
    println!("{succeeded} of {count} sessions succeed");
    assert_eq!(succeeded, count);
}

#[test]
fn single_bit_pulses_and_pauses_end_no_session() {
    all(48, 1, gives_the_node_id);
}

#[test]
fn single_bit_pulses_and_pauses_keep_no_board_from_a_switch() {
    all(24, 2, switches);
}

/// What keeps boards from their rate for a while after their power-on.
#[derive(Clone, Copy, Debug)]
enum Disturbance {
    /// A device at another rate, which sends without a pause; a second one acknowledges.
    Foreign(BitRate),
    /// Pulses of a bit's length, 20 bits apart on average.
    Noise,
}

/// A network that is disturbed.
#[derive(Clone, Copy, Debug)]
struct Site {
    home: BitRate,
    boards: u8,
    heartbeat_ms: u16,
    /// The master only listens; otherwise it acknowledges, too.
    listens: bool,
    begin_ms: u64,
    span_ms: u64,
}

/// The time from the end of a disturbance until the master has received a heartbeat of every board.
fn time_until_all_are_heard(site: Site, disturbance: Disturbance) -> Option<Time> {
    let Site { home, boards, heartbeat_ms, listens, begin_ms, span_ms } = site;
    let with = |number| board_with(number, settings(number, home).with_heartbeat_ms(heartbeat_ms));
    let mut rig = ImageRig::new(home, (1..=boards).map(with));
    rig.network.record(Recording::Off);
    (0..usize::from(boards)).for_each(|board| rig.network.power_off(board));
    if listens {
        rig.network.adapter_mut(rig.master).close();
        rig.network.adapter_mut(rig.master).listen_only();
    }
    let rate = match disturbance {
        Disturbance::Foreign(rate) => rate,
        Disturbance::Noise => home,
    };
    let devices = [(); 2].map(|()| rig.network.add_adapter(Adapter::new(bit_per_s(rate))));
    devices.iter().for_each(|&device| rig.network.adapter_mut(device).close());
    rig.network.run_for(Time::from_ms(10));
    for board in 0..usize::from(boards) {
        rig.network.power_on(board);
    }
    rig.network.run_for(Time::from_ms(begin_ms));
    let end = rig.network.now() + Time::from_ms(span_ms);
    match disturbance {
        Disturbance::Foreign(_) => {
            devices.iter().for_each(|&device| rig.network.adapter_mut(device).open());
            let mut random = Random::from_seed(u64::from(boards) + span_ms);
            while rig.network.now() < end {
                if rig.network.adapter_mut(devices[0]).unsent() == 0 {
                    let frame = Frame::data(Id::Standard(0x181), &random.bytes::<8>());
                    rig.network.send(devices[0], frame);
                }
                rig.network.run_for(Time::from_us(1_000));
            }
            devices.iter().for_each(|&device| rig.network.adapter_mut(device).close());
        }
        Disturbance::Noise => {
            let (length, mean_interval) = (rig.bit_time(), rig.bit_time() * 20);
            rig.network.set_noise(Some(Noise { seed: span_ms, mean_interval, length }));
            rig.network.run_until(end);
            rig.network.set_noise(None);
        }
    }
    while rig.network.receive(rig.master).is_some() {}
    let mut missing: Vec<_> = (1..=boards).collect();
    let limit = end + Time::from_s(20);
    while let Some((time, frame)) =
        rig.network.run_until_received(rig.master, limit.saturating_sub(rig.network.now()))
    {
        missing.retain(|&id| frame.id != Id::Standard(0x700 + u16::from(id)));
        if missing.is_empty() {
            return Some(time - end);
        }
    }
    None
}

/// Fails unless all boards of each eleventh site, or with `FULL` of each, are heard within `limit` after the disturbance.
fn assert_all_are_heard(sites: impl Iterator<Item = (Site, Disturbance)>, limit: Time) {
    let mut late = Vec::new();
    for (site, disturbance) in sites.step_by(every(11)) {
        let time = time_until_all_are_heard(site, disturbance);
        let what = format!("{time:?} after {disturbance:?}: {site:?}");
        println!("{what}");
        if time.is_none_or(|time| time > limit) {
            late.push(what);
        }
    }
    assert!(late.is_empty(), "{late:#?}");
}

/// The beginning and the length of disturbances, in milliseconds.
const SPANS_MS: [(u64, u64); 3] = [(0, 400), (1_100, 400), (0, 3_000)];

#[test]
fn boards_that_a_foreign_device_led_away_are_heard_within_3500_ms() {
    let sites = pairs().enumerate().map(|(number, (home, foreign))| {
        let (begin_ms, span_ms) = SPANS_MS[number % 3];
        let (boards, listens) = [(2, true), (2, false), (4, true), (3, false)][number / 3 % 4];
        let heartbeat_ms = [1000, 100][number % 2];
        let site = Site { home, boards, heartbeat_ms, listens, begin_ms, span_ms };
        (site, Disturbance::Foreign(foreign))
    });
    assert_all_are_heard(sites, Time::from_ms(3_500));
}

#[test]
fn a_lone_board_at_its_right_rate_is_heard_within_5_s_of_a_foreign_device() {
    let sites = pairs().enumerate().map(|(number, (home, foreign))| {
        let (begin_ms, span_ms) = SPANS_MS[number % 3];
        let heartbeat_ms = [1000, 100][number % 2];
        let site = Site { home, boards: 1, heartbeat_ms, listens: false, begin_ms, span_ms };
        (site, Disturbance::Foreign(foreign))
    });
    assert_all_are_heard(sites, Time::from_s(5));
}

#[test]
fn boards_at_their_right_rate_are_heard_within_5_s_of_noise() {
    let sites = BitRate::ALL.into_iter().flat_map(|home| {
        [(1, false), (3, true), (3, false)].into_iter().zip(SPANS_MS).map(
            move |((boards, listens), (begin_ms, span_ms))| {
                let site = Site { home, boards, heartbeat_ms: 1000, listens, begin_ms, span_ms };
                (site, Disturbance::Noise)
            },
        )
    });
    assert_all_are_heard(sites, Time::from_s(5));
}
