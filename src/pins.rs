//! The pins of your board. Edit this file.

use stm32f4xx_hal::{
    gpio::{ErasedPin, GpioExt, Output, alt::can1},
    pac::{GPIOA, GPIOB, GPIOC, GPIOD},
    rcc::Rcc,
};

use crate::transmit_pin::TransmitPin;

/// The ports of the chip that a board may use.
#[allow(dead_code, reason = "no board uses all of them")]
pub struct Ports {
    pub a: GPIOA,
    pub b: GPIOB,
    pub c: GPIOC,
    pub d: GPIOD,
}

/// The pins of the board.
pub struct Pins {
    /// To the CAN transceiver. CAN1 can also use PA12 and PA11, or PD1 and PD0.
    pub can: (TransmitPin, can1::Rx),
    /// The RUN (green) and ERR (red) indicators, active high. These are two LEDs of an STM32F407 Discovery; on a board
    /// without them the pins toggle unseen.
    pub indicators: (ErasedPin<Output>, ErasedPin<Output>),
    #[cfg(feature = "io")]
    pub io: crate::io_board::IoPins,
}

impl Pins {
    /// Assigns the pins.
    pub fn new(ports: Ports, rcc: &mut Rcc) -> Self {
        let (b, d) = (ports.b.split(rcc), ports.d.split(rcc));
        Self {
            can: (b.pb9.into(), b.pb8.into()),
            indicators: (
                d.pd12.into_push_pull_output().erase(),
                d.pd14.into_push_pull_output().erase(),
            ),
            #[cfg(all(feature = "io", not(feature = "stm32f446")))]
            io: crate::io_board::IoPins {
                button: ports.a.split(rcc).pa0.into_pull_down_input().erase(),
                is_button_active_low: false,
                leds: [
                    d.pd13.into_push_pull_output().erase(),
                    d.pd15.into_push_pull_output().erase(),
                ],
            },
            #[cfg(all(feature = "io", feature = "stm32f446"))]
            io: crate::io_board::IoPins {
                button: ports.c.split(rcc).pc13.into_pull_up_input().erase(),
                is_button_active_low: true,
                leds: [
                    ports.a.split(rcc).pa5.into_push_pull_output().erase(),
                    d.pd15.into_push_pull_output().erase(),
                ],
            },
        }
    }
}
