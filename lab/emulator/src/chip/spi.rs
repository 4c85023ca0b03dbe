//! SPI1 to SPI6 as masters (RM0090 chapter 28): rsemu's model, with devices that a test supplies, and without DMA and I2S.

use std::{
    fmt,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use rsemu::{
    bus::spi::{ChipSelect, Format, Link, SpiBus, SpiSlave},
    core::{
        device::{Device, ResetKind},
        space::{MemAttrs, MemOps, RegionKind},
    },
    dev::stm32::spi::{Stm32Spi, Variant},
};

use super::{
    Chip, Pin, Problem,
    registers::{Apb, Place, Registers},
};
use crate::{
    Time,
    can::{Clock, timing::SCALE},
};

const CR1: u32 = 0x00;
const CR2: u32 = 0x04;
const DR: u32 = 0x0C;
const I2SCFGR: u32 = 0x1C;
const LAST: u32 = 0x20;

const MSTR: u32 = 1 << 2;
const SPE: u32 = 1 << 6;
/// The interrupts and the DMA requests of CR2.
const INTERRUPTS: u32 = 7 << 5;
const DMA: u32 = 3;
const I2SMOD: u32 = 1 << 11;

/// A device at an SPI master, such as a closure that gives the word for each that it takes.
pub trait SpiDevice: Send {
    /// Its chip select becomes active, low, or inactive.
    fn select(&mut self, _is_selected: bool) {}

    /// Takes a word of 8 or 16 bits, and gives the one that the master receives at the same time.
    fn transfer(&mut self, word: u16) -> u16;
}

impl<F: FnMut(u16) -> u16 + Send> SpiDevice for F {
    fn transfer(&mut self, word: u16) -> u16 {
        self(word)
    }
}

/// What is connected to a master: each device with its chip select.
#[derive(Default)]
struct Devices(Mutex<Vec<Connected>>);

struct Connected {
    device: Box<dyn SpiDevice>,
    chip_select: Pin,
    is_selected: bool,
}

impl Devices {
    fn lock(&self) -> MutexGuard<'_, Vec<Connected>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Devices {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.lock().iter().map(|connected| connected.chip_select)).finish()
    }
}

/// The one slave of rsemu's bus, which passes each word on to the selected device.
impl SpiSlave for Devices {
    fn format(&self) -> Format {
        // The master takes the lower 8 bits if its words have no more.
        Format { bits: 16, ..Format::DEFAULT }
    }

    fn select(&self, _: bool) {}

    fn transfer(&self, word: u32) -> u32 {
        let mut devices = self.lock();
        let selected = devices.iter_mut().find(|connected| connected.is_selected);
        // Nobody drives MISO.
        selected.map_or(u32::MAX, |selected| selected.device.transfer(word as u16).into())
    }
}

/// The properties in which the masters differ.
#[derive(Debug)]
pub struct Kind {
    pub place: Place,
    irq: u32,
}

/// SPI1 to SPI6 (RM0090 2.3, 7.3 and table 62).
pub static KINDS: [Kind; 6] = [
    Kind { place: (Apb::Two, 12), irq: 35 },
    Kind { place: (Apb::One, 14), irq: 36 },
    Kind { place: (Apb::One, 15), irq: 51 },
    Kind { place: (Apb::Two, 13), irq: 84 },
    Kind { place: (Apb::Two, 20), irq: 85 },
    Kind { place: (Apb::Two, 21), irq: 86 },
];

/// A master on the clock of its bus.
#[derive(Debug)]
pub struct Spi {
    kind: &'static Kind,
    model: Stm32Spi,
    bus: Arc<SpiBus>,
    devices: Arc<Devices>,
    cr2: u32,
    clock: Clock,
    /// The periods of the clock until `since`, when it became this one.
    periods: u64,
    since: Time,
}

impl Spi {
    /// The state after a reset, on a clock of 16 MHz.
    pub fn new(kind: &'static Kind) -> Self {
        const ONLY: ChipSelect = ChipSelect(0);
        let (bus, devices) = (Arc::new(SpiBus::new()), Arc::<Devices>::default());
        bus.attach(ONLY, devices.clone()).expect("the bus is empty");
        Self {
            kind,
            model: Stm32Spi::with_bus(Variant::F4, Link::Transactional, Some(bus.clone()), ONLY),
            bus,
            devices,
            cr2: 0,
            clock: Clock { hz: 16_000_000, ppm: 0 },
            periods: 0,
            since: Time::ZERO,
        }
    }

    pub fn place(&self) -> Place {
        self.kind.place
    }

    /// The level of its interrupt, bit n for interrupt n.
    pub fn irqs(&self) -> u128 {
        u128::from(self.may_interrupt() && self.model.irq_asserted()) << self.kind.irq
    }

    fn may_interrupt(&self) -> bool {
        self.cr2 & INTERRUPTS != 0
    }

    /// The next change of the master, if it may interrupt.
    pub fn deadline(&self) -> Time {
        if !self.may_interrupt() {
            return Time::MAX;
        }
        let Some(next) = self.model.next_event_tick() else { return Time::MAX };
        let periods = u128::from(next.saturating_sub(self.periods));
        self.since + Time::from_ps((periods * SCALE).div_ceil(self.clock.rate()) as u64)
    }

    pub fn set_clock(&mut self, clock: Clock, now: Time) {
        if self.clock != clock {
            self.advance(now);
            (self.periods, self.since, self.clock) = (self.periods_until(now), now, clock);
        }
    }

    pub fn advance(&mut self, now: Time) {
        // NSS of the master is not connected: the pins select the devices.
        self.bus.select(Some(ChipSelect(0)));
        self.model.advance_to(self.periods_until(now));
    }

    fn periods_until(&self, now: Time) -> u64 {
        let time = u128::from(now.saturating_sub(self.since).as_ps());
        self.periods + (time * self.clock.rate() / SCALE) as u64
    }

    /// Selects each device whose pin `is_low`.
    pub fn follow_pins(&mut self, is_low: impl Fn(Pin) -> bool) {
        for connected in self.devices.lock().iter_mut() {
            let is_selected = is_low(connected.chip_select);
            if is_selected != connected.is_selected {
                connected.is_selected = is_selected;
                connected.device.select(is_selected);
            }
        }
    }

    fn access(&self, access: impl FnOnce(&dyn MemOps)) {
        let region = self.model.region("").expect("the registers");
        if let RegionKind::Io(registers) = region.kind() {
            access(&**registers);
        }
    }
}

impl Registers for Spi {
    /// The devices stay.
    fn reset(&mut self, now: Time) {
        self.advance(now);
        self.model.reset(ResetKind::Warm);
        self.cr2 = 0;
    }

    fn read(&mut self, offset: u32, now: Time) -> Option<u32> {
        self.advance(now);
        let mut bytes = [0; 4];
        self.access(|registers| {
            registers
                .read(offset.into(), &mut bytes, MemAttrs::default())
                .expect("a word of the registers");
        });
        (offset <= LAST).then_some(u32::from_le_bytes(bytes))
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
        self.advance(now);
        let is_byte = offset == DR && self.model.format().bits == 8;
        let word = if is_byte { value & 0xFF } else { value };
        self.access(|registers| {
            registers
                .write(offset.into(), &word.to_le_bytes(), MemAttrs::default())
                .expect("a word of the registers");
        });
        if offset == CR2 {
            self.cr2 = value;
        }
        let is_modelled = match offset {
            CR1 => value & (SPE | MSTR) != SPE,
            CR2 => value & DMA == 0,
            I2SCFGR => value & I2SMOD == 0,
            _ => offset <= LAST,
        };
        if is_modelled { Ok(()) } else { Err(Problem::Unmodelled) }
    }
}

impl Chip {
    /// Connects a device to a master, 1 for SPI1, that selects it by this pin, low.
    ///
    /// # Panics
    /// There is no such master.
    pub fn connect_spi(&mut self, number: usize, chip_select: Pin, device: Box<dyn SpiDevice>) {
        let connected = Connected { device, chip_select, is_selected: false };
        self.spis[number - 1].devices.lock().push(connected);
        self.select_spi_devices();
    }

    /// Selects the devices by the levels of the pins.
    pub(super) fn select_spi_devices(&mut self) {
        let gpio = &self.gpio;
        for spi in &mut self.spis {
            spi.follow_pins(|pin| gpio.output(pin).level == Some(false));
        }
    }
}
