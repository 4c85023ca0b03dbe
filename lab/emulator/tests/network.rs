//! Boards and adapters on one bus: timing, the trace, supply switches, and reproducibility.

#[expect(dead_code, reason = "this program needs only a part of the assembler")]
mod programs;

use emulator::{
    Time,
    board::{Board, Settings},
    can::{Adapter, Clock, ErrorKind, Frame, Id},
    chip::Part,
    network::{AdapterId, Network, What},
};
use programs::{Program, R1, RCC_AHB1ENR, RCC_APB1ENR, RCC_CFGR, RCC_CR};

const GPIOA: u32 = 0x4002_0000;
const CAN: u32 = 0x4000_6400;
const NVIC_ISER0: u32 = 0xE000_E100;

const CAN1_RX0: usize = 16 + 20;
/// 250 kbit/s at 8 MHz, sample point 87.5 %.
const QUARTER_MEGABIT: u32 = 0x001C_0001;
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
