//! The pins of the CAN controllers, which connect them to their transceivers according to the GPIO settings.

use super::{Chip, Problem, registers::Registers};
use crate::{
    Time,
    can::{Can, Pins, Transmit},
};

impl Registers for Can {
    fn reset(&mut self, _: Time) {
        (**self).reset();
    }

    fn read(&mut self, offset: u32, now: Time) -> Option<u32> {
        (**self).load(offset, now)
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
        if (**self).write(offset, value, now) { Ok(()) } else { Err(Problem::Unmodelled) }
    }
}

impl Chip {
    /// The pins that are connected to a controller now, CAN1 as 0. Its transceiver is at the transmit pin that the
    /// controller had last.
    fn can_pins(&mut self, can: usize) -> Pins {
        let connected = |line: usize| {
            let mut pins = self.part.can_pins(can).iter().map(|pins| pins[line]);
            pins.find(|(pin, function)| self.gpio.alternate_function(*pin) == Some(*function))
        };
        let receive = connected(0).is_some();
        if let Some((pin, _)) = connected(1) {
            self.transmit_pins[can] = Some(pin);
            return Pins { receive, transmit: Transmit::Controller };
        }
        let is_low = |pin| self.gpio.output(pin).level == Some(false);
        let transmit = match self.transmit_pins[can] {
            Some(pin) if is_low(pin) => Transmit::Dominant,
            _ => Transmit::Recessive,
        };
        Pins { receive, transmit }
    }

    /// Whether a controller has the pins that it needs; a silent one needs no transmit pin.
    pub(super) fn can_has_its_pins(&mut self, can: usize) -> bool {
        let Pins { transmit, receive } = self.can_pins(can);
        receive && (transmit == Transmit::Controller || self.cans[can].is_silent())
    }

    /// Connects the controllers to the pins that GPIO selects. A pin in any other mode leaves the
    /// bus recessive, but for a low output.
    pub(super) fn connect_cans(&mut self, now: Time) {
        self.note_receive_pin();
        for can in 0..self.cans.len() {
            let pins = self.can_pins(can);
            if self.cans_joined[can] != pins {
                self.cans_joined[can] = pins;
                self.cans[can].connect(pins, now);
                self.can_written = true;
            }
        }
    }

    /// Lets CAN2 have the filters that CAN1 has for it.
    pub(super) fn share_filters(&mut self) {
        if let [Can::Bxcan(can1), Can::Bxcan(can2), ..] = self.cans.as_mut_slice() {
            can2.share_filters(can1);
        }
    }
}
