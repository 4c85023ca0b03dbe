//! Boards and adapters on one bus: timing, the trace, supply switches, and reproducibility.

#[expect(dead_code, reason = "this program needs only a part of the assembler")]
mod programs;

use emulator::{
    Time,
    board::{Board, Settings},
    can::{Adapter, Clock, ErrorKind, Frame, Id},
    chip::Part,
    network::{AdapterId, Event, Network, Recording, Source, What},
};
use programs::{Program, R1, RCC_AHB1ENR, RCC_APB1ENR, RCC_CFGR, RCC_CR};

const GPIOA: u32 = 0x4002_0000;
const CAN: u32 = 0x4000_6400;
const NVIC_ISER0: u32 = 0xE000_E100;

const CAN1_RX0: usize = 16 + 20;
/// 250 kbit/s at 8 MHz, sample point 87.5 %.
const QUARTER_MEGABIT: u32 = 0x001C_0001;
const RESULT: u32 = 0x2000_0000;
const REPLY: u16 = 0x581;

/// Answers each frame at 250 kbit/s with the same data and the identifier `REPLY`, and sleeps in between.
fn echo() -> Program {
    let mut program = Program::new();
    program.store(RCC_CR, 0x0001_0083).wait_for_ones(RCC_CR, 1 << 17).store(RCC_CFGR, 1);
    program.store(RCC_AHB1ENR, 1).store(GPIOA, 0xAA80_0000).store(GPIOA + 0x24, 0x0009_9000);
    program.store(RCC_APB1ENR, 1 << 25);
    program.store(CAN, 0x41).wait_for_ones(CAN + 4, 1).store(CAN + 0x1C, QUARTER_MEGABIT);
    program.store(CAN + 0x20C, 1).store(CAN + 0x21C, 1).store(CAN + 0x200, 0x2A1C_0E00);
    program.store(CAN, 0x40).store(CAN + 0x14, 2).store(NVIC_ISER0, 1 << 20);
    program.sleep_forever();
    program.handler(CAN1_RX0);
    program.load(R1, CAN + 0x1B4).store_register(CAN + 0x184, R1);
    program.load(R1, CAN + 0x1B8).store_register(CAN + 0x188, R1);
    program.load(R1, CAN + 0x1BC).store_register(CAN + 0x18C, R1);
    program.store(CAN + 0x180, u32::from(REPLY) << 21 | 1).store(CAN + 0x0C, 1 << 5).back();
    program
}

fn board(ppm: i32) -> Board {
    let crystal = Clock { hz: 8_000_000, ppm };
    Board::new(Part::Stm32f405, &echo().image(), Settings { crystal, ..Settings::default() })
}

fn standard(id: u16, payload: &[u8]) -> Frame {
    Frame::data(Id::Standard(id), payload)
}

fn reply(payload: &[u8]) -> Frame {
    standard(REPLY, payload)
}

/// The time at which a board runs, after power-on and the start of the crystal.
const READY: Time = Time::from_ms(10);

/// Boards with these errors of their crystals, and an adapter, all of which are ready.
fn with_boards(crystals: &[i32]) -> (Network, AdapterId) {
    let mut network = Network::new();
    crystals.iter().for_each(|ppm| _ = network.add_board(board(*ppm)));
    let adapter = network.add_adapter(Adapter::new(250_000));
    network.run_until(READY);
    (network, adapter)
}

fn frames(network: &Network) -> Vec<&Event> {
    network.trace().iter().filter(|event| matches!(event.what, What::Frame { .. })).collect()
}

#[test]
fn a_board_answers_an_adapter() {
    let (mut network, adapter) = with_boards(&[0]);
    assert_eq!(network.board(0).findings(), []);
    let request = standard(0x601, &[1, 2, 3]);
    network.send(adapter, request);
    let (time, answer) = network.run_until_received(adapter, Time::from_ms(5)).expect("an answer");
    assert_eq!(answer, reply(&[1, 2, 3]));

    // The request starts at the next bit boundary. The answer follows some 40 instructions after the last bit but one
    // of EOF, but not before the end of intermission. It is valid 1.125 bits before its own end.
    let bits = u64::from(request.wire_bits() + 3 + answer.wire_bits());
    let span = time - READY;
    let expected = Time::from_us(4 * bits) - Time::from_ns(4_500);
    assert!(span >= expected && span < expected + Time::from_us(30), "{span} for {expected}");
}

#[test]
fn the_trace_lists_a_boards_actions_in_order() {
    let (mut network, adapter) = with_boards(&[0]);
    network.send(adapter, standard(0x601, &[7]));
    network.run_for(Time::from_ms(5));
    let trace = network.trace();
    assert!(trace.is_sorted_by_key(|event| event.time));
    let what: Vec<&What> = trace.iter().map(|event| &event.what).collect();
    let [
        What::InitializationEntered,
        What::BitTiming { btr: QUARTER_MEGABIT, bit_rate: 250_000 },
        What::InitializationLeft,
        What::Frame { frame: request, .. },
        What::Requested { mailbox: 0, frame: requested },
        What::Frame { frame: answer, start, bit_rate: 250_000, also },
    ] = what.as_slice()
    else {
        panic!("{what:#?}");
    };
    assert_eq!((*request, *answer, *requested), (standard(0x601, &[7]), reply(&[7]), reply(&[7])));
    assert!(also.is_empty());
    assert_eq!(trace[5].source, Source::Board(0));
    assert_eq!(trace[3].source, Source::Adapter(adapter));
    assert_eq!(trace[5].time - *start, Time::from_us(4 * u64::from(answer.wire_bits())));
    let line = trace[4].to_string();
    assert!(line.ends_with("  board 0     mailbox 0 requests 581#07"), "{line}");
    let left = trace[2].time - trace[1].time;
    assert!(left > Time::from_us(44) && left < Time::from_us(60), "eleven bits: {left}");
}

#[test]
fn equal_answers_of_many_boards_are_one_frame() {
    let (mut network, adapter) = with_boards(&[0, 40, -40, 15, -25]);
    for n in 0..20 {
        network.send(adapter, standard(0x601, &[n; 8]));
        let (_, answer) = network.run_until_received(adapter, Time::from_ms(5)).expect("an answer");
        assert_eq!(answer, reply(&[n; 8]));
    }
    network.run_for(Time::from_ms(5));
    assert_eq!(network.receive(adapter), None);
    let frames = frames(&network);
    assert_eq!(frames.len(), 40);
    for answer in frames.iter().skip(1).step_by(2) {
        let What::Frame { also, .. } = &answer.what else { unreachable!() };
        let mut senders = vec![answer.source];
        senders.extend(also);
        senders.sort();
        assert_eq!(senders, [0, 1, 2, 3, 4].map(Source::Board));
    }
}

#[test]
fn two_runs_of_the_same_network_are_identical() {
    let run = || {
        let (mut network, adapter) = with_boards(&[-10, -3, 4, 11]);
        for n in 0..30 {
            network.send(adapter, standard(0x600 + n, &n.to_le_bytes()));
            network.run_for(Time::from_us(333));
        }
        (network.trace().to_vec(), network.board(3).cycles())
    };
    assert_eq!(run(), run());
}

#[test]
fn a_board_without_power_is_not_on_the_bus_and_comes_back() {
    let (mut network, adapter) = with_boards(&[0]);
    network.power_off(0);
    network.send(adapter, standard(0x601, &[1]));
    assert_eq!(network.run_until_received(adapter, Time::from_ms(20)), None);
    assert_eq!(network.now(), READY + Time::from_ms(20));
    let errors = network.trace().iter().filter(|event| {
        matches!(event.what, What::Error { kind: ErrorKind::Acknowledgement, transmitting: true })
    });
    assert!(errors.count() > 50);
    network.power_on(0);
    let (_, answer) = network.run_until_received(adapter, Time::from_ms(20)).expect("an answer");
    assert_eq!(answer, reply(&[1]));
    let supply: Vec<&What> = network
        .trace()
        .iter()
        .map(|event| &event.what)
        .filter(|what| matches!(what, What::PowerOff | What::PowerOn))
        .collect();
    assert_eq!(supply, [&What::PowerOff, &What::PowerOn]);
}

#[test]
fn a_board_that_joins_late_is_switched_on_then() {
    let mut network = Network::new();
    let adapter = network.add_adapter(Adapter::new(250_000));
    network.run_until(Time::from_s(1));
    network.add_board(board(0));
    network.send(adapter, standard(0x601, &[1]));
    let (time, _) = network.run_until_received(adapter, Time::from_ms(20)).expect("an answer");
    assert!(time > Time::from_ms(1_001), "{time}");
}

#[test]
fn one_error_frame_is_one_event() {
    let mut network = Network::new();
    let a = network.add_adapter(Adapter::new(250_000));
    let b = network.add_adapter(Adapter::new(250_000));
    let odd = network.add_adapter(Adapter::new(125_000));
    network.run_for(Time::from_ms(1));
    network.send(a, standard(0x123, &[0; 8]));
    while network.trace().is_empty() {
        network.run_for(Time::from_us(10));
    }
    network.run_for(Time::from_us(60));
    assert_eq!(network.trace().len(), 1, "{:#?}", network.trace());
    assert!(matches!(network.trace()[0].what, What::Error { .. }));
    assert!(network.adapter_mut(a).errors() + network.adapter_mut(b).errors() > 0);
    network.adapter_mut(odd).close();
    assert!(network.run_until_received(b, Time::from_ms(5)).is_some());
}

#[test]
fn adapters_change_their_rate_while_the_network_runs() {
    let mut network = Network::new();
    let a = network.add_adapter(Adapter::new(250_000));
    let b = network.add_adapter(Adapter::new(250_000));
    for rate in [10_000, 20_000, 50_000, 125_000, 250_000, 500_000, 800_000, 1_000_000] {
        network.adapter_mut(a).set_bit_rate(rate);
        network.adapter_mut(b).set_bit_rate(rate);
        let asked = network.now();
        let frame = standard(0x7E5, &[0x55; 8]);
        network.send(a, frame);
        let (time, _) = network.run_until_received(b, Time::from_ms(50)).expect("a frame");
        let bits = u64::from(frame.wire_bits()) + 11;
        let bit = 1_000_000_000 / u64::from(rate);
        assert!((time - asked).as_ns().abs_diff(bits * bit) < 3 * bit, "{rate}");
    }
    assert!(frames(&network).iter().zip([10_000, 20_000, 50_000]).all(|(event, expected)| {
        matches!(event.what, What::Frame { bit_rate, .. } if bit_rate == expected)
    }));
}

#[test]
fn a_trace_can_be_bounded_or_off() {
    let mut network = Network::new();
    let a = network.add_adapter(Adapter::new(1_000_000));
    network.add_adapter(Adapter::new(1_000_000));
    network.record(Recording::Latest(10));
    (0..100).for_each(|n| network.send(a, standard(n, &[])));
    network.run_for(Time::from_ms(10));
    assert!((10..=20).contains(&network.trace().len()));
    network.record(Recording::Off);
    assert!(network.trace().is_empty());
    network.send(a, standard(1, &[]));
    network.run_for(Time::from_ms(10));
    assert!(network.trace().is_empty());
}

#[test]
fn an_hour_of_sleep_is_short() {
    let (mut network, adapter) = with_boards(&[0, 1, 2, 3, 4, 5, 6, 7]);
    network.run_until(Time::from_s(3600));
    network.send(adapter, standard(0x601, &[1]));
    assert!(network.run_until_received(adapter, Time::from_ms(5)).is_some());
}

#[test]
fn traffic_on_a_second_bus_does_not_change_what_happens_on_the_first() {
    let session = |has_second: bool| {
        let mut network = Network::new();
        network.add_board(board(20));
        let adapter = network.add_adapter(Adapter::new(250_000));
        let others = has_second.then(|| {
            let second = network.add_bus();
            [333_000, 333_000].map(|rate| network.add_adapter_to(second, Adapter::new(rate)))
        });
        network.run_until(READY);
        let (mut answers, mut heard) = (Vec::new(), 0);
        for n in 0..30 {
            network.send(adapter, standard(0x601, &[n; 8]));
            if let Some([sender, receiver]) = others {
                (0..8).for_each(|_| network.send(sender, standard(0x601, &[!n; 8])));
                heard += std::iter::from_fn(|| network.receive(receiver)).count();
            }
            network.run_for(Time::from_us(2_345));
            answers.extend(std::iter::from_fn(|| network.receive(adapter)));
        }
        (network.trace().to_vec(), answers, heard)
    };
    let (trace, answers, _) = session(false);
    let (beside, answers_beside, heard) = session(true);
    assert_eq!((answers.len(), answers), (30, answers_beside));
    assert_eq!(trace, beside);
    assert!(heard > 150, "{heard} frames on the second bus");
}

#[test]
fn each_controller_answers_on_its_own_bus() {
    let mut network = Network::new();
    let settings = Settings { controller: 2, ..Settings::default() };
    network.add_board(Board::new(Part::Stm32f405, &echo().image(), settings));
    let second = network.add_bus();
    let stranger = network.add_adapter(Adapter::new(250_000));
    let adapter = network.add_adapter_to(second, Adapter::new(250_000));
    network.connect(0, 1, second);
    network.run_until(READY);
    // The program uses CAN1, which is not on the first bus.
    network.send(stranger, standard(0x601, &[1]));
    network.send(adapter, standard(0x601, &[2]));
    let (_, answer) = network.run_until_received(adapter, Time::from_ms(5)).expect("an answer");
    assert_eq!(answer, reply(&[2]));
    assert_eq!(network.adapter_mut(stranger).unsent(), 1);
    assert!(frames(&network).is_empty());
}

#[test]
fn a_controller_that_is_on_no_bus_joins_and_sends_to_itself_in_loopback() {
    const CAN2: u32 = CAN + 0x400;
    const SILENT_LOOPBACK: u32 = 0b11 << 30;
    const TRANSMITTED: u32 = 1 << 1;
    let mut program = Program::new();
    program.store(RCC_AHB1ENR, 1 << 1).store(GPIOA + 0x400, 0x0A00_0280);
    program.store(GPIOA + 0x424, 0x0099_0000).store(RCC_APB1ENR, 0b11 << 25);
    program.store(CAN2, 0x41).wait_for_ones(CAN2 + 4, 1);
    program.store(CAN2 + 0x1C, QUARTER_MEGABIT | SILENT_LOOPBACK).store(CAN2, 0x40);
    program.store(CAN2 + 0x184, 0).store(CAN2 + 0x180, 1);
    program.wait_for_ones(CAN2 + 8, TRANSMITTED).load(R1, CAN2 + 4).store_register(RESULT, R1);
    program.sleep_forever();
    let board = Board::new(Part::Stm32f405, &program.image(), Settings::default());
    let mut network = Network::new();
    let board = network.add_board(board);
    let adapter = network.add_adapter(Adapter::new(250_000));
    network.run_until(READY);
    let mut status = [0; 4];
    assert!(network.board(board).read_memory(RESULT, &mut status));
    assert_eq!(u32::from_le_bytes(status) & 0b11, 0, "neither initialisation nor sleep mode");
    assert_eq!(network.receive(adapter), None);
    assert_eq!(network.board(board).findings(), []);
}
