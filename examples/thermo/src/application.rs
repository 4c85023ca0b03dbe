//! The objects of the thermometer, and what it makes of its sensors.

use canopen_node::{
    objects,
    pdo::{Rpdo, Tpdo},
};

/// The node with the application.
pub type Node = canopen_node::Node<Application>;

/// The emergency error code of the first sensor; those of the others follow.
pub const SENSOR_FAULT: u16 = canopen_node::error_code!(0x5031);
/// The bit of the error register 1001h for errors of a device profile.
pub const DEVICE_PROFILE: u8 = 1 << 5;

/// The voltages of a sensor in order, in mV: 10 mV a degree, 500 mV at 0 degrees, from -40 to 125 degrees.
const ORDERLY_MV: core::ops::RangeInclusive<u16> = 100..=1750;

objects! {
    /// The objects of the thermometer, with their values.
    pub struct Application, values Value;

    0x2100 "Gain of the sensors" {
        1..=4 "Gain" gains: [f32; 4] = [1.0; 4], rw in 0.5..=2.0, stored;
    }
    0x2101 {
        0 "Faulty sensors, a bit for each" faults: u8 = 0, ro;
    }
    0x6200 "Write output 8-bit" {
        1 "Relays" relays: u8 = 0, rww in 0..=3;
    }
    0x7130 "AI input process value" {
        1..=4 "Temperature in 0.1 degrees Celsius, sensor" temperatures: [i16; 4] = [0; 4], ro, mappable;
    }
}

impl canopen_node::Application for Application {
    /// CiA 404, with analogue inputs.
    const DEVICE_TYPE: u32 = 0x0002_0194;
    /// The temperatures.
    const TPDOS: &'static [Tpdo] =
        &[Tpdo::new(&[(0x7130, 1), (0x7130, 2), (0x7130, 3), (0x7130, 4)]).with_inhibit_time(1000)];
    /// The relays.
    const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x6200, 1)])];
}

/// What a step has found, a bit for each sensor or relay.
pub struct Step {
    pub relays: u8,
    pub new_faults: u8,
    pub ended_faults: u8,
}

impl Application {
    /// Takes the voltages of the sensors in mV. A faulty sensor keeps its last temperature.
    pub fn step(&mut self, millivolts: [u16; 4]) -> Step {
        let mut faults = 0;
        let sensors = self.temperatures.iter_mut().zip(self.gains).zip(millivolts);
        for (number, ((temperature, gain), mv)) in sensors.enumerate() {
            if ORDERLY_MV.contains(&mv) {
                *temperature = ((f32::from(mv) - 500.0) * gain) as i16;
            } else {
                faults |= 1 << number;
            }
        }
        let before = core::mem::replace(&mut self.faults, faults);
        Step { relays: self.relays, new_faults: faults & !before, ended_faults: before & !faults }
    }
}
