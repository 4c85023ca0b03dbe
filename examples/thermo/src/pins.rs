//! The pins of the thermometer.

use core::hint::black_box;

use canopen_stm32f4::{Indicators, Led, can::CanPins};
use stm32f4xx_hal::{
    gpio::{Analog, ErasedPin, GpioExt, Input, Output, Pin},
    pac::{self, GPIOA, GPIOB, GPIOC, GPIOD},
    rcc::Rcc,
};

/// The CAN controller.
pub type Can = pac::CAN2;

/// The ports of the chip that the board uses.
pub struct Ports {
    pub a: GPIOA,
    pub b: GPIOB,
    pub c: GPIOC,
    pub d: GPIOD,
}

/// The sensors, at channels 0 to 3 of the converter.
pub type SensorPins =
    (Pin<'A', 0, Analog>, Pin<'A', 1, Analog>, Pin<'A', 2, Analog>, Pin<'A', 3, Analog>);

/// The relays.
pub struct Relays([ErasedPin<Output>; 2]);

impl Relays {
    /// Closes the relays of the set bits, and opens the others.
    pub fn set(&mut self, relays: u8) {
        for (number, relay) in self.0.iter_mut().enumerate() {
            relay.set_state((relays >> number & 1 == 1).into());
        }
    }
}

/// The pins of the board.
pub struct Pins {
    pub can: CanPins<Can>,
    /// RUN lights while its pin is low; there is no ERR.
    pub indicators: Indicators,
    /// Switches to ground for the node-ID, that for bit 0 first.
    pub node_id_switches: [ErasedPin<Input>; 7],
    pub sensors: SensorPins,
    pub relays: Relays,
}

impl Pins {
    /// Assigns the pins.
    pub fn new(ports: Ports, rcc: &mut Rcc) -> Self {
        let (a, b, c, d) =
            (ports.a.split(rcc), ports.b.split(rcc), ports.c.split(rcc), ports.d.split(rcc));
        Self {
            can: CanPins::new(b.pb13, b.pb12, rcc),
            indicators: Indicators { run: Led::active_low(d.pd12), error: Led::None },
            node_id_switches: [
                c.pc4.into_pull_up_input().erase(),
                c.pc5.into_pull_up_input().erase(),
                c.pc6.into_pull_up_input().erase(),
                c.pc7.into_pull_up_input().erase(),
                c.pc8.into_pull_up_input().erase(),
                c.pc9.into_pull_up_input().erase(),
                c.pc10.into_pull_up_input().erase(),
            ],
            sensors: (
                a.pa0.into_analog(),
                a.pa1.into_analog(),
                a.pa2.into_analog(),
                a.pa3.into_analog(),
            ),
            // Not a constant, as docs/product.md explains.
            relays: Relays(black_box([
                b.pb0.into_push_pull_output().erase(),
                b.pb1.into_push_pull_output().erase(),
            ])),
        }
    }
}
