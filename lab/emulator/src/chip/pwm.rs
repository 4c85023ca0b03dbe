//! The outputs of the timers at the pins.

use super::{Chip, Pin};
use crate::Time;

/// The waveform of an output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pwm {
    pub period: Time,
    /// The part of each period in which the pin is high.
    pub high: Time,
}

impl Pwm {
    /// The frequency in Hz.
    pub fn hz(&self) -> f64 {
        1e12 / self.period.as_ps() as f64
    }

    /// The part of the time in which the pin is high, in percent.
    pub fn percent(&self) -> f64 {
        100.0 * self.high.as_ps() as f64 / self.period.as_ps() as f64
    }
}

/// Port, first pin, number of pins, timer, and the channel of the first pin; the pins that follow have the next channels.
/// By alternate function 1, 2, 3 and 9 (data sheets of the STM32F4).
type Pins = (char, u8, u8, usize, usize);
const AF1: &[Pins] = &[
    ('A', 8, 4, 1, 1),
    ('E', 9, 1, 1, 1),
    ('E', 11, 1, 1, 2),
    ('E', 13, 2, 1, 3),
    ('A', 0, 4, 2, 1),
    ('A', 5, 1, 2, 1),
    ('A', 15, 1, 2, 1),
    ('B', 3, 1, 2, 2),
    ('B', 10, 2, 2, 3),
];
const AF2: &[Pins] = &[
    ('A', 6, 2, 3, 1),
    ('B', 4, 2, 3, 1),
    ('C', 6, 4, 3, 1),
    ('B', 0, 2, 3, 3),
    ('B', 6, 4, 4, 1),
    ('D', 12, 4, 4, 1),
    ('A', 0, 4, 5, 1),
    ('H', 10, 3, 5, 1),
    ('I', 0, 1, 5, 4),
];
const AF3: &[Pins] = &[
    ('C', 6, 4, 8, 1),
    ('I', 5, 3, 8, 1),
    ('I', 2, 1, 8, 4),
    ('A', 2, 2, 9, 1),
    ('E', 5, 2, 9, 1),
    ('B', 8, 1, 10, 1),
    ('F', 6, 1, 10, 1),
    ('B', 9, 1, 11, 1),
    ('F', 7, 1, 11, 1),
];
const AF9: &[Pins] = &[
    ('B', 14, 2, 12, 1),
    ('H', 6, 1, 12, 1),
    ('H', 9, 1, 12, 2),
    ('A', 6, 1, 13, 1),
    ('F', 8, 1, 13, 1),
    ('A', 7, 1, 14, 1),
    ('F', 9, 1, 14, 1),
];

impl Chip {
    /// The waveform that a timer makes now at a pin in its alternate function; `None` if there is none.
    pub fn pwm(&mut self, pin: Pin, now: Time) -> Option<Pwm> {
        let pins = match self.gpio.alternate_function(pin)? {
            1 => AF1,
            2 => AF2,
            3 => AF3,
            9 => AF9,
            _ => return None,
        };
        let has = |(port, first, count, ..): &&Pins| {
            *port == pin.0 && (*first..first + count).contains(&pin.1)
        };
        let (_, first, _, timer, channel) = pins.iter().find(has)?;
        let timer = &mut self.timers[timer - 1];
        timer.advance(now);
        timer.output(channel - 1 + usize::from(pin.1 - first))
    }
}
