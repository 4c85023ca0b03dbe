//! Networks that are disturbed: sessions of an LSS master beside bit errors, boards beside a foreign device.

use emulator::network::Noise;

use crate::rig::*;

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

/// The time from the departure of a foreign device until a master, which only listens or only acknowledges, has
/// received a heartbeat of every board.
fn time_until_all_are_heard(
    count: u8,
    heartbeat_ms: u16,
    (listens, begin_ms, span_ms): (bool, u64, u64),
    foreign: BitRate,
) -> Option<Time> {
    let with = |number| board_with(number, settings(number, RATE).with_heartbeat_ms(heartbeat_ms));
    let mut rig = ImageRig::new(RATE, (1..=count).map(with));
    rig.network.record(Recording::Off);
    (0..usize::from(count)).for_each(|board| rig.network.power_off(board));
    if listens {
        rig.network.adapter_mut(rig.master).close();
        rig.network.adapter_mut(rig.master).listen_only();
    }
    let devices = [(); 2].map(|()| rig.network.add_adapter(Adapter::new(bit_per_s(foreign))));
    devices.iter().for_each(|&device| rig.network.adapter_mut(device).close());
    rig.network.run_for(Time::from_ms(10));
    for board in 0..usize::from(count) {
        rig.network.power_on(board);
    }
    rig.network.run_for(Time::from_ms(begin_ms));
    devices.iter().for_each(|&device| rig.network.adapter_mut(device).open());
    let end = rig.network.now() + Time::from_ms(span_ms);
    let mut random = Random::from_seed(u64::from(count) + span_ms);
    while rig.network.now() < end {
        if rig.network.adapter_mut(devices[0]).unsent() == 0 {
            let frame = Frame::data(Id::Standard(0x181), &random.bytes::<8>());
            rig.network.send(devices[0], frame);
        }
        rig.network.run_for(Time::from_us(1_000));
    }
    devices.iter().for_each(|&device| rig.network.adapter_mut(device).close());
    while rig.network.receive(rig.master).is_some() {}
    let mut missing: Vec<_> = (1..=count).collect();
    let limit = end + Time::from_s(60);
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

#[test]
fn boards_that_a_foreign_device_led_away_come_back_to_a_silent_master() {
    let mut late = Vec::new();
    let rates = [BitRate::Kbit500, BitRate::Kbit250, BitRate::Kbit50, BitRate::Kbit1000];
    for (number, foreign) in rates.into_iter().enumerate() {
        for (count, listens) in [(2, true), (2, false), (4, true), (3, false)] {
            let (begin_ms, span_ms) = [(0, 400), (1_100, 400), (0, 3_000)][number % 3];
            let heartbeat_ms = [1000, 100][number % 2];
            let device = (listens, begin_ms, span_ms);
            let time = time_until_all_are_heard(count, heartbeat_ms, device, foreign);
            let what = format!(
                "{count} boards, heartbeat {heartbeat_ms} ms, {foreign:?} for {span_ms} ms after \
                 {begin_ms} ms, master listens: {listens}: {time:?}"
            );
            println!("{what}");
            if time.is_none_or(|time| time > Time::from_s(6)) {
                late.push(what);
            }
        }
    }
    assert!(late.is_empty(), "{late:#?}");
}
