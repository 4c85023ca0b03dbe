//! The pins of your board. Edit this file.

use stm32f4xx_hal::{
    gpio::{ErasedPin, GpioExt, Input},
    pac,
    rcc::Rcc,
};

use crate::{can_pins::CanPins, led::Led};

/// The ports of the chip that a board may use.
#[allow(dead_code, reason = "no board uses all of them")]
pub struct Ports {
    pub a: pac::GPIOA,
    pub b: pac::GPIOB,
    pub c: pac::GPIOC,
    pub d: pac::GPIOD,
    pub e: pac::GPIOE,
    pub f: pac::GPIOF,
    pub g: pac::GPIOG,
    pub h: pac::GPIOH,
    #[cfg(not(any(
        feature = "stm32f412",
        feature = "stm32f413",
        feature = "stm32f423",
        feature = "stm32f446"
    )))]
    pub i: pac::GPIOI,
}

/// The number of switches for the node-ID, at most 7.
const SWITCHES: usize = if cfg!(feature = "switches") { 7 } else { 0 };

/// The pins of the board.
pub struct Pins {
    /// To the CAN transceiver. The compiler refuses pins that the chip does not connect to its controller.
    pub can: CanPins,
    /// The RUN (green) and ERR (red) indicators.
    pub indicators: (Led, Led),
    /// Switches to ground for the node-ID of a device that has stored no settings, that for bit 0 first; a closed switch
    /// is a 1. If all are open, or there are none, it is that of `device::DEFAULTS`.
    pub node_id_switches: [ErasedPin<Input>; SWITCHES],
    #[cfg(feature = "io")]
    pub io: crate::io_board::IoPins,
}

impl Pins {
    /// Assigns the pins.
    pub fn new(ports: Ports, rcc: &mut Rcc) -> Self {
        let (b, d) = (ports.b.split(rcc), ports.d.split(rcc));
        Self {
            #[cfg(not(any(feature = "can2", feature = "can3")))]
            can: CanPins::new(b.pb9, b.pb8),
            #[cfg(feature = "can2")]
            can: CanPins::new(b.pb13, b.pb12),
            #[cfg(feature = "can3")]
            can: CanPins::new(b.pb4, b.pb3),

            // Two LEDs of an STM32F407 Discovery; on a board without them the pins toggle unseen.
            #[cfg(not(feature = "switches"))]
            indicators: (Led::active_high(d.pd12), Led::active_high(d.pd14)),
            #[cfg(feature = "switches")]
            indicators: (Led::active_low(d.pd12), Led::None),

            #[cfg(not(feature = "switches"))]
            node_id_switches: [],
            #[cfg(feature = "switches")]
            node_id_switches: {
                let e = ports.e.split(rcc);
                [
                    e.pe0.into_pull_up_input().erase(),
                    e.pe1.into_pull_up_input().erase(),
                    e.pe2.into_pull_up_input().erase(),
                    e.pe3.into_pull_up_input().erase(),
                    e.pe4.into_pull_up_input().erase(),
                    e.pe5.into_pull_up_input().erase(),
                    e.pe6.into_pull_up_input().erase(),
                ]
            },
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
