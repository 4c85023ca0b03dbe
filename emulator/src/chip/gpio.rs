//! GPIO ports (RM0090 chapter 8): mode, output with the time of the last change, external input.

use super::Part;
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
    /// The time of the last change.
    pub since: Time,
}

#[derive(Debug)]
struct Port {
    regs: [u32; 10],
    outside: [Option<bool>; 16],
    outputs: [Output; 16],
}

/// All ports of a part.
#[derive(Debug)]
pub struct Gpio {
    ports: Vec<Port>,
}

impl Port {
    fn new(index: usize) -> Self {
        let mut port = Self {
            regs: [0; 10],
            outside: [None; 16],
            outputs: [Output { level: None, since: Time::ZERO }; 16],
        };
        port.reset(index, Time::ZERO);
        port
    }

    fn reset(&mut self, index: usize, now: Time) {
        self.regs = [0; 10];
        let (moder, ospeedr, pupdr) = match index {
            0 => (0xA800_0000, 0x0C00_0000, 0x6400_0000),
            1 => (0x0000_0280, 0x0000_00C0, 0x0000_0100),
            _ => (0, 0, 0),
        };
        self.regs[0] = moder;
        self.regs[2] = ospeedr;
        self.regs[3] = pupdr;
        self.note_outputs(now);
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

impl Gpio {
    /// The ports of `part` after power-on, with nothing connected.
    pub fn new(part: Part) -> Self {
        Self { ports: (0..part.gpio_ports()).map(Port::new).collect() }
    }

    /// Resets every port; external connections remain.
    pub fn reset(&mut self, now: Time) {
        for index in 0..self.ports.len() {
            self.reset_port(index, now);
        }
    }

    /// Resets port number `index` (0 = A).
    pub fn reset_port(&mut self, index: usize, now: Time) {
        self.ports[index].reset(index, now);
    }

    /// The number of ports.
    pub fn ports(&self) -> usize {
        self.ports.len()
    }

    /// A register of port `index`, or `None` if it does not exist.
    pub fn read(&self, index: usize, offset: u32) -> Option<u32> {
        let port = self.ports.get(index)?;
        match offset {
            IDR => Some((0..16).map(|pin| u32::from(port.input(pin)) << pin).sum()),
            BSRR => Some(0),
            0x00..=AFRH => Some(port.reg(offset)),
            _ => None,
        }
    }

    /// Writes a register of port `index`; returns false if it does not exist.
    pub fn write(&mut self, index: usize, offset: u32, value: u32, now: Time) -> bool {
        let Some(port) = self.ports.get_mut(index) else {
            return false;
        };
        match offset {
            IDR => {}
            BSRR => {
                let odr = port.reg(ODR);
                port.regs[ODR as usize / 4] = odr & !(value >> 16) | value & 0xFFFF;
            }
            ODR => port.regs[ODR as usize / 4] = value & 0xFFFF,
            0x00..=AFRH => port.regs[offset as usize / 4] = value,
            _ => return false,
        }
        port.note_outputs(now);
        true
    }

    /// The output of the chip on `pin`. Panics if the part has no such pin.
    pub fn output(&self, pin: Pin) -> Output {
        self.ports[port_index(pin)].outputs[usize::from(pin.1)]
    }

    /// The level on `pin`, as its input register shows it. Panics if the part has no such pin.
    pub fn level(&self, pin: Pin) -> bool {
        self.ports[port_index(pin)].input(pin.1.into())
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
