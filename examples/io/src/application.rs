//! The objects of the example: digital and analogue I/O after CiA 401.

use canopen_node::{
    application::{Domain, Text},
    objects,
    pdo::{Rpdo, Tpdo},
    sdo::Abort,
};

/// The node with the application.
pub type Node = canopen_node::Node<Application>;

objects! {
    /// The objects of the I/O device, with their values.
    pub struct Application, values Value;

    0x2100 {
        0 "Filter constant of the temperature" filter: u8 = 3, rw in 0..=8, stored;
    }
    0x2101 "Calibration of the temperature" {
        1 "Gain" gain: f32 = 1.0, rw in 0.5..=2.0, stored;
        2 "Time in milliseconds since 1970" calibrated: i64 = 0, rw, stored;
        3 "Inspector" inspector: Text<16> = Text::EMPTY, rw, stored;
    }
    0x2102 {
        0 "Transfer test" transfer_test: Domain = Domain, rw;
    }
    0x2103 "Echo test" {
        1 "Sent" echo_sent: u8 = 0, wo, mappable;
        2 "Returned" echo_returned: u8 = 0, ro, mappable;
    }
    0x6000 "Read input 8-bit" {
        1 "Button" inputs: u8 = 0, ro, mappable;
    }
    0x6200 "Write output 8-bit" {
        1 "LEDs" outputs: u8 = 0, rww;
    }
    0x6401 "Read analogue input 16-bit" {
        1 "Temperature in 0.1 degrees Celsius" temperature: i16 = 0, ro, mappable;
    }
    0x6426 "Analogue input interrupt delta unsigned" {
        1 "Temperature in 0.1 degrees Celsius" delta: u32 = 5, rw, stored;
    }
}

impl canopen_node::Application for Application {
    /// CiA 401, with digital inputs and outputs and analogue inputs.
    const DEVICE_TYPE: u32 = 0x0007_0191;
    const SETTINGS_BY_SDO: bool = true;
    /// The button, the temperature, and two for a master to map.
    const TPDOS: &'static [Tpdo] = &[
        Tpdo::new(&[(0x6000, 1)]),
        Tpdo::new(&[(0x6401, 1)]).with_event_timer(1000).with_inhibit_time(100),
        Tpdo::UNUSED,
        Tpdo::UNUSED,
    ];
    /// The LEDs, and three for a master to map.
    const RPDOS: &'static [Rpdo] =
        &[Rpdo::new(&[(0x6200, 1)]), Rpdo::UNUSED, Rpdo::UNUSED, Rpdo::UNUSED];
    /// Two nodes, such as the master and a neighbour.
    const PRODUCERS: usize = 2;

    fn accept(&mut self, value: &Value) -> Result<(), Abort> {
        match value {
            Value::Outputs(4..) => return Err(Abort::InvalidValue), // There are two LEDs.
            // A master measures the way of a value from an RPDO to a TPDO.
            Value::EchoSent(value) => self.echo_returned = *value,
            _ => {}
        }
        Ok(())
    }

    // The only domain is the transfer test. Its content is known to both sides, so that it takes no memory.

    fn domain_len(&mut self, _: u16, _: u8) -> Result<u32, Abort> {
        Ok(TEST_LEN)
    }

    fn read_domain(&self, _: u16, _: u8, offset: u32, to: &mut [u8]) -> usize {
        to.iter_mut().zip(test_content(offset)).map(|(to, byte)| *to = byte).count()
    }

    fn begin_domain(&mut self, _: u16, _: u8, announced: Option<u32>) -> Result<(), Abort> {
        if announced.is_some_and(|len| len > TEST_LEN) { Err(Abort::TooLong) } else { Ok(()) }
    }

    fn write_domain(&mut self, _: u16, _: u8, offset: u32, bytes: &[u8]) -> Result<(), Abort> {
        let mut expected = test_content(offset);
        for &byte in bytes {
            match expected.next() {
                Some(expected) if byte == expected => {}
                Some(_) => return Err(Abort::InvalidValue),
                None => return Err(Abort::TooLong),
            }
        }
        Ok(())
    }

    fn end_domain(&mut self, _: u16, _: u8, len: u32) -> Result<(), Abort> {
        if len < TEST_LEN { Err(Abort::TooShort) } else { Ok(()) }
    }
}

/// The length of the transfer test in bytes.
const TEST_LEN: u32 = 100_000;

/// The content of the transfer test from `offset` on, by which a master measures the bus in both directions: the
/// highest byte of each offset times 2654435761.
pub fn test_content(offset: u32) -> impl Iterator<Item = u8> {
    (offset..TEST_LEN).map(|offset| (offset.wrapping_mul(2_654_435_761) >> 24) as u8)
}

/// What the board measures.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Whether the button is pressed.
    pub is_pressed: bool,
    /// The temperature of the chip in 0.1 degrees Celsius.
    pub temperature: i16,
}

/// The low-pass filter of the temperature.
#[derive(Clone, Copy, Debug, Default)]
pub struct Filter {
    /// The filtered temperature in 1/256 of 0.1 degrees Celsius; `None` before the first sample.
    filtered: Option<i32>,
}

impl Filter {
    /// The filtered temperature after `sample`. Each step of `constant` doubles the time of the filter.
    pub fn next(&mut self, sample: i16, constant: u8) -> i16 {
        let sample = i32::from(sample) << 8;
        let filtered = self.filtered.get_or_insert(sample);
        *filtered += (sample - *filtered) >> constant.min(8);
        (*filtered >> 8) as i16
    }
}

impl Application {
    /// Takes a sample and returns the state of the LEDs. The temperature changes, and is sent, when it differs by at
    /// least the delta 6426h from the one sent before.
    pub fn step(&mut self, sample: Sample, filter: &mut Filter) -> u8 {
        self.inputs = sample.is_pressed.into();
        let calibrated = (f32::from(sample.temperature) * self.gain) as i16;
        let temperature = filter.next(calibrated, self.filter);
        if u32::from(temperature.abs_diff(self.temperature)) >= self.delta {
            self.temperature = temperature;
        }
        self.outputs
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The temperature after a sample, without a filter.
    fn after(io: &mut Application, temperature: i16) -> i16 {
        io.filter = 0;
        io.step(Sample { is_pressed: false, temperature }, &mut Filter::default());
        io.temperature
    }

    #[test]
    fn the_temperature_changes_by_at_least_the_delta() {
        let mut io = Application::new();
        io.delta = 5;
        let reported = [250, 254, 255, 251, 250].map(|temperature| after(&mut io, temperature));
        assert_eq!(reported, [250, 250, 255, 255, 250]);
    }

    #[test]
    fn the_gain_calibrates_the_temperature() {
        let mut io = Application::new();
        io.gain = 1.1;
        assert_eq!(after(&mut io, 250), 275);
    }

    #[test]
    fn the_filter_follows_the_coldest_and_the_hottest_sample() {
        let mut filter = Filter::default();
        for sample in [i16::MIN, i16::MAX] {
            for _ in 0..100 {
                filter.next(sample, 0);
            }
            assert_eq!(filter.next(sample, 0), sample);
        }
    }
}
