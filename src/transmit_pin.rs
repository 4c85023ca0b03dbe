//! The transmit pin to the CAN transceiver, which the controller drives or which is held recessive.

use stm32f4xx_hal::{
    gpio::{Output, Pin, PinSpeed, PinState, Speed, alt::can1},
    pac::GPIOA,
};

/// The distance of two GPIO ports' registers in bytes (RM0090, 2.3).
const PORT_DISTANCE: usize = 0x400;
/// Modes of a pin in GPIOx_MODER (RM0090, 8.4.1).
const OUTPUT: u32 = 0b01;
const ALTERNATE_FUNCTION: u32 = 0b10;

/// A pin that can carry CAN1's transmit line.
pub struct TransmitPin {
    /// The distance of the port's registers from those of port A in bytes.
    port_offset: usize,
    /// The first bit of the pin's mode in GPIOx_MODER.
    shift: u32,
}

impl<const PORT: char, const NUMBER: u8> From<Pin<PORT, NUMBER>> for TransmitPin
where
    can1::Tx: From<Pin<PORT, NUMBER, Output>>,
{
    /// Sets the pin up for CAN1, held recessive. CAN1 must have its clock, as the line may otherwise glitch.
    fn from(pin: Pin<PORT, NUMBER>) -> Self {
        let pin = pin.into_push_pull_output_in_state(PinState::High);
        can1::Tx::from(pin).set_speed(Speed::High);
        let port_offset = const { PORT_DISTANCE * (PORT as usize - 'A' as usize) };
        let mut pin = Self { port_offset, shift: const { 2 * NUMBER as u32 } };
        pin.rest();
        pin
    }
}

impl TransmitPin {
    /// Gives the pin to the controller.
    pub fn connect(&mut self) {
        self.set_mode(ALTERNATE_FUNCTION);
    }

    /// Holds the line recessive, whatever the controller drives.
    pub fn rest(&mut self) {
        self.set_mode(OUTPUT);
    }

    fn set_mode(&mut self, mode: u32) {
        // SAFETY: the ports have equal registers at equal distances.
        let port = unsafe { &*GPIOA::ptr().byte_add(self.port_offset) };
        let (mask, mode) = (0b11_u32.wrapping_shl(self.shift), mode.wrapping_shl(self.shift));
        // SAFETY: only the bits of this pin change, and no other code writes pin modes while tasks run.
        port.moder().modify(|r, w| unsafe { w.bits(r.bits() & !mask | mode) });
    }
}
