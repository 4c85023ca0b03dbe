//! The surroundings of a board with the example `io`: its button, its LEDs and the temperature of its chip.

use emulator::{
    board::Board,
    chip::{Part, Pin},
};

/// The pins on the board with a chip, as `examples/io/src/pins.rs` assigns them.
struct Wiring {
    button: Pin,
    is_button_active_low: bool,
    leds: [Pin; 2],
}

const fn wiring(part: Part) -> Wiring {
    match part {
        Part::Stm32f446 => Wiring {
            button: Pin('C', 13),
            is_button_active_low: true,
            leds: [Pin('A', 5), Pin('D', 15)],
        },
        _ => Wiring {
            button: Pin('A', 0),
            is_button_active_low: false,
            leds: [Pin('D', 13), Pin('D', 15)],
        },
    }
}

/// Presses or releases the button.
pub fn press(board: &Board, is_pressed: bool) {
    let mut chip = board.chip();
    let Wiring { button, is_button_active_low, .. } = wiring(chip.part());
    chip.gpio_mut().set_input(button, Some(is_pressed != is_button_active_low));
}

/// Whether the LEDs are lit.
pub fn leds(board: &Board) -> [bool; 2] {
    let chip = board.chip();
    wiring(chip.part()).leds.map(|pin| chip.gpio().output(pin).level == Some(true))
}

/// Sets the temperature of the chip in degrees Celsius.
pub fn set_temperature(board: &Board, celsius: i32) {
    board.chip().adc_mut().analogue.temperature = celsius;
}
