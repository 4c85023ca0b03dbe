//! The pins of CAN1, which connect the controller to its transceiver according to the GPIO settings.

use super::Chip;
use crate::{Time, can::Pins};

impl Chip {
    /// The pins that are connected to CAN1 now.
    fn can1_pins(&self) -> Pins {
        let connected = |line: usize| {
            let mut pins = self.part.can1_pins().iter().map(|pins| pins[line]);
            pins.any(|(pin, function)| self.gpio.alternate_function(pin) == Some(function))
        };
        Pins { receive: connected(0), transmit: connected(1) }
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
