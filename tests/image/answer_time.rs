//! The answer time of the release image: from the request's last bit but one to the transmit request, in core cycles.

use canopen_node::Frame as NodeFrame;
use lss_master::InquireAddress;

use crate::rig::*;

/// The limit for an answer, except to store configuration, in core cycles.
const ANSWER_CYCLES: u64 = 480;
/// The limit for a boot-up caused by a request or a command: the filters change with the node-ID.
const BOOT_UP_CYCLES: u64 = 2_100;
/// The limit for an SDO upload, which searches the object dictionary.
const SDO_CYCLES: u64 = 900;
/// The limit for the answer to store configuration if there is nothing to write: 15 us.
const UNCHANGED_STORE_CYCLES: u64 = 15 * CORE_MHZ;
/// The limits for the first three if reads of the flash have wait states.
const WITH_WAITS: [u64; 3] = [640, 3_200, 1_250];
/// The limit for the CPU load of a 1 Mbit/s bus that is full of requests.
const MOST_LOAD_PERCENT: u64 = 10;
/// The time-out of a fast master.
const MASTER_TIMEOUT: Time = Time::from_ms(20);

/// The time at which a frame that ends at `end` is valid for a receiver: the sample of its last bit but one, at 7/8 of it.
pub fn valid(rig: &ImageRig, end: Time) -> Time {
    end.saturating_sub(Time::from_ps(rig.bit_time().as_ps() * 9 / 8))
}

/// Core cycles between two times.
pub fn cycles(from: Time, to: Time) -> u64 {
    to.saturating_sub(from).as_ps() * CORE_MHZ / 1_000_000
}

/// Core cycles from the time at which `request` is valid to the board's request to transmit the answer.
fn cycles_to_answer(rig: &mut ImageRig, request: &NodeFrame) -> u64 {
    let end = rig.transmit(on_the_wire(request));
    rig.collect(MASTER_TIMEOUT);
    let valid = valid(rig, end);
    let (time, _) = rig.requested(0, valid).next().expect("an answer");
    cycles(valid, time)
}

/// The same for the answer that begins with `command`, regardless of other frames.
fn cycles_to(rig: &mut ImageRig, request: &str, command: u8) -> u64 {
    let end = rig.transmit_request(request);
    rig.collect(Time::from_ms(3));
    let valid = valid(rig, end);
    let is_answer = |frame: &Frame| frame.id == Id::Standard(0x7E4) && frame.data[0] == command;
    let (time, _) = rig.requested(0, valid).find(|(_, frame)| is_answer(frame)).expect("an answer");
    cycles(valid, time)
}

#[test]
fn every_lss_answer_but_the_one_to_store_takes_less_than_3_us() {
    let rig = rig_with(settings(0xFF, BitRate::Kbit1000));
    for (name, cycles) in check_answers(rig, [ANSWER_CYCLES, BOOT_UP_CYCLES, SDO_CYCLES]) {
        println!("{name:30} {cycles:5} cycles, {:4.1} us", cycles as f64 / CORE_MHZ as f64);
    }
}

#[test]
fn with_wait_states_of_the_flash_each_of_them_takes_less_than_4_us() {
    let waits = chip(ChipVariant { flash_waits: true, ..ChipVariant::default() });
    let answers = check_answers(rig_of(waits, settings(0xFF, BitRate::Kbit1000)), WITH_WAITS);
    let of_lss = answers.iter().take_while(|(name, _)| *name != "waiting, first boot-up");
    let worst = of_lss.map(|(_, cycles)| cycles).max().expect("answers");
    println!("{:30} {worst:5} cycles at most", "LSS answers with wait states");
}

/// The time of each answer, which is compared with the limits for an LSS answer, a boot-up and an SDO upload.
fn check_answers(
    mut rig: ImageRig,
    [answer, boot_up, upload]: [u64; 3],
) -> Vec<(&'static str, u64)> {
    rig.lss("04 01");
    let address: [u32; 4] = rig.carry_out(InquireAddress::new()).into();
    let [vendor, product, revision, serial] = address.map(frames::number);
    rig.lss("04 00");
    let select = format!("40 {vendor}, 41 {product}, 42 {revision}, 43 {serial}");
    let revisions = format!("48 {revision}, 49 {revision}");
    let identify = format!("46 {vendor}, 47 {product}, {revisions}, 4A {serial}, 4B {serial}");
    // Only the last request of a text is answered.
    let answers = [
        ("identify non-configured", "4C", answer),
        ("Fastscan, begin", "51 00 00 00 00 80", answer),
        ("Fastscan, step", "51 00 00 00 00 1F", answer),
        ("switch state selective", &select, answer),
        ("identify remote slave", &identify, answer),
        ("configure node-ID", "11 04", answer),
        ("configure node-ID, refused", "11 00", answer),
        ("configure bit timing", "13 00 02", answer),
        ("configure bit timing, refused", "13 00 05", answer),
        ("inquire vendor-ID", "5A", answer),
        ("inquire product code", "5B", answer),
        ("inquire revision number", "5C", answer),
        ("inquire serial number", "5D", answer),
        ("inquire node-ID", "5E", answer),
        ("waiting, first boot-up", "04 00", boot_up),
        ("NMT reset communication", "000: 82 00", boot_up),
        ("SDO upload of the vendor-ID", "604: 40 18 10 01 00 00 00 00", upload),
    ];
    let measure = |(name, requests, most): (&'static str, &str, u64)| {
        let (before, last) = requests.rsplit_once(", ").unwrap_or(("", requests));
        if !before.is_empty() {
            assert_eq!(rig.lss(before), SILENCE);
        }
        let cycles = cycles_to_answer(&mut rig, &frames::of_master(last));
        assert!(cycles < most, "{name}: {cycles} cycles");
        (name, cycles)
    };
    answers.map(measure).into()
}

#[test]
fn store_configuration_is_answered_within_20_ms_even_by_the_slowest_flash() {
    for (timing, most) in [(Timing::Typical, Time::from_ms(1)), (Timing::Worst, Time::from_ms(2))] {
        let mut rig = node_40(0);
        rig.network.board(0).chip().flash_mut().set_timing(timing);
        rig.lss("04 01, 11 04");
        let cycles = cycles_to_answer(&mut rig, &frames::request("17"));
        let time = Time::from_ns(cycles * 1_000 / CORE_MHZ);
        println!("store, {timing:?} flash: {cycles} cycles, {time} ms");
        assert!(time < most, "{time}");
        let cycles = cycles_to_answer(&mut rig, &frames::request("17"));
        println!("store of unchanged settings: {cycles} cycles");
        assert!(cycles < UNCHANGED_STORE_CYCLES);
    }
}

#[test]
fn an_answer_takes_as_long_in_every_nmt_state() {
    let mut rig = node_40(0);
    rig.lss("04 01");
    for (state, command) in
        [("pre-operational", "80 40"), ("operational", "01 40"), ("stopped", "02 40")]
    {
        rig.nmt(command);
        let spans = (0..50).map(|_| cycles_to(&mut rig, "5A", 0x5A));
        let worst = spans.max().expect("there are fifty");
        println!("{state:30} {worst:5} cycles at most");
        // A tick may be under way.
        assert!(worst < 2 * ANSWER_CYCLES, "{state}: {worst} cycles");
    }
}

#[test]
fn a_store_delays_an_answer_by_at_most_two_words_of_the_slowest_flash() {
    const WORD_US: u64 = 100;
    let mut worst = 0;
    for node_id in 1..=20 {
        let mut rig = node_40(0);
        rig.network.board(0).chip().flash_mut().set_timing(Timing::Worst);
        rig.lss(&format!("04 01, 11 {node_id:02X}"));
        rig.transmit_request("17");
        let still_stores =
            |rig: &mut ImageRig| rig.requested(0, Time::ZERO).all(|(_, f)| f.data[0] != 0x17);
        rig.network.run_for(Time::from_us(10 * node_id));
        assert!(still_stores(&mut rig));
        worst = worst.max(cycles_to(&mut rig, "5A", 0x5A));
    }
    println!("{:30} {worst:5} cycles at most", "during a store");
    assert!(worst < ANSWER_CYCLES + 2 * WORD_US * CORE_MHZ, "{worst} cycles");
}

const REQUESTS: &str = "04 01, 5A, 5B, 5C, 5D, 5E";

/// The answers, by their first bytes.
fn command_specifiers(answers: &Frames) -> Vec<u8> {
    let of_lss = answers.0.iter().filter(|frame| frame.cob_id() == 0x7E4);
    of_lss.map(|frame| frame.data()[0]).collect()
}

#[test]
fn six_requests_back_to_back_are_answered_in_order_on_a_full_bus() {
    let mut random = Random::from_environment();
    let mut rig = node_40(7);
    let other = rig.network.add_adapter(Adapter::new(1_000_000));
    let (mut sent, mut sdo_requests, mut sdo_answers) = (0, 0, 0);
    for _ in 0..50 {
        rig.send(REQUESTS);
        rig.send("04 00");
        // Bursts of urgent frames, some to the node, with gaps that are too short for a frame or just long enough.
        for _ in 0..40 {
            for _ in 0..random.within(1..6) {
                let cob_id = random.pick(&[0x001, 0x080, 0x640, 0x7E3]);
                let mut data = random.bytes::<8>();
                if cob_id == 0x640 {
                    data = [0x40, 0, 0x10, 0, 0, 0, 0, 0];
                    sdo_requests += 1;
                }
                rig.network.send(other, Frame::data(Id::Standard(cob_id), &data));
                sent += 1;
            }
            while rig.network.adapter_mut(other).unsent() > 0 {
                rig.network.run_for(Time::from_us(10));
            }
            rig.network.run_for(Time::from_us(random.within(0..150)));
        }
        let answers = rig.collect(Time::from_ms(3));
        assert_eq!(command_specifiers(&answers), [0x5A, 0x5B, 0x5C, 0x5D, 0x5E]);
        sdo_answers += answers.0.iter().filter(|frame| frame.cob_id() == 0x5C0).count();
    }
    assert_eq!(sdo_answers, sdo_requests);
    let urgent = rig.sent(Time::ZERO).filter(|sent| sent.by == Source::Adapter(other));
    assert_eq!(urgent.count(), sent);
}

#[test]
fn requests_right_behind_a_change_of_the_node_id_are_not_lost() {
    let mut rig = rig_with(settings(0xFF, BitRate::Kbit1000));
    for node_id in 1..=20 {
        let configure = format!("04 01, 11 {node_id:02X}, 04 00, 04 01, 5E, 11 FF, 04 00");
        rig.send(&configure);
        rig.send("000: 82 00");
        let sent = rig.collect(Time::from_ms(5)).0;
        let text: Vec<_> = sent.iter().map(frames::text).collect();
        assert!(text.contains(&format!("{:03X}: 00", 0x700 + node_id)), "{text:#?}");
        assert!(text.contains(&format!("7E4: 5E {node_id:02X} 00 00 00 00 00 00")), "{text:#?}");
        assert_eq!(rig.lss("4C"), ["50"]);
    }
}

#[test]
fn a_board_that_has_to_answer_every_frame_of_a_full_bus_loses_none() {
    let boards = [1, 2].map(|number| board_with(number, settings(number, BitRate::Kbit1000)));
    let mut rig = ImageRig::new(BitRate::Kbit1000, boards);
    rig.collect(MASTER_TIMEOUT);
    rig.lss("04 01");
    let from = rig.network.now();
    let (cycles_before, busy_before) = rig.network.board(0).cycles();
    const REQUESTS: usize = 500;
    (0..REQUESTS).for_each(|_| rig.send("11 80"));
    rig.send_all();
    let (cycles, busy) = rig.network.board(0).cycles();
    let load = (busy - busy_before) * 100 / (cycles - cycles_before);
    println!("{:30} {load:5} % of the CPU", "a full bus, all to be answered");
    assert!(load < MOST_LOAD_PERCENT, "{load} %");
    rig.collect(Time::from_ms(3));
    for board in [0, 1] {
        assert_eq!(rig.requested(board, from).count(), REQUESTS);
    }
}

#[test]
fn a_node_boots_up_within_5_ms_even_with_a_full_bank_of_settings() {
    // Three records of the defaults, these, and eight places that are kept for starts.
    let stores: Vec<_> =
        (0..398_u16).map(|n| settings(1 + (n % 2) as u8, BitRate::Kbit1000)).collect();
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board_with_flash(&flash_with(&stores))]);
    rig.collect(Time::from_ms(20));
    rig.network.allow_reset(0, ResetCause::Software);
    let from = rig.transmit_command("81 00");
    rig.collect(Time::from_ms(20));
    let reset = |event: &&Event| event.what == What::Reset(ResetCause::Software);
    let reset = rig.did(0, from).find(reset).expect("a reset").time;
    let (time, boot_up) = rig.requested(0, reset).next().expect("a boot-up");
    assert_eq!(boot_up, Frame::data(Id::Standard(0x702), &[0]));
    println!("boot-up {} ms after a reset", time - reset);
    assert!(time - reset < Time::from_ms(5));
}
