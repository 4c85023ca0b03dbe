//! SPI masters with devices that a test supplies.

use std::sync::{Arc, Mutex};

use emulator::{
    Time,
    chip::{Part, Pin, Problem, SpiDevice},
};

use crate::rig::{GPIOA, RCC_AHB1ENR, RCC_APB1ENR, RCC_APB2ENR, Rig};

const SPI1: u32 = 0x4001_3000;
const SPI2: u32 = 0x4000_3800;
const CR1: u32 = 0x00;
const CR2: u32 = 0x04;
const SR: u32 = 0x08;
const DR: u32 = 0x0C;
const RXNE: u32 = 1 << 0;
const BSY: u32 = 1 << 7;
/// SSM, SSI, SPE and MSTR: 8 MHz of 16.
const MASTER: u32 = 1 << 9 | 1 << 8 | 1 << 6 | 1 << 2;
const DFF: u32 = 1 << 11;

/// Notes what it gets, and gives the words AB81h, AB82h and so on.
#[derive(Clone, Default)]
struct Sensor(Arc<Mutex<Vec<String>>>);

impl Sensor {
    fn noted(&self) -> Vec<String> {
        std::mem::take(&mut self.0.lock().expect("no panic"))
    }
}

impl SpiDevice for Sensor {
    fn select(&mut self, is_selected: bool) {
        self.0.lock().expect("no panic").push(format!("select {is_selected}"));
    }

    fn transfer(&mut self, word: u16) -> u16 {
        let mut noted = self.0.lock().expect("no panic");
        noted.push(format!("{word:X}"));
        0xAB80 + noted.len() as u16
    }
}

/// A chip with SPI1 on, and the sensor at PA4, which is an output.
fn with_sensor() -> (Rig, Sensor) {
    let mut rig = Rig::new(Part::Stm32f446);
    let sensor = Sensor::default();
    rig.connect_spi(1, Pin('A', 4), Box::new(sensor.clone()));
    rig.write_all(&[(RCC_AHB1ENR, 1), (RCC_APB2ENR, 1 << 12), (RCC_APB1ENR, 1 << 14)]);
    select(&mut rig, false);
    rig.write_all(&[(GPIOA, 0xA800_0000 | 1 << 8), (SPI1 + CR1, MASTER)]);
    assert_eq!(sensor.noted(), [""; 0]);
    (rig, sensor)
}

fn select(rig: &mut Rig, is_selected: bool) {
    rig.write(GPIOA + 0x18, 1 << (4 + if is_selected { 16 } else { 0 }));
}

/// Sends a word, and waits for the one that comes.
fn transfer(rig: &mut Rig, word: u32) -> u32 {
    rig.write(SPI1 + DR, word);
    rig.now += Time::from_us(3);
    assert_eq!(rig.read(SPI1 + SR) & (RXNE | BSY), RXNE);
    rig.read(SPI1 + DR)
}

#[test]
fn a_device_takes_and_gives_words_while_its_pin_is_low() {
    let (mut rig, sensor) = with_sensor();
    select(&mut rig, true);
    assert_eq!([transfer(&mut rig, 0xA5), transfer(&mut rig, 1)], [0x82, 0x83]);
    select(&mut rig, false);
    assert_eq!(transfer(&mut rig, 2), 0xFF, "nobody drives MISO");
    assert_eq!(sensor.noted(), ["select true", "A5", "1", "select false"]);
    rig.write_all(&[(SPI1 + CR1, 0), (SPI1 + CR1, MASTER | DFF)]);
    select(&mut rig, true);
    assert_eq!(transfer(&mut rig, 0xBEEF), 0xAB82);
    assert_eq!(sensor.noted(), ["select true", "BEEF"]);
    assert_eq!(rig.problems(), []);
}

#[test]
fn a_word_takes_its_time_and_interrupts() {
    let (mut rig, _) = with_sensor();
    select(&mut rig, true);
    rig.write_all(&[(SPI1 + CR2, 1 << 6), (SPI1 + DR, 0)]);
    rig.advance(Time::from_ns(900));
    assert_eq!(rig.irqs(), 0);
    assert_eq!(rig.at(Time::from_ns(900)).read(SPI1 + SR) & (RXNE | BSY), BSY);
    let mut now = rig.next_event();
    while rig.irqs() == 0 && now < Time::from_us(2) {
        rig.advance(now);
        now = rig.next_event();
    }
    assert_eq!(rig.irqs(), 1 << 35);
    rig.now = Time::from_ns(1_200);
    assert_eq!((rig.read(SPI1 + SR) & RXNE, rig.read(SPI1 + DR)), (RXNE, 0x82));
    assert_eq!(rig.irqs(), 0);
    rig.write(SPI2 + CR1, MASTER);
    assert_eq!(rig.problems(), []);
}

#[test]
fn a_slave_and_its_dma_are_not_modelled() {
    for (register, value) in [(CR1, 1 << 6), (CR2, 1 << 1), (0x1C, 1 << 11)] {
        let (mut rig, _) = with_sensor();
        rig.write(SPI1 + register, value);
        assert_eq!(rig.problems(), [Problem::Unmodelled], "{register:x}");
    }
}
