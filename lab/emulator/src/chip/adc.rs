//! ADC1 (RM0090 chapter 13): single conversions by software, with the temperature sensor and the voltage reference.

use super::{Part, Problem, registers::Registers};
use crate::{Time, can::Clock};

const SR: u32 = 0x00;
const CR1: u32 = 0x04;
const CR2: u32 = 0x08;
const SMPR1: u32 = 0x0C;
const SMPR2: u32 = 0x10;
const SQR1: u32 = 0x2C;
const SQR3: u32 = 0x34;
const JDR4: u32 = 0x48;
const DR: u32 = 0x4C;
const CSR: u32 = 0x300;
const CCR: u32 = 0x304;

const EOC: u32 = 1 << 1;
const STRT: u32 = 1 << 4;
const OVR: u32 = 1 << 5;
const EOCIE: u32 = 1 << 5;
const SCAN: u32 = 1 << 8;
const ADON: u32 = 1 << 0;
const CONT: u32 = 1 << 1;
const DMA: u32 = 1 << 8;
const SWSTART: u32 = 1 << 30;
const EXTEN: u32 = 3 << 28;
const TSVREFE: u32 = 1 << 23;

/// The internal voltage reference (data sheet: VREFINT).
const REFERENCE_MV: u32 = 1_210;
/// The supply at which the factory calibrates.
const CALIBRATION_MV: u32 = 3_300;
/// The highest frequency of the converter at 2.4 to 3.6 V (data sheet: fADC).
const MAX_HZ: u64 = 36_000_000;
const REFERENCE: u32 = 17;

/// The analogue world around a chip.
#[derive(Clone, Copy, Debug)]
pub struct Analogue {
    /// The supply VDDA, which is also the reference VREF+.
    pub supply_mv: u32,
    /// The temperature of the chip in degrees Celsius.
    pub temperature: i32,
    /// The voltages at the channels 0 to 15.
    pub channels_mv: [u32; 16],
}

impl Default for Analogue {
    /// 3 V, 25 degrees, all channels at ground.
    fn default() -> Self {
        Self { supply_mv: 3_000, temperature: 25, channels_mv: [0; 16] }
    }
}

/// The voltage of the temperature sensor: 0.76 V at 25 degrees, 2.5 mV more for each degree (data sheet).
fn sensor_uv(temperature: i32) -> u32 {
    (760_000 + 2_500 * (temperature - 25)).max(0) as u32
}

/// The result of a conversion of `uv` microvolts with 12 bits.
fn sample(uv: u32, supply_mv: u32) -> u16 {
    (u64::from(uv) * 4_095 / (u64::from(supply_mv.max(1)) * 1_000)).min(4_095) as u16
}

/// The factory's calibration values: the voltage reference, the sensor at 30 and at 110 degrees.
pub fn calibration() -> [u16; 3] {
    [REFERENCE_MV * 1_000, sensor_uv(30), sensor_uv(110)].map(|uv| sample(uv, CALIBRATION_MV))
}

#[derive(Debug)]
pub struct Adc {
    part: Part,
    clock: Clock,
    /// The registers up to SQR3.
    regs: [u32; 20],
    common: u32,
    data: u16,
    /// The end of the running conversion.
    end: Option<Time>,
    pub analogue: Analogue,
}

impl Adc {
    /// The converter of `part` after a reset.
    pub fn new(part: Part) -> Self {
        Self {
            part,
            clock: Clock { hz: 16_000_000, ppm: 0 },
            regs: [0; 20],
            common: 0,
            data: 0,
            end: None,
            analogue: Analogue::default(),
        }
    }

    /// Sets the clock of APB2.
    pub fn set_clock(&mut self, clock: Clock) {
        self.clock = clock;
    }

    pub fn irq(&self) -> bool {
        self.reg(SR) & EOC != 0 && self.reg(CR1) & EOCIE != 0
    }

    pub fn deadline(&self) -> Time {
        self.end.unwrap_or(Time::MAX)
    }

    /// Completes a conversion whose end has come.
    pub fn advance(&mut self, now: Time) {
        if self.end.is_none_or(|end| now < end) {
            return;
        }
        self.end = None;
        self.data = self.convert();
        if self.reg(SR) & EOC != 0 {
            self.regs[0] |= OVR;
        }
        self.regs[0] |= EOC;
    }

    fn reg(&self, offset: u32) -> u32 {
        self.regs[offset as usize / 4]
    }

    fn channel(&self) -> u32 {
        self.reg(SQR3) & 0x1F
    }

    fn convert(&self) -> u16 {
        let is_internal_on = self.common & TSVREFE != 0;
        let uv = match self.channel() {
            channel if channel == self.part.temperature_channel() && is_internal_on => {
                sensor_uv(self.analogue.temperature)
            }
            REFERENCE if is_internal_on => REFERENCE_MV * 1_000,
            channel @ 0..=15 => self.analogue.channels_mv[channel as usize] * 1_000,
            _ => 0,
        };
        sample(uv, self.analogue.supply_mv)
    }

    fn divider(&self) -> u64 {
        2 * (u64::from(self.common >> 16 & 3) + 1)
    }

    /// Sampling and 12 cycles of conversion (RM0090 13.5).
    fn conversion_time(&self) -> Time {
        const SAMPLING: [u64; 8] = [3, 15, 28, 56, 84, 112, 144, 480];
        let channel = self.channel();
        let (register, at) = if channel < 10 { (SMPR2, channel) } else { (SMPR1, channel - 10) };
        let sampling = SAMPLING[(self.reg(register) >> (3 * at) & 7) as usize];
        let cycles = (sampling + 12) * self.divider();
        Time::from_ps(cycles * 1_000_000_000_000 / u64::from(self.clock.hz.max(1)))
    }

    fn start(&mut self, now: Time) -> Result<(), Problem> {
        if self.reg(CR2) & ADON == 0 {
            return Err(Problem::Misuse("a conversion is started while the ADC is off"));
        }
        self.regs[0] |= STRT;
        self.end = Some(now + self.conversion_time());
        if u64::from(self.clock.hz) / self.divider() > MAX_HZ {
            return Err(Problem::Misuse("the ADC's clock is above 36 MHz"));
        }
        Ok(())
    }
}

impl Registers for Adc {
    /// Clock and surroundings remain.
    fn reset(&mut self, _: Time) {
        *self = Self { clock: self.clock, analogue: self.analogue, ..Self::new(self.part) };
    }

    fn read(&mut self, offset: u32, now: Time) -> Option<u32> {
        self.advance(now);
        Some(match offset {
            DR => {
                self.regs[0] &= !EOC;
                self.data.into()
            }
            CSR => self.reg(SR) & 0x3F,
            CCR => self.common,
            SR..=JDR4 => self.reg(offset),
            _ => return None,
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
        self.advance(now);
        match offset {
            // Cleared by writing 0.
            SR => self.regs[0] &= value,
            CR2 => {
                self.regs[offset as usize / 4] = value & !SWSTART;
                if value & (CONT | DMA | EXTEN) != 0 {
                    return Err(Problem::Unmodelled);
                }
                if value & SWSTART != 0 {
                    return self.start(now);
                }
            }
            CR1 | SMPR1..=SQR3 => {
                self.regs[offset as usize / 4] = value;
                let is_sequence = offset == CR1 && value & SCAN != 0;
                let is_long = offset == SQR1 && value >> 20 & 0xF != 0;
                if is_sequence || is_long {
                    return Err(Problem::Unmodelled);
                }
            }
            CCR => self.common = value,
            _ => return Err(Problem::Unmodelled),
        }
        Ok(())
    }
}
