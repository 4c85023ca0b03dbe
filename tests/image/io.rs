//! Tests of the release image with the example application `io`: its objects, PDOs, parameters and times.
//!
//! `cargo test --test image io:: -- --nocapture` prints the times.

use std::ops::Range;

use canopen_node::BitRate;
use emulator::{
    Time,
    board::{self, Board},
    can::{Adapter, Frame, Id},
    chip::{Part, Pin},
    network::{AdapterId, Event, Source, What},
};
use testkit::{
    frames::{self, Frames, SILENCE},
    image::{self, example},
    image_rig::{
        CORE_MHZ, ImageRig, SETTINGS_OFFSET, example_board, flash_with, on_the_wire, settings,
    },
    io_board,
    random::Random,
    sdo, stack,
};

/// The limit for a TPDO after the change of its value, or after its SYNC, in core cycles: 20 us.
const TPDO_CYCLES: u64 = 20 * CORE_MHZ;
/// The limit for the value of an RPDO in the application, in core cycles: 10 us.
const RPDO_CYCLES: u64 = 10 * CORE_MHZ;
/// The limit for an LSS answer of this image, in core cycles, if no other interrupt is served before.
const ANSWER_CYCLES: u64 = 640;
/// The same for an SDO upload, which searches the object dictionary.
const SDO_CYCLES: u64 = 3_000;
/// The limit for the other interrupts of the node that are served before, in core cycles.
const INTERRUPT_CYCLES: u64 = 20 * CORE_MHZ;
/// The limit for the use of the stack: three quarters of what there is. The node is made on the stack.
const MOST_STACK: usize = 8 * 1024;
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

/// The answer of `node` to an SDO request.
fn ask(rig: &mut ImageRig, node: u8, request: &str) -> [u8; 8] {
    rig.transmit(on_the_wire(&sdo::request(node, request)));
    let answers = of(0x580 + u16::from(node), &rig.collect(Time::from_ms(20)));
    let [answer] = answers.0[..] else { panic!("one answer to {request}, not {answers:?}") };
    answer.data().try_into().expect("eight bytes")
}

/// Writes objects of node 1.
fn write(rig: &mut ImageRig, requests: &[&str]) {
    for request in requests {
        assert_eq!(ask(rig, 1, request)[0], 0x60, "{request}");
    }
}

fn read(rig: &mut ImageRig, request: &str) -> u32 {
    let [command, _, _, _, value @ ..] = ask(rig, 1, request);
    assert!(matches!(command, 0x43 | 0x4B | 0x4F), "{request}: {command:02X}");
    u32::from_le_bytes(value)
}

/// TPDO 1 carries the LEDs 6200h in place of the button 6000h, so that the node echoes an RPDO.
const ECHO: [&str; 5] = [
    "23 00 18 01 81 01 00 80",
    "2F 00 1A 00 00",
    "23 00 1A 01 08 01 00 62",
    "2F 00 1A 00 01",
    "23 00 18 01 81 01 00 00",
];

#[test]
fn the_button_is_sent_and_the_leds_are_received() {
    let mut rig = operational();
    for (is_pressed, pdo) in [(true, "181: 01"), (false, "181: 00")] {
        press(&rig, is_pressed);
        assert_eq!(of(0x181, &rig.collect(SOON)), [pdo]);
        assert_eq!(of(0x181, &rig.collect(Time::from_ms(100))), SILENCE);
    }
    for (outputs, expected) in
        [(1, [true, false]), (2, [false, true]), (3, [true; 2]), (0, [false; 2])]
    {
        rig.transmit(data(0x201, &[outputs]));
        rig.network.run_for(SOON);
        assert_eq!(leds(&rig), expected);
    }
    // There are two LEDs.
    rig.transmit(data(0x201, &[4]));
    rig.network.run_for(SOON);
    assert_eq!(leds(&rig), [false; 2]);
    assert_eq!(ask(&mut rig, 1, "2F 00 62 01 04"), [0x80, 0x00, 0x62, 1, 0x30, 0, 0x09, 0x06]);
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
        while read(&mut rig, "40 01 64 01") < 400 {
            assert!(rig.network.now() < from + Time::from_s(10));
        }
        rig.network.now() - from
    });
    assert!(times[0] < Time::from_ms(60) && times[1] > Time::from_ms(500), "{times:?}");
}

#[test]
fn the_filter_constant_is_stored_and_restored() {
    const SAVE: &str = "73 61 76 65";
    let mut rig = node_1();
    let filter = |rig: &mut ImageRig| read(rig, "40 00 21 00");
    let after_power_cycle = |rig: &mut ImageRig| {
        rig.power_cycle(0);
        assert_eq!(rig.collect(Time::from_ms(50)), ["701: 00"]);
        filter(rig)
    };
    assert_eq!(filter(&mut rig), 3);
    write(&mut rig, &["2F 00 21 00 05"]);
    assert_eq!(filter(&mut rig), 5);
    assert_eq!(after_power_cycle(&mut rig), 3);
    // 2 stores the parameters of communication, 3 those of the application, 1 both.
    for (value, sub_index, expected) in [(6, 2, 3), (5, 3, 5), (7, 1, 7)] {
        write(&mut rig, &[&format!("2F 00 21 00 {value:02X}")]);
        write(&mut rig, &[&format!("23 10 10 {sub_index:02X} {SAVE}")]);
        assert_eq!(after_power_cycle(&mut rig), expected, "1010h sub {sub_index}");
    }
    for sub_index in [3, 1] {
        write(&mut rig, &["2F 00 21 00 07", &format!("23 10 10 03 {SAVE}")]);
        write(&mut rig, &[&format!("23 11 10 {sub_index:02X} 6C 6F 61 64")]);
        assert_eq!(filter(&mut rig), 7);
        assert_eq!(after_power_cycle(&mut rig), 3, "1011h sub {sub_index}");
    }
    // Values beyond the limit are refused.
    assert_eq!(ask(&mut rig, 1, "2F 00 21 00 09")[0], 0x80);
}

#[test]
fn the_pdos_follow_a_node_id_that_lss_sets() {
    let mut rig = operational();
    for request in ["04 01", "11 05", "17", "04 00"] {
        rig.lss(request);
    }
    assert!(rig.nmt("82 01").0.iter().any(|frame| frame.cob_id() == 0x705));
    rig.nmt("01 05");
    press(&rig, true);
    assert_eq!(of(0x185, &rig.collect(SOON)), ["185: 01"]);
    rig.transmit(data(0x201, &[1]));
    rig.network.run_for(SOON);
    assert_eq!(leds(&rig), [false; 2]);
    rig.transmit(data(0x205, &[2]));
    rig.network.run_for(SOON);
    assert_eq!(leds(&rig), [false, true]);
    assert_eq!(ask(&mut rig, 5, "40 00 14 01")[4..], [0x05, 0x02, 0, 0]);
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

#[test]
fn no_pdo_begins_after_the_end_of_operational() {
    // The node reads the command in the three bits after it, in which another frame of its may begin.
    const READ: Time = Time::from_us(10);
    for end in ["02 01", "80 00"] {
        let mut rig = busier_node();
        let other = rig.network.add_adapter(Adapter::new(1_000_000));
        rig.transmit(data(0x080, &[]));
        for _ in 0..30 {
            rig.network.send(other, data(0x010, &[0; 8]));
        }
        rig.network.run_for(Time::from_us(500));
        let ended = rig.transmit_command(end);
        rig.network.run_for(Time::from_ms(20));
        let begun = |cob_id: u16| {
            let is_one = |event: &&Event| match event.what {
                What::Frame { frame, start, .. } => {
                    frame.id == Id::Standard(cob_id) && start > ended + READ
                }
                _ => false,
            };
            rig.network.trace().iter().filter(is_one).count()
        };
        assert!(begun(0x010) > 10, "the bus was full");
        assert_eq!([0x181, 0x281, 0x381, 0x481].map(begun), [0; 4], "{end}");
        assert!(begun(0x701) > 0, "other services go on");
    }
}

#[test]
fn a_heartbeat_that_is_lost_is_reported_and_ends_operational() {
    let watch = "23 16 10 01 64 00 0A 00";
    const LOST: &[&str] = &["081: 30 81 11 0A 00 00 00 00"];
    // A node that stops sends no emergency message.
    for (behaviour, emergency, state) in
        [("00", LOST, "701: 7F"), ("01", LOST, "701: 05"), ("02", &SILENCE[..], "701: 04")]
    {
        let mut rig = node_1();
        write(&mut rig, &[watch, &format!("2F 29 10 01 {behaviour}"), "2B 17 10 00 0A 00"]);
        rig.nmt("01 01");
        for _ in 0..5 {
            rig.transmit(data(0x70A, &[5]));
            let emergencies = of(0x081, &rig.collect(Time::from_ms(90)));
            assert_eq!(emergencies, SILENCE);
        }
        let sent = rig.collect(Time::from_ms(30));
        assert_eq!(of(0x081, &sent), emergency);
        let sent = of(0x701, &rig.collect(Time::from_ms(10)));
        assert_eq!(sent, [state]);
    }
}

/// Core cycles between two times.
fn cycles(from: Time, to: Time) -> u64 {
    to.saturating_sub(from).as_ps() * CORE_MHZ / 1_000_000
}

/// The time at which a frame that ends at `end` is valid for a receiver: the sample of its last bit but one.
fn valid(rig: &ImageRig, end: Time) -> Time {
    end.saturating_sub(Time::from_ps(rig.bit_time().as_ps() * 9 / 8))
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
        let of_master = |event: &&emulator::network::Event| {
            event.source == Source::Adapter(rig.master) && matches!(event.what, What::Frame { .. })
        };
        let end = rig.network.trace().iter().rev().find(of_master).expect("the RPDO").time;
        spans.push(cycles(valid(&rig, end), changed));
        rig.network.run_for(Time::from_us(311));
    }
    note("RPDO to the first variable in RAM", &spans, RPDO_CYCLES);

    // A TPDO that echoes the value is requested only after the value is in the application.
    rig.nmt("80 01");
    write(&mut rig, &ECHO);
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

/// Node 1 is operational, echoes its RPDO by TPDO 1, sends TPDO 2 at each SYNC, and a heartbeat every 7 ms.
fn busy_node() -> ImageRig {
    let mut rig = node_1();
    write(&mut rig, &ECHO);
    write(&mut rig, &["2F 01 18 02 01", "2B 17 10 00 07 00"]);
    rig.nmt("01 01");
    rig.collect(SAMPLE);
    rig
}

/// The same with four PDOs each way: all RPDOs write the LEDs, and TPDOs 1, 3 and 4 echo them.
fn busier_node() -> ImageRig {
    let mut rig = busy_node();
    rig.nmt("80 01");
    let mut map = |parameter: u8, high: u8, cob_id: u16, mapped: &[&str]| {
        let [low_id, high_id] = cob_id.to_le_bytes();
        let cob_id = |valid: &str| {
            format!("23 {parameter:02X} {high:02X} 01 {low_id:02X} {high_id:02X} 00 {valid}")
        };
        let number = |n: usize| format!("2F {parameter:02X} {:02X} 00 {n:02X}", high + 2);
        write(&mut rig, &[&cob_id("80"), &number(0)]);
        for (at, code) in (1..).zip(mapped) {
            write(&mut rig, &[&format!("23 {parameter:02X} {:02X} {at:02X} {code}", high + 2)]);
        }
        write(&mut rig, &[&number(mapped.len()), &cob_id("00")]);
    };
    const LEDS: &str = "08 01 00 62";
    const TEMPERATURE: &str = "10 01 01 64";
    const DUMMY_32: &str = "20 00 07 00";
    for (parameter, cob_id) in [(1, 0x301), (2, 0x401), (3, 0x501)] {
        map(parameter, 0x14, cob_id, &[LEDS, DUMMY_32]);
    }
    for (parameter, cob_id) in [(2, 0x381), (3, 0x481)] {
        map(parameter, 0x18, cob_id, &[LEDS, TEMPERATURE]);
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
    note("LSS answer behind a PDO of the node", &waited, most_us * CORE_MHZ);
    assert!(at_once.len() > ROUNDS / 10, "{} answers at once", at_once.len());
    assert_eq!((at_once.len() + waited.len(), by_sync), (ROUNDS, syncs));
    assert_eq!(echoes.last(), Some(&value));
    assert!(load > 97, "{load} %");
    let log = rig.network.board(0).log();
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
    // The button connects its pin to ground.
    let press = |rig: &ImageRig, is_pressed: bool| {
        rig.network.board(0).chip().gpio_mut().set_input(Pin('C', 13), Some(!is_pressed));
    };
    press(&rig, true);
    rig.network.run_for(SOON);
    let sent = rig.nmt("01 01");
    assert_eq!(of(0x181, &sent), ["181: 01"]);
    let [temperature] = temperatures(&sent)[..] else { panic!("one TPDO 2") };
    assert!((245..=255).contains(&temperature), "{temperature}");
    press(&rig, false);
    assert_eq!(of(0x181, &rig.collect(SOON)), ["181: 00"]);
    rig.transmit(data(0x201, &[1]));
    rig.network.run_for(SOON);
    assert_eq!(rig.network.board(0).output(Pin('A', 5)).level, Some(true));
    assert_eq!(rig.network.board(0).output(Pin('D', 15)).level, Some(false));
}
