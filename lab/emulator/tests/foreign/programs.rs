//! Programs of others as a whole: they start, log, blink, and use CAN.

use emulator::{
    Time,
    board::{Board, Settings},
    can::{Frame, Id},
    chip::{Part, Pin},
    network::{AdapterId, Network, Recording},
};
use testkit::log;

use crate::rig::{Driver, Rig, adapter, explained, image, standard};

/// The number of times that a pin changes in 20 ms.
fn changes(network: &mut Network, pin: Pin) -> u32 {
    let mut level = network.board(0).output(pin);
    let mut changes = 0;
    for _ in 0..2_000 {
        network.run_for(Time::from_us(10));
        let now = network.board(0).output(pin);
        changes += u32::from(now != level);
        level = now;
    }
    changes
}

pub fn its_log_is_read_and_its_led_blinks_every_millisecond(driver: Driver) {
    let mut rig = Rig::new(driver);
    let (pin, text) = match driver {
        Driver::Embassy => (Pin('C', 13), "embassy-stm32 is ready"),
        Driver::Bxcan => (Pin('D', 12), "bxcan is ready"),
        Driver::Fdcan => (Pin('C', 13), "embassy-stm32 is ready"),
    };
    let blinks = changes(&mut rig.network, pin);
    assert!((19..=21).contains(&blinks), "{blinks}");
    let log = log::lines(rig.network.board(0));
    assert!(log.iter().any(|line| (line.level, line.text.as_str()) == ("info", text)), "{log:?}");
}

#[test]
#[ignore = "builds embassy-stm32, about 80 s of CPU time"]
fn a_program_starts_that_uses_what_a_hal_offers() {
    let mut network = Network::new();
    network.record(Recording::Off);
    let image = image("start", "embassy");
    network.add_board(Board::new(Part::Stm32f405, image, Settings::default()));
    let adapter = network.add_adapter(adapter(500_000));
    network.run_for(Time::from_ms(10));
    let blinks = changes(&mut network, Pin('C', 13));
    assert!((17..=20).contains(&blinks), "{blinks}");
    let (_, frame) = network.receive(adapter).expect("it sends");
    assert_eq!((frame.id, frame.dlc), (Id::Standard(0x123), 8));
    assert_ne!(frame.data, [0; 8], "random");
    let board = network.board(0);
    assert_eq!(
        log::lines(board).last().map(|line| line.text.as_str()),
        Some("1 ms is 168000 cycles")
    );
    assert_eq!(board.chip().take_sent()[1], b"hello\r\n");
    let unexplained: Vec<String> = board
        .findings()
        .iter()
        .filter(|finding| !explained(Driver::Embassy, finding))
        .map(ToString::to_string)
        .collect();
    assert!(unexplained.is_empty(), "{unexplained:#?}");
}

#[test]
#[ignore = "builds bxcan and stm32f4xx-hal"]
fn a_gateway_passes_frames_by_its_filters_between_can1_and_can2() {
    let mut network = Network::new();
    network.record(Recording::Off);
    let board = network.add_board(Board::new(
        Part::Stm32f405,
        image("gateway", "bxcan"),
        Settings::default(),
    ));
    let second = network.add_bus();
    network.connect(board, 2, second);
    let sides =
        [network.add_adapter(adapter(500_000)), network.add_adapter_to(second, adapter(250_000))];
    network.run_for(Time::from_ms(10));
    let received = |network: &mut Network, side: AdapterId| -> Vec<Frame> {
        std::iter::from_fn(|| network.receive(side)).map(|(_, frame)| frame).collect()
    };
    let mut passed = [Vec::new(), Vec::new()];
    // Both sides send at once, at their own rates, what passes and what does not.
    for n in 0..50_u16 {
        for (from, side) in sides.into_iter().enumerate() {
            let passing = standard([0x100, 0x200][from] | n, &[n as u8]);
            for frame in [standard(n, &[]), passing, standard(0x300 | n, &[])] {
                network.send(side, frame);
            }
            passed[1 - from].push(passing);
        }
        network.run_for(Time::from_ms(3));
    }
    // Neither side passes what the other does.
    network.send(sides[0], standard(0x2FF, &[]));
    network.send(sides[1], standard(0x1FF, &[]));
    network.run_for(Time::from_ms(3));
    for (side, expected) in sides.into_iter().zip(passed) {
        assert_eq!(received(&mut network, side), expected);
    }
    let board = network.board(board);
    assert_eq!(board.findings(), []);
    assert!(log::lines(board).iter().any(|line| line.text == "the gateway is ready"));
}
