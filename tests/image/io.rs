//! Tests of the release image with the example application `io`: its objects, PDOs, parameters and times.
//!
//! `cargo test --test image io:: -- --nocapture` prints the times.

use std::ops::Range;

use emulator::chip::Part;
use testkit::{
    image::{self, example},
    io_board, stack,
};

use crate::{
    answer_time::{cycles, valid},
    rig::*,
};

/// The limit for a TPDO after the change of its value, or after its SYNC, in core cycles: 20 us.
const TPDO_CYCLES: u64 = 20 * CORE_MHZ;
/// The limit for the work of a SYNC with its four TPDOs, in core cycles.
const ROUND_CYCLES: u64 = 3_600;
/// The limit for the value of an RPDO in the application, in core cycles: 10 us.
const RPDO_CYCLES: u64 = 10 * CORE_MHZ;
/// The limit for an LSS answer of this image, in core cycles, if no other interrupt is served before.
const ANSWER_CYCLES: u64 = 640;
/// The same for an SDO upload, which searches the object dictionary.
const SDO_CYCLES: u64 = 3_000;
/// The limit for the other interrupts of the node that are served before, in core cycles.
const INTERRUPT_CYCLES: u64 = 20 * CORE_MHZ;
/// The limit for the use of the stack: five eighths of what there is. The node is made on the stack.
const MOST_STACK: usize = 10 * 1024;
/// The application samples its inputs at this interval.
const SAMPLE: Time = Time::from_ms(10);
/// More than the time from a change of an input to the end of its TPDO.
const SOON: Time = Time::from_ms(12);

/// Node 1 at 1 Mbit/s on an STM32F407, in NMT pre-operational, after its boot-up.
fn node_1() -> ImageRig {
    let board = example_board(settings(1, BitRate::Kbit1000));
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    assert_eq!(rig.collect(Time::from_ms(50)), ["701: 00"]);
    rig
}

/// The same in NMT operational, after its first TPDOs.
fn operational() -> ImageRig {
    let mut rig = node_1();
    let sent = rig.nmt("01 01");
    assert_eq!(of(0x181, &sent), ["181: 00"]);
    rig.collect(Time::from_ms(100));
    rig
}

fn of(cob_id: u16, frames: &Frames) -> Frames {
    Frames(frames.0.iter().filter(|frame| frame.cob_id() == cob_id).copied().collect())
}

fn press(rig: &ImageRig, is_pressed: bool) {
    io_board::press(rig.network.board(0), is_pressed);
}

fn leds(rig: &ImageRig) -> [bool; 2] {
    io_board::leds(rig.network.board(0))
}

fn set_temperature(rig: &ImageRig, celsius: i32) {
    io_board::set_temperature(rig.network.board(0), celsius);
}

fn data(cob_id: u16, data: &[u8]) -> Frame {
    Frame::data(Id::Standard(cob_id), data)
}

/// Writes objects of node 1.
fn write(rig: &mut ImageRig, requests: &[&str]) {
    for request in requests {
        rig.transmit(on_the_wire(&sdo::request(1, request)));
        let answers = of(0x581, &rig.collect(Time::from_ms(20)));
        assert!(matches!(answers.0[..], [answer] if answer.data()[0] == 0x60), "{request}");
    }
}

fn read(rig: &mut ImageRig, index: u16, sub_index: u8) -> u32 {
    rig.sdo_client(1).number(index, sub_index)
}

/// Lets node 1 send, or receive, these values in a PDO, whose parameters are at `index`.
fn map_pdo(rig: &mut ImageRig, index: u16, cob_id: u32, mapped: &[u32]) {
    let mut client = rig.sdo_client(1);
    let mut write = |index: u16, sub_index, data: &[u8]| {
        client.download(index, sub_index, data).expect("it is written");
    };
    write(index, 1, &(1 << 31 | cob_id).to_le_bytes());
    write(index + 0x200, 0, &[0]);
    for (sub_index, entry) in (1..).zip(mapped) {
        write(index + 0x200, sub_index, &entry.to_le_bytes());
    }
    write(index + 0x200, 0, &[mapped.len() as u8]);
    write(index, 1, &cob_id.to_le_bytes());
}

/// The temperature and the values of the echo test as entries of a mapping, and four bytes without effect.
const ECHO_SENT: u32 = 0x2103_0108;
const ECHO_RETURNED: u32 = 0x2103_0208;
const TEMPERATURE: u32 = 0x6401_0110;
const DUMMY_32: u32 = 0x0007_0020;

/// Makes node 1 echo RPDO 1 by TPDO 1: they carry the values of the echo test 2103h in place of the LEDs and the button.
fn echo(rig: &mut ImageRig) {
    map_pdo(rig, 0x1400, 0x201, &[ECHO_SENT]);
    map_pdo(rig, 0x1800, 0x181, &[ECHO_RETURNED]);
}

#[test]
fn the_button_is_sent_and_the_leds_are_received() {
    check_button_and_leds(operational());
}

fn check_button_and_leds(mut rig: ImageRig) {
    for (is_pressed, pdo) in [(true, "181: 01"), (false, "181: 00")] {
        press(&rig, is_pressed);
        assert_eq!(of(0x181, &rig.collect(SOON)), [pdo]);
        assert_eq!(of(0x181, &rig.collect(Time::from_ms(100))), SILENCE);
    }
    // There are two LEDs. One PDO is too short and has no effect; of one that is too long the first byte counts.
    for (outputs, expected) in [
        (&[1][..], [true, false]),
        (&[], [true, false]),
        (&[2, 9], [false, true]),
        (&[4], [false, true]),
        (&[3], [true; 2]),
        (&[0], [false; 2]),
    ] {
        rig.transmit(data(0x201, outputs));
        rig.network.run_for(SOON);
        assert_eq!(leds(&rig), expected, "{outputs:?}");
    }
    assert_eq!(rig.sdo_client(1).download(0x6200, 1, &[4]), Err(0x0609_0030));
    rig.nmt("80 01");
    press(&rig, true);
    rig.transmit(data(0x201, &[3]));
    assert_eq!(rig.collect(Time::from_ms(100)), SILENCE);
    assert_eq!(leds(&rig), [false; 2]);
    assert_eq!(of(0x181, &rig.nmt("01 01")), ["181: 01"]);
}

/// The temperatures that were sent, in 0.1 degrees.
fn temperatures(frames: &Frames) -> Vec<i16> {
    let of_tpdo = of(0x281, frames);
    of_tpdo.0.iter().map(|frame| i16::from_le_bytes([frame.data()[0], frame.data()[1]])).collect()
}

#[test]
fn the_temperature_is_sent_with_its_delta_and_its_event_timer() {
    let mut rig = node_1();
    // No filter; a delta of 10 degrees.
    write(&mut rig, &["2F 00 21 00 00", "23 26 64 01 64 00 00 00"]);
    rig.nmt("01 01");
    set_temperature(&rig, 40);
    let [at_40] = temperatures(&rig.collect(SOON))[..] else { panic!("one TPDO") };
    assert!((395..=405).contains(&at_40), "{at_40}");
    let sent_at = rig.network.now();
    set_temperature(&rig, 45);
    assert!(temperatures(&rig.collect(Time::from_ms(900))).is_empty());
    let (sent_again, _) = rig.next_frame();
    let span = sent_again.saturating_sub(sent_at);
    assert!(Time::from_ms(980) < span && span < Time::from_ms(1_002), "{span}");
    set_temperature(&rig, 55);
    let [at_55] = temperatures(&rig.collect(SOON))[..] else { panic!("one TPDO") };
    assert!((540..=560).contains(&at_55), "{at_55}");
}

#[test]
fn a_larger_filter_constant_slows_the_temperature() {
    let times = ["2F 00 21 00 00", "2F 00 21 00 06"].map(|request| {
        let mut rig = operational();
        write(&mut rig, &[request]);
        set_temperature(&rig, 45);
        let from = rig.network.now();
        while read(&mut rig, 0x6401, 1) < 400 {
            assert!(rig.network.now() < from + Time::from_s(10));
        }
        rig.network.now() - from
    });
    assert!(times[0] < Time::from_ms(60) && times[1] > Time::from_ms(500), "{times:?}");
}

/// An acknowledge that is lost would end all emergency messages: the next one waits for it.
#[test]
fn a_message_that_ends_while_another_frame_is_written_is_acknowledged() {
    const PERIOD: Time = Time::from_ms(10);
    let mut rig = node_1();
    write(&mut rig, &["2B 17 10 00 0A 00"]);
    rig.nmt("01 01");
    // Messages about an RPDO that is too short, and about the next one, which is not.
    let mut takes = Time::from_us(300);
    for step in 0..64 {
        let heartbeat = |rig: &ImageRig, from| {
            let is_it = |(_, frame): &(Time, Frame)| frame.id == Id::Standard(0x701);
            rig.requested(0, from).find(is_it).map(|(time, _)| time)
        };
        let from = rig.network.now();
        rig.collect(PERIOD);
        let before = heartbeat(&rig, from).expect("a heartbeat in each period");
        // The message ends within the 8 us before the next heartbeat is written.
        let end = before + PERIOD + PERIOD;
        let begin = (end + Time::from_ns(125 * step)).saturating_sub(Time::from_us(8) + takes);
        rig.network.run_until(begin);
        rig.network.send(rig.master, data(0x201, &[]));
        rig.collect(Time::from_ms(2));
        let message = rig.sent_by_boards(begin).find(|sent| sent.frame.id == Id::Standard(0x081));
        takes = message.expect("a message").end.saturating_sub(begin);
        rig.network.send(rig.master, data(0x201, &[0]));
        assert_eq!(of(0x081, &rig.collect(PERIOD)), ["081: 00 00 00 00 00 00 00 00"], "{step}");
    }
}

/// The cycles in which the core is awake during 200 ms with a bus full of frames of these COB-IDs.
fn busy_cycles(rig: &mut ImageRig, other: AdapterId, cob_ids: &[u16]) -> u64 {
    rig.collect(SAMPLE);
    let (_, before) = rig.network.board(0).cycles();
    let until = rig.network.now() + Time::from_ms(200);
    while rig.network.now() < until {
        while rig.network.adapter_mut(other).unsent() < 20 && !cob_ids.is_empty() {
            cob_ids.iter().for_each(|&cob_id| rig.network.send(other, data(cob_id, &[0])));
        }
        rig.network.run_for(Time::from_us(500));
    }
    let (_, after) = rig.network.board(0).cycles();
    after - before
}

#[test]
fn moved_cob_ids_are_received_and_all_others_cost_no_interrupt() {
    let mut rig = node_1();
    let moved = [
        "23 00 14 01 01 02 00 80",
        "23 00 14 01 21 03 00 00",
        "23 05 10 00 99 00 00 00",
        "2F 00 18 02 01",
    ];
    write(&mut rig, &moved);
    let other = rig.network.add_adapter(Adapter::new(1_000_000));
    rig.nmt("01 01");
    for (sync, sent) in [(0x080, &SILENCE[..]), (0x099, &["181: 00"])] {
        rig.transmit(data(sync, &[]));
        assert_eq!(of(0x181, &rig.collect(Time::from_ms(1))), sent);
    }
    for (rpdo, expected) in [(0x201, [false; 2]), (0x321, [true; 2])] {
        rig.transmit(data(rpdo, &[3]));
        rig.network.run_for(SOON);
        assert_eq!(leds(&rig), expected);
    }
    // The master listens only.
    let idle = busy_cycles(&mut rig, other, &[]);
    let foreign = busy_cycles(&mut rig, other, &[0x201, 0x080, 0x320, 0x322, 0x098, 0x182, 0x709]);
    let own = busy_cycles(&mut rig, other, &[0x321]);
    println!("awake in 200 ms: idle {idle}, foreign frames {foreign}, RPDOs {own} cycles");
    // The samples of the application empty the FIFO that shows that there is traffic.
    assert!(foreign < idle + idle / 5, "{foreign}, idle {idle}");
    assert!(own > 10 * idle, "{own}, idle {idle}");
}

fn note(what: &str, spans: &[u64], most: u64) {
    let (least, worst) = (spans.iter().min().unwrap(), spans.iter().max().unwrap());
    let us = *worst as f64 / CORE_MHZ as f64;
    println!("{what:44} {least:5} to {worst:5} cycles, {us:4.1} us at most");
    assert!(*worst < most, "{what}: {worst} cycles");
}

/// The same for spans of which a few wait for another interrupt of the node, by at most `delay`.
fn note_most(what: &str, spans: &mut [u64], most: u64, delay: u64) {
    spans.sort_unstable();
    note(what, spans, most + delay);
    let (usual, _) = spans.split_at(spans.len() * 9 / 10);
    note("  nine of ten", usual, most);
}

/// The first transmission request of this COB-ID since `since`.
fn requested(rig: &ImageRig, cob_id: u16, since: Time) -> (Time, Frame) {
    let mut all = rig.requested(0, since).filter(|(_, frame)| frame.id == Id::Standard(cob_id));
    all.next().unwrap_or_else(|| panic!("{cob_id:03X} is not sent"))
}

/// The RAM above the stack, where all variables are.
fn variables(rig: &ImageRig) -> Vec<u8> {
    let mut bytes = vec![0; 0x1000];
    let start = stack::stack(example()).end;
    assert!(rig.network.board(0).read_memory(start, &mut bytes), "it is RAM");
    bytes
}

/// The offsets of the variables that are equal to each value after it was set.
fn find(rig: &mut ImageRig, values: &[u8], mut set: impl FnMut(&mut ImageRig, u8)) -> Vec<usize> {
    let mut places: Vec<_> = (0..0x1000).collect();
    for &value in values {
        set(rig, value);
        rig.network.run_for(SOON);
        let bytes = variables(rig);
        places.retain(|&place| bytes[place] == value);
    }
    assert!((1..=8).contains(&places.len()), "{places:?}");
    places
}

/// The time, to 50 ns, at which the first of these variables has the value.
fn first_change(rig: &mut ImageRig, places: &[usize], value: u8, within: Time) -> Time {
    let until = rig.network.now() + within;
    let start = stack::stack(example()).end;
    while rig.network.now() < until {
        rig.network.run_for(Time::from_ns(50));
        for &place in places {
            let mut byte = [0];
            assert!(rig.network.board(0).read_memory(start + place as u32, &mut byte));
            if byte[0] == value {
                return rig.network.now();
            }
        }
    }
    panic!("the value does not come");
}

#[test]
fn a_tpdo_follows_the_change_of_its_value_within_20_us() {
    let mut rig = operational();
    let places = find(&mut rig, &[1, 0, 1, 0, 1, 0], |rig, value| press(rig, value == 1));
    press(&rig, true);
    let from = rig.network.now();
    rig.network.run_for(SOON);
    let (mut sampled, _) = requested(&rig, 0x181, from);
    let mut spans = Vec::new();
    for value in [0, 1].into_iter().cycle().take(20) {
        press(&rig, value == 1);
        while sampled <= rig.network.now() + Time::from_us(100) {
            sampled += SAMPLE;
        }
        rig.network.run_until(sampled.saturating_sub(Time::from_us(60)));
        let changed = first_change(&mut rig, &places, value, Time::from_us(120));
        rig.network.run_for(Time::from_us(50));
        let (time, _) = requested(&rig, 0x181, changed.saturating_sub(Time::from_us(1)));
        spans.push(cycles(changed, time));
    }
    note("TPDO after the change of its value", &spans, TPDO_CYCLES);
}

#[test]
fn a_tpdo_follows_its_sync_within_20_us() {
    let mut rig = node_1();
    write(&mut rig, &["2F 00 18 02 01"]);
    rig.nmt("01 01");
    let mut random = Random::from_environment();
    let mut spans: Vec<_> = (0..100)
        .map(|_| {
            rig.network.run_for(Time::from_us(random.within(500..9_000)));
            let end = rig.transmit(data(0x080, &[]));
            rig.network.run_for(Time::from_us(200));
            let valid = valid(&rig, end);
            cycles(valid, requested(&rig, 0x181, valid).0)
        })
        .collect();
    note_most("TPDO after SYNC", &mut spans, TPDO_CYCLES, INTERRUPT_CYCLES);
}

#[test]
fn a_sync_and_its_four_tpdos_cost_few_cycles() {
    const ROUNDS: u64 = 200;
    /// No divisor of the 10 ms between two looks at the inputs: a round has the same share of them whenever it begins.
    const INTERVAL: Time = Time::from_us(1_037);
    let mut rig = node_1();
    // TPDOs 3 and 4 carry the echo and the temperature, 1 and 2 the button and the temperature.
    for (index, cob_id) in [(0x1802, 0x381), (0x1803, 0x481)] {
        map_pdo(&mut rig, index, cob_id, &[ECHO_RETURNED, TEMPERATURE]);
    }
    for index in 0x1800..0x1804 {
        rig.sdo_client(1).download(index, 2, &[1]).expect("it is written");
    }
    rig.nmt("01 01");
    let [without, with] = [false, true].map(|has_sync| {
        let from = rig.network.now();
        let (_, before) = rig.network.board(0).cycles();
        for _ in 0..ROUNDS {
            if has_sync {
                rig.network.send(rig.master, data(0x080, &[]));
            }
            rig.network.run_for(INTERVAL);
        }
        let sent = if has_sync { 4 * ROUNDS } else { 0 };
        assert_eq!(rig.requested(0, from).count() as u64, sent);
        rig.network.board(0).cycles().1 - before
    });
    let cycles = (with - without) / ROUNDS;
    println!("{:40} {cycles:5} cycles", "SYNC and four TPDOs");
    assert!(cycles < ROUND_CYCLES, "{cycles}");
}

#[test]
fn an_rpdo_reaches_the_application_within_10_us() {
    let mut rig = operational();
    let places = find(&mut rig, &[1, 2, 0, 3, 1, 0, 2, 3, 0, 1], |rig, value| {
        rig.transmit(data(0x201, &[value]));
    });
    let mut spans = Vec::new();
    for value in [2, 0, 3, 1].into_iter().cycle().take(50) {
        rig.network.send(rig.master, data(0x201, &[value]));
        let changed = first_change(&mut rig, &places, value, Time::from_us(200));
        rig.network.run_for(Time::from_us(20));
        let of_master = |sent: &Sent| sent.by == Source::Adapter(rig.master);
        let end = rig.sent(Time::ZERO).filter(of_master).last().expect("the RPDO").end;
        spans.push(cycles(valid(&rig, end), changed));
        rig.network.run_for(Time::from_us(311));
    }
    note("RPDO to the first variable in RAM", &spans, RPDO_CYCLES);

    // A TPDO that echoes the value is requested only after the value is in the application.
    rig.nmt("80 01");
    echo(&mut rig);
    rig.nmt("01 01");
    let mut spans = Vec::new();
    for value in [2, 0, 3, 1].into_iter().cycle().take(50) {
        let end = rig.transmit(data(0x201, &[value]));
        rig.network.run_for(Time::from_us(311));
        let valid = valid(&rig, end);
        let (time, echo) = requested(&rig, 0x181, valid);
        assert_eq!(echo.payload(), [value]);
        spans.push(cycles(valid, time));
    }
    note("RPDO to the TPDO that echoes it", &spans, TPDO_CYCLES);
}

#[test]
fn lss_answers_of_the_example_take_less_than_4_us() {
    let mut rig = operational();
    rig.lss("04 01");
    let inquiries = ["5A", "5B", "5C", "5D", "5E", "11 01", "11 00", "13 00 02", "13 00 05"];
    let span = |rig: &mut ImageRig, request, cob_id| {
        let end = rig.transmit(on_the_wire(&request));
        rig.network.run_for(Time::from_us(300));
        let valid = valid(rig, end);
        cycles(valid, requested(rig, cob_id, valid).0)
    };
    let mut spans = Vec::new();
    for request in inquiries.into_iter().cycle().take(90) {
        spans.push(span(&mut rig, frames::request(request), 0x7E4));
        rig.network.run_for(Time::from_us(511));
    }
    note_most("LSS answer", &mut spans, ANSWER_CYCLES, INTERRUPT_CYCLES);
    let mut spans = Vec::new();
    for request in ["40 18 10 01", "40 00 21 00", "40 26 64 01"].into_iter().cycle().take(30) {
        spans.push(span(&mut rig, sdo::request(1, request), 0x581));
        rig.network.run_for(Time::from_us(511));
    }
    note_most("SDO upload", &mut spans, SDO_CYCLES, INTERRUPT_CYCLES);
}

/// What was stored becomes the persistent values of the node, while its controller has room for three frames.
#[test]
fn the_end_of_a_save_of_all_pdos_delays_an_lss_answer_by_less_than_20_us() {
    let mut rig = node_1();
    for (index, cob_id) in (0..4).zip((1..).step_by(0x100)) {
        map_pdo(&mut rig, 0x1400 + index, 0x200 + cob_id, &[ECHO_SENT; 8]);
        map_pdo(&mut rig, 0x1800 + index, 0x180 + cob_id, &[ECHO_RETURNED; 8]);
    }
    rig.lss("04 01");
    let save = |rig: &mut ImageRig| {
        rig.collect(Time::from_ms(20));
        rig.transmit(on_the_wire(&sdo::request(1, "23 10 10 01 73 61 76 65")))
    };
    let end = save(&mut rig);
    rig.collect(Time::from_ms(20));
    let whole = requested(&rig, 0x581, end).0 - end;
    let before = |us: u64| Time::from_us(100 + us);
    let mut spans = Vec::new();
    for us in (0..200).step_by(10) {
        // As long a record again: the heartbeat time.
        write(&mut rig, &[&format!("2B 17 10 00 00 {us:02X}")]);
        let end = save(&mut rig);
        rig.network.run_for(end + whole - before(us) - rig.network.now());
        let end = rig.transmit_request("5A");
        rig.collect(Time::from_ms(20));
        let valid = valid(&rig, end);
        spans.push(cycles(valid, requested(&rig, 0x7E4, valid).0));
    }
    note("LSS answer at the end of a save", &spans, ANSWER_CYCLES + INTERRUPT_CYCLES);
}

/// Node 1 is operational, echoes its RPDO by TPDO 1, sends TPDO 2 at each SYNC, and a heartbeat every 7 ms.
fn busy_node() -> ImageRig {
    let mut rig = node_1();
    echo(&mut rig);
    write(&mut rig, &["2F 01 18 02 01", "2B 17 10 00 07 00"]);
    rig.nmt("01 01");
    rig.collect(SAMPLE);
    rig
}

/// The same with four PDOs each way: TPDOs 1, 3 and 4 echo all RPDOs.
fn busier_node() -> ImageRig {
    let mut rig = busy_node();
    rig.nmt("80 01");
    for (index, cob_id) in [(0x1401, 0x301), (0x1402, 0x401), (0x1403, 0x501)] {
        map_pdo(&mut rig, index, cob_id, &[ECHO_SENT, DUMMY_32]);
    }
    for (index, cob_id) in [(0x1802, 0x381), (0x1803, 0x481)] {
        map_pdo(&mut rig, index, cob_id, &[ECHO_RETURNED, TEMPERATURE]);
    }
    rig.nmt("01 01");
    rig.collect(SAMPLE);
    rig
}

#[test]
fn lss_answers_keep_their_time_while_pdos_fill_the_bus() {
    fill_the_bus(busy_node(), &[0x201], 5..20, 300);
}

#[test]
fn lss_answers_keep_their_time_with_four_pdos_each_way_on_a_full_bus() {
    fill_the_bus(busier_node(), &[0x201, 0x301, 0x401, 0x501], 1..3, 450);
}

/// Fills the bus with bursts of SYNC and these RPDOs, which the node echoes, and measures the answers of LSS. Its
/// PDOs may delay them by `most_us`.
fn fill_the_bus(mut rig: ImageRig, rpdo_cob_ids: &[u16], bursts: Range<u64>, most_us: u64) {
    const ROUNDS: usize = 300;
    let mut random = Random::from_environment();
    let (other, filler) = (
        rig.network.add_adapter(Adapter::new(1_000_000)),
        rig.network.add_adapter(Adapter::new(1_000_000)),
    );
    rig.lss("04 01");
    let from = rig.network.now();
    let mut value = 0_u8;
    let (mut rpdos, mut syncs) = (0, 0);
    for _ in 0..ROUNDS {
        // SYNC and RPDOs back to back; frames of others fill the rest of the bus.
        rig.network.send(other, data(0x080, &[]));
        syncs += 1;
        for _ in 0..random.within(bursts.clone()) {
            for &cob_id in rpdo_cob_ids {
                value = (value + 1) % 4;
                let len = if cob_id == 0x201 { 1 } else { 5 };
                rig.network.send(other, data(cob_id, &[value, 0, 0, 0, 0][..len]));
            }
            rpdos += rpdo_cob_ids.len();
        }
        let request = random.pick(&["5A", "5B", "5C", "5D", "5E"]);
        rig.queue(&frames::request(request));
        let until = rig.network.now() + Time::from_us(random.within(2_500..4_000));
        while rig.network.now() < until {
            while rig.network.adapter_mut(filler).unsent() < 5 {
                rig.network.send(filler, data(0x7F0, &[0x5A]));
            }
            rig.network.run_for(Time::from_us(100));
        }
    }
    let until = rig.network.now();
    let load = rig.bus_load(from..until);
    rig.network.run_for(Time::from_ms(5));

    let (mut at_once, mut waited, mut request_end) = (Vec::new(), Vec::new(), None);
    let (mut echoes, mut by_sync, mut in_mailboxes, mut has_pending) =
        (Vec::new(), 0, 0_usize, false);
    for event in rig.network.trace() {
        let is_own = event.source == Source::Board(0);
        match &event.what {
            What::Frame { frame, .. } => {
                in_mailboxes -= usize::from(is_own);
                match frame.id {
                    Id::Standard(0x7E5) if event.time > from => {
                        (request_end, has_pending) = (Some(event.time), in_mailboxes > 0);
                    }
                    Id::Standard(0x081) => panic!("an emergency message: {frame}"),
                    Id::Standard(0x181) if event.time > from => echoes.push(frame.data[0]),
                    Id::Standard(0x281) if event.time > from => by_sync += 1,
                    _ => {}
                }
            }
            What::Requested { frame, .. } => {
                in_mailboxes += 1;
                if frame.id != Id::Standard(0x7E4) {
                    has_pending = true;
                } else if event.time > from {
                    let end = request_end.take().expect("a request for each answer");
                    let spans = if has_pending { &mut waited } else { &mut at_once };
                    spans.push(cycles(valid(&rig, end), event.time));
                }
            }
            What::Aborted { .. } => in_mailboxes -= 1,
            _ => {}
        }
    }
    println!("{load} % bus load, {rpdos} RPDOs, {} echoes, {syncs} SYNCs", echoes.len());
    // The step of the application compares the values of all TPDOs, and a frame may wait before the request.
    let interrupts = 40 * CORE_MHZ;
    note_most("LSS answer while PDOs fill the bus", &mut at_once, ANSWER_CYCLES, interrupts);
    // The controller gets a frame only if it is more urgent than those of the node that wait for the bus.
    if !waited.is_empty() {
        note("LSS answer behind a PDO of the node", &waited, most_us * CORE_MHZ);
    }
    assert!(at_once.len() > ROUNDS / 10, "{} answers at once", at_once.len());
    assert_eq!((at_once.len() + waited.len(), by_sync), (ROUNDS, syncs));
    assert_eq!(echoes.last(), Some(&value));
    assert!(load > 97, "{load} %");
    let log = log::lines(rig.network.board(0));
    assert!(
        log.iter().all(|line| line.text.starts_with("node-ID") || line.time < from),
        "{log:#?}"
    );
}

#[test]
fn a_minute_of_process_data_needs_no_reset_and_little_stack() {
    let mut board = example_board(settings(1, BitRate::Kbit1000));
    stack::paint(&mut board, example());
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    let mut random = Random::from_environment();
    rig.collect(SAMPLE);
    write(&mut rig, &["2F 01 18 02 01", "2B 17 10 00 64 00", "23 16 10 01 64 00 0A 00"]);
    rig.nmt("01 01");
    let mut is_pressed = false;
    for second in 0..60 {
        for step in 0..25 {
            let outputs = random.byte() & 3;
            rig.network.send(rig.master, data(0x70A, &[5]));
            rig.network.send(rig.master, data(0x080, &[]));
            rig.network.send(rig.master, data(0x201, &[outputs]));
            if step % 5 == 0 {
                is_pressed = !is_pressed;
                press(&rig, is_pressed);
                set_temperature(&rig, random.within(0..80) as i32);
                rig.queue(&sdo::request(1, "40 08 10 00"));
                rig.queue(&sdo::request(1, "60"));
            }
            let sent = rig.collect(Time::from_ms(40));
            assert_eq!(of(0x281, &sent).0.len(), 1, "TPDO 2 at each SYNC");
            assert_eq!(of(0x081, &sent), SILENCE);
            assert_eq!(leds(&rig), [outputs & 1 != 0, outputs & 2 != 0]);
        }
        if second == 30 {
            write(&mut rig, &["23 10 10 01 73 61 76 65"]);
        }
    }
    let depth = stack::deepest(rig.network.board(0), example());
    println!("{depth} bytes of stack");
    assert!((100..=MOST_STACK).contains(&depth), "{depth} bytes");
}

#[test]
#[ignore = "builds the image of another chip: `.ci/run chips`"]
fn the_example_works_on_an_stm32f446() {
    let image = image::build_example("io", Part::Stm32f446).unwrap_or_else(|e| panic!("{e}"));
    let mut board = Board::new(Part::Stm32f446, &image, board::Settings::default());
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings(1, BitRate::Kbit1000)]));
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    assert_eq!(rig.collect(Time::from_ms(50)), ["701: 00"]);
    let sent = rig.nmt("01 01");
    assert_eq!(of(0x181, &sent), ["181: 00"]);
    let [temperature] = temperatures(&sent)[..] else { panic!("one TPDO 2") };
    assert!((245..=255).contains(&temperature), "{temperature}");
    rig.collect(Time::from_ms(100));
    check_button_and_leds(rig);
}
