//! The pins of your board. Edit this file.

use stm32f4xx_hal::{
    gpio::{ErasedPin, GpioExt, Output, alt::can1},
    pac::{GPIOB, GPIOD, RCC},
};

use crate::transmit_pin::TransmitPin;

/// The pins to the CAN transceiver. CAN1 can also use PA12 and PA11: change the port in all three places. On PD1 and
/// PD0 it would share port D, which can be split only once, with the indicators: give those another port.
pub fn can(port: GPIOB, rcc: &mut RCC) -> (TransmitPin, can1::Rx) {
    let pins = port.split(rcc);
    (pins.pb9.into(), pins.pb8.into())
}

/// The RUN (green) and ERR (red) indicators, active high. These are two LEDs of an STM32F407 Discovery; on a board
/// without them the pins toggle unseen.
pub fn indicators(port: GPIOD, rcc: &mut RCC) -> (ErasedPin<Output>, ErasedPin<Output>) {
    let pins = port.split(rcc);
    (pins.pd12.into_push_pull_output().erase(), pins.pd14.into_push_pull_output().erase())
}
