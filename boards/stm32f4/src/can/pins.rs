//! The pins to the CAN transceiver. The controller drives the transmit pin, or it is held recessive.

use stm32f4xx_hal::{
    gpio::{Input, Output, Pin, PinMode, PinPull, PinSpeed, PinState, Pull, Speed},
    pac::GPIOA,
    rcc::Rcc,
};

use super::peripheral::Peripheral;

/// The distance of two GPIO ports' registers in bytes (RM0090, 2.3).
const PORT_DISTANCE: usize = 0x400;
/// Modes of a pin in GPIOx_MODER (RM0090, 8.4.1).
const OUTPUT: u32 = 0b01;
const ALTERNATE_FUNCTION: u32 = 0b10;

/// The pins between the controller `C` and the CAN transceiver.
pub struct CanPins<C: Peripheral> {
    pub(super) transmit: TransmitPin,
    pub(super) receive: C::Rx,
}

impl<C: Peripheral> CanPins<C> {
    /// These pins, if the chip connects the controller to them.
    pub fn new(transmit: impl CanTx<C>, receive: impl CanRx<C>, rcc: &mut Rcc) -> Self {
        // First, as the line may otherwise glitch.
        C::enable_clock(rcc);
        Self { transmit: transmit.into_transmit_pin(), receive: receive.into_receive_pin() }
    }
}

/// A pin that can carry the controller's transmit line.
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot be the transmit pin of the CAN controller `{C}`",
    note = "CAN1 transmits at PA12, PB9, PD1, on some chips PG1 or PH13; CAN2 at PB6, PB13, on some \
            chips PG12; CAN3 at PA15, PB4"
)]
pub trait CanTx<C: Peripheral> {
    /// Sets the pin up, held recessive.
    fn into_transmit_pin(self) -> TransmitPin;
}

/// A pin that can carry the controller's receive line.
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot be the receive pin of the CAN controller `{C}`",
    note = "CAN1 receives at PA11, PB8, PD0, on some chips PG0 or PI9; CAN2 at PB5, PB12, on some \
            chips PG11; CAN3 at PA8, PB3"
)]
pub trait CanRx<C: Peripheral> {
    /// Sets the pin up, with a pull-up.
    fn into_receive_pin(self) -> C::Rx;
}

#[diagnostic::do_not_recommend]
impl<C, const PORT: char, const NUMBER: u8, MODE: PinMode> CanTx<C> for Pin<PORT, NUMBER, MODE>
where
    C: Peripheral<Tx: From<Pin<PORT, NUMBER, Output>>>,
{
    fn into_transmit_pin(self) -> TransmitPin {
        C::Tx::from(self.into_push_pull_output_in_state(PinState::High)).set_speed(Speed::High);
        let port_offset = const { PORT_DISTANCE * (PORT as usize - 'A' as usize) };
        let mut pin = TransmitPin { port_offset, shift: const { 2 * NUMBER as u32 }, mode: OUTPUT };
        pin.rest();
        pin
    }
}

#[diagnostic::do_not_recommend]
impl<C, const PORT: char, const NUMBER: u8, MODE: PinMode> CanRx<C> for Pin<PORT, NUMBER, MODE>
where
    C: Peripheral<Rx: From<Pin<PORT, NUMBER, Input>>>,
{
    fn into_receive_pin(self) -> C::Rx {
        C::Rx::from(self.into_input()).internal_resistor(Pull::Up)
    }
}

/// The transmit pin.
pub struct TransmitPin {
    /// The distance of the port's registers from those of port A in bytes.
    port_offset: usize,
    /// The first bit of the pin's mode in GPIOx_MODER.
    shift: u32,
    mode: u32,
}

impl TransmitPin {
    /// Gives the pin to the controller.
    pub fn connect(&mut self) {
        self.mode = ALTERNATE_FUNCTION;
        self.assert_mode();
    }

    /// Holds the line recessive, whatever the controller drives.
    pub fn rest(&mut self) {
        self.mode = OUTPUT;
        self.assert_mode();
    }

    /// Sets the mode again: a task of the product that changes the mode of another pin of the port may be interrupted
    /// between reading and writing the register, and take back what the interrupt has set.
    pub fn assert_mode(&mut self) {
        // SAFETY: the ports have equal registers at equal distances.
        let port = unsafe { &*GPIOA::ptr().byte_add(self.port_offset) };
        let (mask, mode) = (0b11_u32.wrapping_shl(self.shift), self.mode.wrapping_shl(self.shift));
        // SAFETY: only the bits of this pin change.
        port.moder().modify(|r, w| unsafe { w.bits(r.bits() & !mask | mode) });
    }
}
