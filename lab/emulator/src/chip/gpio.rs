//! GPIO ports (RM0090 chapter 8): mode, output with the time of the last change, external input.

use super::{Part, Problem, part::Family, registers::Registers};
use crate::Time;

const MODER: u32 = 0x00;
const PUPDR: u32 = 0x0C;
const IDR: u32 = 0x10;
const ODR: u32 = 0x14;
const BSRR: u32 = 0x18;
const AFRL: u32 = 0x20;
const AFRH: u32 = 0x24;

/// A pin: port letter and number, as in `Pin('D', 12)`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Pin(pub char, pub u8);

/// The output of the chip on a pin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Output {
    /// The level, or `None` while the pin is not a general purpose output.
    pub level: Option<bool>,
    pub since: Time,
}

#[derive(Debug)]
pub(super) struct Port {
    family: Family,
    index: usize,
    regs: [u32; 10],
    outside: [Option<bool>; 16],
    outputs: [Output; 16],
}

#[derive(Debug)]
pub struct Gpio {
    ports: Vec<Port>,
}

impl Port {
    fn new(family: Family, index: usize) -> Self {
        let mut port = Self {
            family,
            index,
            regs: [0; 10],
            outside: [None; 16],
            outputs: [Output { level: None, since: Time::ZERO }; 16],
        };
        port.reset(Time::ZERO);
        port
    }

    fn reg(&self, offset: u32) -> u32 {
        self.regs[offset as usize / 4]
    }

    fn mode(&self, pin: usize) -> u32 {
        self.reg(MODER) >> (2 * pin) & 3
    }

    fn input(&self, pin: usize) -> bool {
        match self.mode(pin) {
            1 => self.reg(ODR) >> pin & 1 == 1,
            3 => false,
            _ => self.outside[pin].unwrap_or(self.reg(PUPDR) >> (2 * pin) & 3 == 1),
        }
    }

    fn note_outputs(&mut self, now: Time) {
        for pin in 0..16 {
            let level = (self.mode(pin) == 1).then(|| self.reg(ODR) >> pin & 1 == 1);
            if self.outputs[pin].level != level {
                self.outputs[pin] = Output { level, since: now };
            }
        }
    }
}

impl Registers for Port {
    /// External connections remain.
    fn reset(&mut self, now: Time) {
        self.regs = [0; 10];
        let (moder, ospeedr, pupdr) = match self.index {
            0 => (0xA800_0000, 0x0C00_0000, 0x6400_0000),
            1 => (0x0000_0280, 0x0000_00C0, 0x0000_0100),
            _ => (0, 0, 0),
        };
        // Unused pins of an STM32G4 are analogue (RM0440 9.4.1).
        self.regs[0] = match (self.family, self.index) {
            (Family::F4, _) => moder,
            (Family::G4, 0) => 0xABFF_FFFF,
            (Family::G4, 1) => 0xFFFF_FEBF,
            (Family::G4, _) => u32::MAX,
        };
        self.regs[2] = ospeedr;
        self.regs[3] = pupdr;
        self.note_outputs(now);
    }

    fn read(&mut self, offset: u32, _: Time) -> Option<u32> {
        match offset {
            IDR => Some((0..16).map(|pin| u32::from(self.input(pin)) << pin).sum()),
            BSRR => Some(0),
            0x00..=AFRH => Some(self.reg(offset)),
            _ => None,
        }
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
        match offset {
            IDR => {}
            BSRR => {
                let odr = self.reg(ODR);
                self.regs[ODR as usize / 4] = odr & !(value >> 16) | value & 0xFFFF;
            }
            ODR => self.regs[ODR as usize / 4] = value & 0xFFFF,
            0x00..=AFRH => self.regs[offset as usize / 4] = value,
            _ => return Err(Problem::Unmodelled),
        }
        self.note_outputs(now);
        Ok(())
    }
}

impl Gpio {
    /// The ports of `part` after power-on, with nothing connected.
    pub fn new(part: Part) -> Self {
        let port = |index| Port::new(part.family(), index);
        Self { ports: (0..part.gpio_ports()).map(port).collect() }
    }

    pub(super) fn len(&self) -> usize {
        self.ports.len()
    }

    /// Port number `index` (0 = A).
    pub(super) fn port(&mut self, index: usize) -> Option<&mut Port> {
        self.ports.get_mut(index)
    }

    /// The output of the chip on `pin`. Panics if the part has no such pin.
    pub fn output(&self, pin: Pin) -> Output {
        self.ports[port_index(pin)].outputs[usize::from(pin.1)]
    }

    /// The level on `pin`, as its input register shows it. Panics if the part has no such pin.
    pub fn level(&self, pin: Pin) -> bool {
        self.ports[port_index(pin)].input(pin.1.into())
    }

    /// The external level that `pin` is connected to, if it is.
    pub(super) fn outside(&self, pin: Pin) -> Option<bool> {
        self.ports[port_index(pin)].outside[usize::from(pin.1)]
    }

    /// Connects `pin` to an external level, or leaves it open. Panics if the part has no such pin.
    pub fn set_input(&mut self, pin: Pin, level: Option<bool>) {
        self.ports[port_index(pin)].outside[usize::from(pin.1)] = level;
    }

    /// The alternate function selected for `pin`, if the pin exists and has one selected.
    pub fn alternate_function(&self, pin: Pin) -> Option<u32> {
        let port = self.ports.get(port_index(pin))?;
        let number = usize::from(pin.1);
        let register = if number < 8 { AFRL } else { AFRH };
        (port.mode(number) == 2).then(|| port.reg(register) >> (4 * (number % 8)) & 0xF)
    }
}

fn port_index(pin: Pin) -> usize {
    assert!(pin.0.is_ascii_uppercase() && pin.1 < 16, "no such pin: P{}{}", pin.0, pin.1);
    usize::from(pin.0 as u8 - b'A')
}
