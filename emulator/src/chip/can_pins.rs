//! The pins of CAN1, which connect the controller to its transceiver according to the GPIO settings.

use super::{Chip, Pin};
use crate::{Time, can::Pins};

/// Pins that can carry CAN1, receive and transmit, as alternate function 9 (F405 data sheet, table 9).
const CAN1_RX: [Pin; 4] = [Pin('A', 11), Pin('B', 8), Pin('D', 0), Pin('I', 9)];
const CAN1_TX: [Pin; 4] = [Pin('A', 12), Pin('B', 9), Pin('D', 1), Pin('H', 13)];

impl Chip {
    /// The pins that are connected to CAN1 now.
    fn can1_pins(&self) -> Pins {
        let connected =
            |pins: [Pin; 4]| pins.iter().any(|&pin| self.gpio.alternate_function(pin) == Some(9));
        Pins { transmit: connected(CAN1_TX), receive: connected(CAN1_RX) }
    }

    /// Whether CAN1 has the pins that it needs; a silent controller needs no transmit pin.
    pub(super) fn can1_has_its_pins(&self) -> bool {
        let Pins { transmit, receive } = self.can1_pins();
        receive && (transmit || self.can1.is_silent())
    }

    /// Connects CAN1 to the pins that GPIO selects. A pin in any other mode leaves the bus recessive.
    pub(super) fn connect_can(&mut self, now: Time) {
        let pins = self.can1_pins();
        if self.can1_joined != pins {
            self.can1_joined = pins;
            self.can1.connect(pins, now);
            self.can_written = true;
        }
    }
}
