//! A chip without a CPU, each of its CAN controllers on a bus with an adapter, and the names of registers and bits.

use std::ops::{Deref, DerefMut};

use emulator::{
    Time,
    can::{Adapter, Bus, Clock, Frame, Id, Station, bxcan::CanVariant},
    chip::{Access, BusFault, Chip, ChipVariant, Part, Pin, Problem, ResetCause, Width},
};

pub const RCC_CR: u32 = 0x4002_3800;
pub const RCC_PLLCFGR: u32 = 0x4002_3804;
pub const RCC_CFGR: u32 = 0x4002_3808;
pub const RCC_APB1RSTR: u32 = 0x4002_3820;
pub const RCC_AHB1ENR: u32 = 0x4002_3830;
pub const RCC_APB1ENR: u32 = 0x4002_3840;
pub const RCC_APB2ENR: u32 = 0x4002_3844;
pub const RCC_CSR: u32 = 0x4002_3874;
pub const FLASH_ACR: u32 = 0x4002_3C00;
pub const PWR_CR: u32 = 0x4000_7000;
pub const GPIOA: u32 = 0x4002_0000;
pub const GPIOB: u32 = 0x4002_0400;

/// The registers of CAN1.
pub const MCR: u32 = 0x4000_6400;
pub const MSR: u32 = 0x4000_6404;
pub const TSR: u32 = 0x4000_6408;
pub const RF0R: u32 = 0x4000_640C;
pub const IER: u32 = 0x4000_6414;
pub const ESR: u32 = 0x4000_6418;
pub const BTR: u32 = 0x4000_641C;
pub const TI0R: u32 = 0x4000_6580;
pub const RI0R: u32 = 0x4000_65B0;
pub const FMR: u32 = 0x4000_6600;
pub const FM1R: u32 = 0x4000_6604;
pub const FS1R: u32 = 0x4000_660C;
pub const FFA1R: u32 = 0x4000_6614;
pub const FA1R: u32 = 0x4000_661C;
pub const F0R1: u32 = 0x4000_6640;

pub const INRQ: u32 = 1;
pub const SLEEP: u32 = 2;
pub const TXFP: u32 = 4;
pub const RFLM: u32 = 8;
pub const NART: u32 = 16;
pub const AWUM: u32 = 32;
pub const MCR_RESET: u32 = 1 << 15;

pub const INAK: u32 = 1;
pub const SLAK: u32 = 2;

/// 1 Mbit/s and slower on APB1 of 16 MHz.
pub const MEGABIT: u32 = 0x001C_0000;
pub const HALF_MEGABIT: u32 = 0x001C_0001;
/// Silent mode in BTR.
pub const SILENT: u32 = 1 << 31;

/// A chip, the time of its next access, and the bus of each CAN controller with an adapter at 1 Mbit/s.
pub struct Rig {
    chip: Chip,
    pub now: Time,
    pub buses: Vec<(Bus, Adapter)>,
}

impl Deref for Rig {
    type Target = Chip;

    fn deref(&self) -> &Chip {
        &self.chip
    }
}

impl DerefMut for Rig {
    fn deref_mut(&mut self) -> &mut Chip {
        &mut self.chip
    }
}

impl Rig {
    /// A nominal chip at power-on.
    pub fn new(part: Part) -> Self {
        Self::with_variant(part, ChipVariant::default())
    }

    pub fn with_variant(part: Part, variant: ChipVariant) -> Self {
        let crystal = Clock { hz: 8_000_000, ppm: 20 };
        let chip = Chip::with_variant(part, crystal, *b"unique id 12", variant);
        let bus = |_| (Bus::new(), Adapter::new(1_000_000));
        Self { chip, now: Time::ZERO, buses: (0..part.cans()).map(bus).collect() }
    }

    /// A chip whose ports and CAN controllers have their clocks, but the controllers no pins.
    pub fn clocked(part: Part) -> Self {
        let mut rig = Self::new(part);
        rig.write_all(&[(RCC_AHB1ENR, 0x1FF), (RCC_APB1ENR, ((1 << part.cans()) - 1) << 25)]);
        rig
    }

    /// A chip whose controllers have their first pins and are asleep, as after a reset.
    pub fn asleep(part: Part) -> Self {
        let mut rig = Self::clocked(part);
        for can in 0..part.cans() {
            part.can_pins(can)[0].into_iter().for_each(|(pin, function)| rig.assign(pin, function));
        }
        rig.run_us(1);
        rig
    }

    /// An STM32F405 whose CAN1 is as after a reset.
    pub fn after_reset() -> Self {
        Self::asleep(Part::Stm32f405)
    }

    /// Its CAN1 is in normal mode with these bits of MCR and a filter that accepts everything into FIFO 0.
    pub fn of_variant(variant: CanVariant, mcr: u32) -> Self {
        let mut rig = Self::after_reset();
        rig.can_mut(1).set_variant(variant);
        rig.open_filter();
        rig.join(mcr, MEGABIT);
        rig
    }

    /// The same of the nominal variant.
    pub fn running(mcr: u32) -> Self {
        Self::of_variant(CanVariant::default(), mcr)
    }

    pub fn open_filter(&mut self) {
        self.write_all(&[(FS1R, 1), (F0R1, 0), (F0R1 + 4, 0), (FA1R, 1), (FMR, 0x2A1C_0E00)]);
    }

    pub fn join(&mut self, mcr: u32, btr: u32) {
        self.write(MCR, mcr | INRQ);
        assert_eq!(self.read(MSR) & (INAK | SLAK), INAK);
        self.write_all(&[(BTR, btr), (MCR, mcr)]);
        self.run_us(40);
        assert_eq!(self.read(MSR) & (INAK | SLAK), 0);
        self.can_mut(1).take_notes();
    }

    /// Sets the time of the next accesses.
    pub fn at(&mut self, now: Time) -> &mut Self {
        self.now = now;
        self
    }

    pub fn at_us(&mut self, us: u64) -> &mut Self {
        self.at(Time::from_us(us))
    }

    fn access(&self, address: u32, width: Width) -> Access {
        Access { address, width, now: self.now, pc: 0x0800_1234 }
    }

    pub fn store(&mut self, address: u32, width: Width, value: u32) -> Result<(), BusFault> {
        let access = self.access(address, width);
        self.chip.write(access, value)
    }

    pub fn write(&mut self, address: u32, value: u32) {
        self.store(address, Width::Word, value).expect("no bus error");
    }

    pub fn write_all(&mut self, registers: &[(u32, u32)]) {
        registers.iter().for_each(|&(address, value)| self.write(address, value));
    }

    pub fn load(&mut self, address: u32, width: Width) -> u32 {
        let access = self.access(address, width);
        self.chip.read(access).expect("no bus error")
    }

    pub fn read(&mut self, address: u32) -> u32 {
        self.load(address, Width::Word)
    }

    pub fn problems(&self) -> Vec<Problem> {
        self.findings().iter().map(|finding| finding.problem).collect()
    }

    pub fn reset_now(&mut self, cause: ResetCause) {
        self.chip.reset(cause, self.now);
    }

    /// Resets peripherals of APB1 by their bits in RCC.
    pub fn reset_by_rcc(&mut self, bits: u32) {
        self.write_all(&[(RCC_APB1RSTR, bits), (RCC_APB1RSTR, 0)]);
    }

    /// Selects the alternate function of a pin; `None` makes it an input.
    pub fn set_function(&mut self, Pin(port, number): Pin, function: Option<u32>) {
        let port = GPIOA + 0x400 * (port as u32 - 'A' as u32);
        let number = u32::from(number);
        let (register, shift) = (port + 0x20 + number / 8 * 4, number % 8 * 4);
        let old = self.read(register) & !(0xF << shift);
        self.write(register, old | function.unwrap_or(0) << shift);
        let old = self.read(port) & !(3 << (2 * number));
        self.write(port, old | if function.is_some() { 2 << (2 * number) } else { 0 });
    }

    pub fn assign(&mut self, pin: Pin, function: u32) {
        self.set_function(pin, Some(function));
    }

    /// Runs the buses.
    pub fn run(&mut self, span: Time) {
        self.now += span;
        for ((bus, adapter), can) in self.buses.iter_mut().zip(self.chip.cans_mut()) {
            let stations: &mut [&mut dyn Station] = &mut [&mut **can, adapter];
            while bus.advance(self.now, stations, &mut |_, _, _| {}) < self.now {}
            can.update_irq();
        }
    }

    pub fn run_us(&mut self, us: u64) {
        self.run(Time::from_us(us));
    }

    pub fn step_until(&mut self, what: &str, mut done: impl FnMut(&mut Self) -> bool) {
        let limit = self.now + Time::from_ms(100);
        while !done(self) {
            self.run(Time::from_ns(500));
            assert!(self.now < limit, "{what} never came");
        }
    }

    /// The adapter beside CAN1.
    pub fn adapter(&mut self) -> &mut Adapter {
        &mut self.buses[0].1
    }

    /// Lets the adapter beside CAN1 send a frame.
    pub fn send(&mut self, frame: Frame) {
        self.adapter().send(frame);
    }

    /// The frames that the adapter beside CAN1 has received.
    pub fn received(&mut self) -> Vec<Frame> {
        std::iter::from_fn(|| self.adapter().receive()).map(|(_, frame)| frame).collect()
    }

    /// The interrupt lines of CAN1.
    pub fn irq(&self) -> u8 {
        self.can(1).irq()
    }

    pub fn mailbox(&mut self, mailbox: u32, frame: Frame) {
        let base = TI0R + 16 * mailbox;
        let data = u64::from_le_bytes(frame.data);
        let id = match frame.id {
            Id::Standard(id) => u32::from(id) << 21,
            Id::Extended(id) => id << 3 | 4,
        };
        self.write_all(&[
            (base + 4, frame.dlc.into()),
            (base + 8, data as u32),
            (base + 12, (data >> 32) as u32),
            (base, id | u32::from(frame.remote) << 1 | 1),
        ]);
    }

    /// Empties a FIFO: identifier word, DLC and filter match index, first data word of each message.
    pub fn fifo(&mut self, fifo: u32) -> Vec<[u32; 3]> {
        let mut messages = Vec::new();
        while self.read(RF0R + 4 * fifo) & 3 != 0 {
            let base = RI0R + 16 * fifo;
            messages.push([base, base + 4, base + 8].map(|register| self.read(register)));
            self.write(RF0R + 4 * fifo, 1 << 5);
        }
        messages
    }
}

pub fn standard(id: u16, payload: &[u8]) -> Frame {
    Frame::data(Id::Standard(id), payload)
}
