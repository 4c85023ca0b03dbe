//! Programs of others as a whole: they start, log, blink, and use CAN.

use emulator::{
    Time,
    board::{Board, Settings},
    can::Id,
    chip::{Part, Pin},
    network::{Network, Recording},
};

use crate::rig::{Driver, Rig, adapter, explained, start_image};

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
    };
    let blinks = changes(&mut rig.network, pin);
    assert!((19..=21).contains(&blinks), "{blinks}");
    let log = rig.network.board(0).log();
    assert!(log.iter().any(|line| (line.level, line.text.as_str()) == ("info", text)), "{log:?}");
}

#[test]
#[ignore = "builds embassy-stm32, about 80 s of CPU time"]
fn a_program_starts_that_uses_what_a_hal_offers() {
    let mut network = Network::new();
    network.record(Recording::Off);
    network.add_board(Board::new(Part::Stm32f405, start_image(), Settings::default()));
    let adapter = network.add_adapter(adapter(500_000));
    network.run_for(Time::from_ms(10));
    let blinks = changes(&mut network, Pin('C', 13));
    assert!((17..=20).contains(&blinks), "{blinks}");
    let (_, frame) = network.receive(adapter).expect("it sends");
    assert_eq!((frame.id, frame.dlc), (Id::Standard(0x123), 8));
    assert_ne!(frame.data, [0; 8], "random");
    let board = network.board(0);
    assert_eq!(board.log().last().map(|line| line.text.as_str()), Some("1 ms is 168000 cycles"));
    assert_eq!(board.chip().take_sent()[1], b"hello\r\n");
    let unexplained: Vec<String> = board
        .findings()
        .iter()
        .filter(|finding| !explained(Driver::Embassy, finding))
        .map(ToString::to_string)
        .collect();
    assert!(unexplained.is_empty(), "{unexplained:#?}");
}
