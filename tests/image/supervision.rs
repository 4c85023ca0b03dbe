//! The supervision of the bit rate in networks: sessions of an LSS master beside bit errors, boards that a foreign
//! device has led away, and the errors that a search costs the others.

use emulator::{
    Time,
    can::{Adapter, Frame, Id},
    chip::ResetCause,
    network::{Noise, Recording},
};
use lss_slave::BitRate;
use testkit::{
    frames,
    image_rig::{ImageRig, bit_per_s, board_with, settings},
    random::Random,
};

const RATE: BitRate = BitRate::Kbit125;

/// A board that the master has selected, with single-bit pulses on the bus from now on.
fn session(node_id: u8, random: &mut Random) -> ImageRig {
    let mut rig = ImageRig::with(settings(node_id, RATE));
    rig.network.record(Recording::Latest(1_000));
    rig.network.run_for(Time::from_ms(50));
    let mean_interval = Time::from_ms(random.within(100..1_500));
    let length = Time::from_us(8);
    rig.network.set_noise(Some(Noise { seed: random.u64(), mean_interval, length }));
    rig.queue(&frames::request("04 01"));
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

#[test]
fn single_bit_pulses_and_pauses_end_no_session() {
    let mut random = Random::from_seed(1);
    for number in 0..12 {
        let mut rig = session(0xFF, &mut random);
        assert_eq!(ask(&mut rig, "11 05"), Some(vec![0x11, 0]), "session {number}");
        pause(&mut rig, &mut random);
        assert_eq!(ask(&mut rig, "17"), Some(vec![0x17, 0]), "session {number}");
        rig.queue(&frames::request("04 00"));
        let sent = rig.collect(Time::from_ms(50)).texts();
        assert_eq!(sent[0], "705: 00", "session {number}");
    }
}

#[test]
fn single_bit_pulses_and_pauses_keep_no_board_from_a_switch() {
    let mut random = Random::from_seed(2);
    for number in 0..6 {
        let mut rig = session(0x40, &mut random);
        assert_eq!(ask(&mut rig, "13 00 02"), Some(vec![0x13, 0]), "session {number}");
        pause(&mut rig, &mut random);
        rig.queue(&frames::request("15 0A 00"));
        rig.network.run_for(Time::from_ms(15));
        rig.set_master_bit_rate(BitRate::Kbit500);
        rig.network.run_for(Time::from_ms(30));
        assert_eq!(ask(&mut rig, "5E"), Some(vec![0x5E, 0x40]), "session {number}");
    }
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
        rig.expect_reset(board, ResetCause::PowerOn);
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
    for (number, foreign) in
        [BitRate::Kbit500, BitRate::Kbit250, BitRate::Kbit50, BitRate::Kbit1000]
            .into_iter()
            .enumerate()
    {
        for (count, listens) in [(2, true), (2, false), (4, true), (3, false)] {
            let (begin_ms, span_ms) = [(0, 400), (1_100, 400), (0, 3_000)][number % 3];
            let heartbeat_ms = [1000, 100][number % 2];
            let time = time_until_all_are_heard(
                count,
                heartbeat_ms,
                (listens, begin_ms, span_ms),
                foreign,
            );
            let what = format!(
                "{count} boards, heartbeat {heartbeat_ms} ms, {foreign:?} for {span_ms} ms after \
                 {begin_ms} ms, master listens: {listens}: {time:?}"
            );
            println!("{what}");
            assert!(time.is_some_and(|time| time <= Time::from_s(6)), "{what}");
        }
    }
}

/// The errors that another node counts while a board at a wrong rate searches, and then in its first visit home. It
/// receives a heartbeat a second.
fn errors_of_others(stored: BitRate, found: BitRate) -> (u64, u64) {
    let settings = settings(1, stored).with_heartbeat_ms(1000);
    let mut rig = ImageRig::new(found, [board_with(0, settings)]);
    rig.network.power_off(0);
    let other = rig.network.add_adapter(Adapter::new(bit_per_s(found)));
    rig.network.record(Recording::Off);
    rig.network.run_for(Time::from_ms(10));
    rig.network.power_on(0);
    rig.expect_reset(0, ResetCause::PowerOn);
    let mut next = rig.network.now();
    // The errors when a condition comes to hold.
    let mut until = |rig: &mut ImageRig, is_silent: bool| {
        let begin = rig.network.now();
        loop {
            let chip = rig.network.board(0).chip();
            let (silent, rate) = (chip.can(1).is_silent(), chip.can(1).bit_rate());
            drop(chip);
            let is_guest = !silent && rate == bit_per_s(found);
            if if is_silent { silent } else { is_guest } {
                return rig.network.adapter_mut(other).errors();
            }
            assert!(rig.network.now() < begin + Time::from_s(20), "{stored:?}, {found:?}");
            if rig.network.now() >= next {
                next += Time::from_ms(1000);
                rig.network.send(rig.master, Frame::data(Id::Standard(0x705), &[0x05]));
            }
            rig.network.run_for(Time::from_us(500));
        }
    };
    let [begin, found] = [true, false].map(|is_silent| until(&mut rig, is_silent));
    let [visit, back] = [true, false].map(|is_silent| until(&mut rig, is_silent));
    (found - begin, back - visit)
}

#[test]
fn others_count_at_most_200_errors_a_search_and_30_a_visit() {
    for stored in BitRate::ALL {
        // A slower node may not notice a heartbeat: it is over before a bit is sampled twice.
        let is_noticed = |found: &BitRate| stored.kbit_per_s() >= 50 || found.kbit_per_s() <= 125;
        for found in BitRate::ALL.into_iter().filter(|found| *found != stored && is_noticed(found))
        {
            let (search, visit) = errors_of_others(stored, found);
            let what = format!("{stored:?} stored, {found:?}: {search} errors, {visit} in a visit");
            println!("{what}");
            assert!(search <= 200 && visit <= 30, "{what}");
        }
    }
}
