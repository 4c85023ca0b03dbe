//! One microcontroller: its peripherals behind their addresses, independent of the engine that runs the CPU.

mod adc;
mod can_pins;
mod crc;
mod finding;
mod flash;
mod g4;
mod gpio;
mod iwdg;
mod map;
mod part;
mod pwm;
mod rcc;
mod registers;
mod spi;
mod supply;
mod surroundings;
mod system;
mod timer;
mod unmodelled;
mod variant;

pub use adc::{Adc, Analogue};
pub use finding::{Finding, Problem};
pub use flash::{Cells, Done, Flash, PowerCut, StuckBits, Timing};
pub use gpio::{Gpio, Output, Pin};
pub use map::{CCM_BASE, FLASH_BASE, RAM_BASE};
pub use part::{Part, UnknownPart};
pub use pwm::Pwm;
pub use rcc::{Clocks, ResetCause};
pub use registers::{Access, BusFault, Width};
pub use spi::SpiDevice;
pub use supply::Thresholds;
pub use variant::{ChipVariant, StartUp};

use std::ops::BitOr;

use crc::Crc;
use iwdg::Iwdg;
use map::{Block, is_on_apb};
use part::Family;
use rcc::{Rcc, RccF4};
use registers::{Apb, Registers};
use spi::Spi;
pub use system::AtZero;
use system::{Dbgmcu, Exti, Factory, Power, Pwr, Syscfg};
use timer::Timer;
use unmodelled::Kept;

use crate::{
    Time,
    can::{Bxcan, Can, Clock, Fdcan, Peripheral, Pins, bxcan::Role},
};

/// Something that the chip asks of its board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    Reset(ResetCause),
    PowerCut,
}

/// The peripherals of one microcontroller.
#[derive(Debug)]
pub struct Chip {
    part: Part,
    rcc: Box<dyn Rcc>,
    pwr: Box<dyn Power>,
    flash: Flash,
    iwdg: Iwdg,
    /// TIM1 to TIM14; an STM32G4 uses those that are as on an STM32F4.
    timers: Vec<Timer>,
    /// SPI1 to SPI6 of an STM32F4.
    spis: Vec<Spi>,
    crc: Crc,
    gpio: Gpio,
    syscfg: Syscfg,
    exti: Exti,
    dbgmcu: Dbgmcu,
    factory: Factory,
    adc: Adc,
    /// CAN1 and CAN2, on some parts CAN3.
    cans: Vec<Can>,
    /// Their pins as they know them.
    cans_joined: Vec<Pins>,
    /// Their transmit pins that are connected to a transceiver.
    transmit_pins: Vec<Option<Pin>>,
    variant: ChipVariant,
    findings: Vec<Finding>,
    kept: Kept,
    can_written: bool,
    boot: g4::Boot,
}

const ROLES: [Role; 3] = [Role::Master, Role::Slave, Role::Single];
/// The first interrupts of CAN1, CAN2 and CAN3 (RM0090 table 61, for CAN3 the vector table of RM0430).
const CAN_INTERRUPTS: [usize; 3] = [19, 63, 74];
/// The first interrupt of FDCAN1 (RM0440 table 97).
const FDCAN_INTERRUPT: usize = 21;
/// The least supply in mV with which the flash may prefetch (RM0090 3.5.1).
const LEAST_FOR_PREFETCH_MV: u32 = 2_100;

impl Chip {
    /// A nominal chip with erased flash at power-on, with `crystal` at HSE.
    pub fn new(part: Part, crystal: Clock, unique_id: [u8; 12]) -> Self {
        Self::with_variant(part, crystal, unique_id, ChipVariant::default())
    }

    /// A chip with erased flash at power-on, with `crystal` at HSE, that differs from the nominal one.
    pub fn with_variant(
        part: Part,
        crystal: Clock,
        unique_id: [u8; 12],
        variant: ChipVariant,
    ) -> Self {
        let (rcc, pwr): (Box<dyn Rcc>, Box<dyn Power>) = match part.family() {
            Family::F4 => (
                Box::new(RccF4::new(part, crystal, &variant)),
                Box::new(Pwr::new(part, variant.thresholds)),
            ),
            Family::G4 => (Box::new(g4::Rcc::new(crystal, &variant)), Box::new(g4::Pwr::new())),
        };
        let cans = match part.family() {
            Family::F4 => {
                ROLES[..part.cans()].iter().map(|&role| Can::Bxcan(Bxcan::new(role))).collect()
            }
            Family::G4 => vec![Can::Fdcan(Fdcan::new())],
        };
        let mut chip = Self {
            part,
            rcc,
            pwr,
            flash: Flash::new(part, &variant),
            iwdg: Iwdg::new(variant.lsi_hz),
            timers: timer::KINDS.iter().map(Timer::new).collect(),
            spis: spi::KINDS.iter().map(Spi::new).collect(),
            crc: Crc::new(),
            gpio: Gpio::new(part),
            syscfg: Syscfg::default(),
            exti: Exti::default(),
            dbgmcu: Dbgmcu::new(part),
            factory: Factory::new(part, unique_id),
            adc: Adc::new(part),
            cans,
            cans_joined: vec![Pins::CONNECTED; part.cans()],
            transmit_pins: vec![None; part.cans()],
            variant,
            findings: Vec::new(),
            kept: Kept::default(),
            can_written: false,
            boot: g4::Boot::default(),
        };
        chip.follow_clocks(Time::ZERO);
        chip.connect_cans(Time::ZERO);
        chip
    }

    pub fn part(&self) -> Part {
        self.part
    }

    pub fn variant(&self) -> ChipVariant {
        self.variant
    }

    pub fn clocks(&self) -> Clocks {
        self.rcc.clocks()
    }

    pub fn flash(&self) -> &Flash {
        &self.flash
    }

    pub fn flash_mut(&mut self) -> &mut Flash {
        &mut self.flash
    }

    pub fn gpio(&self) -> &Gpio {
        &self.gpio
    }

    pub fn gpio_mut(&mut self) -> &mut Gpio {
        &mut self.gpio
    }

    pub fn adc_mut(&mut self) -> &mut Adc {
        &mut self.adc
    }

    /// A CAN controller: 1 for CAN1. Panics if the part has no such controller.
    pub fn can(&self, number: usize) -> &dyn Peripheral {
        &*self.cans[number - 1]
    }

    /// A CAN controller, for the bus that it is on: 1 for CAN1.
    ///
    /// # Panics
    /// The part has no such controller.
    pub fn can_mut(&mut self, number: usize) -> &mut dyn Peripheral {
        &mut *self.cans[number - 1]
    }

    /// All CAN controllers, CAN1 first.
    pub fn cans(&self) -> &[Can] {
        &self.cans
    }

    pub fn cans_mut(&mut self) -> &mut [Can] {
        &mut self.cans
    }

    pub fn findings(&self) -> &[Finding] {
        &self.findings
    }

    /// Levels of the interrupt lines, bit n for interrupt n (RM0090 table 61).
    pub fn irqs(&self) -> u128 {
        let interrupts = match self.part.family() {
            Family::F4 => CAN_INTERRUPTS,
            Family::G4 => [FDCAN_INTERRUPT; 3],
        };
        let cans = self.cans.iter().zip(interrupts);
        let cans = cans.map(|(can, first)| u128::from(can.irq()) << first);
        u128::from(self.flash.irq()) << 4
            | u128::from(self.adc.irq()) << 18
            | cans.fold(0, BitOr::bitor)
            | self.timers.iter().map(Timer::irqs).fold(0, BitOr::bitor)
            | self.spis.iter().map(Spi::irqs).fold(0, BitOr::bitor)
    }

    /// When the chip next does something by itself, CAN apart, which lives on the bus's time.
    pub fn next_event(&self) -> Time {
        if self.boot.repeats() {
            return Time::ZERO;
        }
        let timers = self.timers.iter().map(Timer::deadline);
        [self.iwdg.deadline(), self.flash.operation_end(), self.flash.power_cut_at()]
            .into_iter()
            .flatten()
            .chain(timers)
            .chain(self.spis.iter().map(Spi::deadline))
            .chain([self.adc.deadline()])
            .fold(Time::MAX, Time::min)
    }

    /// Carries out what is due, unless it is for the board to do.
    pub fn advance(&mut self, now: Time) -> Option<Request> {
        if self.boot.repeats() {
            return Some(Request::Reset(ResetCause::PowerOn));
        }
        if self.flash.power_cut_at().is_some_and(|cut| now >= cut) {
            return Some(Request::PowerCut);
        }
        if self.iwdg.deadline().is_some_and(|deadline| now >= deadline) {
            return Some(Request::Reset(ResetCause::Watchdog));
        }
        self.flash.advance(now);
        self.timers.iter_mut().for_each(|timer| timer.advance(now));
        self.spis.iter_mut().for_each(|spi| spi.advance(now));
        self.adc.advance(now);
        None
    }

    /// Whether a CAN register was written since the last call: the bus should look before it goes on.
    pub fn take_can_written(&mut self) -> bool {
        std::mem::take(&mut self.can_written)
    }

    /// Until when the CPU stalls that fetches from `pc`.
    pub fn stalled_until(&self, pc: u32, now: Time) -> Option<Time> {
        match Block::of(self.part.family(), pc) {
            (Block::Flash, offset) if !self.variant.cached_code => {
                self.flash.busy_until(offset, now)
            }
            _ => None,
        }
    }

    /// Resets every block; flash content stays, torn where an operation was under way.
    pub fn reset(&mut self, cause: ResetCause, now: Time) {
        self.rcc.reset(cause);
        self.syscfg = Syscfg::default();
        self.kept = Kept::default();
        let others = [Block::FlashRegisters, Block::Iwdg, Block::Exti];
        for block in self.gated().chain(others) {
            self.reset_block(block, now);
        }
        if cause == ResetCause::PowerOn {
            self.flash.power_on();
            self.dbgmcu = Dbgmcu::new(self.part);
        }
        self.share_filters();
        self.follow_clocks(now);
        self.connect_cans(now);
        self.can_written = false;
        self.sample_boot_pin(now);
    }

    /// Whether an STM32G4 has started the boot loader in ROM, which is not modelled: the core does nothing.
    pub fn stays_in_loader(&self) -> bool {
        self.boot.in_loader()
    }

    /// Freezes what DBGMCU says while a debugger halts the core.
    pub fn halt(&mut self, now: Time) {
        if self.dbgmcu.freezes_watchdog() {
            self.iwdg.freeze(now);
        }
        for timer in &mut self.timers {
            timer.freeze(self.dbgmcu.freezes_timer(timer.place()), now);
        }
        if self.dbgmcu.freezes_others() {
            let access = Access { address: 0xE004_2008, width: Width::Word, now, pc: 0 };
            self.report(access, None, Problem::Unmodelled);
        }
    }

    /// Lets everything go on that a halt of the core has frozen.
    pub fn resume(&mut self, now: Time) {
        self.iwdg.thaw(now);
        self.timers.iter_mut().for_each(|timer| timer.freeze(false, now));
    }

    /// The blocks that RCC can reset.
    fn gated(&self) -> impl Iterator<Item = Block> + use<> {
        (0..self.timers.len())
            .map(Block::Timer)
            .chain((0..self.spis.len()).map(Block::Spi))
            .chain((0..self.gpio.len()).map(Block::Gpio))
            .chain((0..self.cans.len()).map(Block::Can))
            .chain([Block::Pwr, Block::Crc, Block::Adc, Block::Syscfg])
    }

    fn is_clocked(&self, block: Block) -> bool {
        self.rcc.enabled(block.gate(self.part.family()))
    }

    fn reset_block(&mut self, block: Block, now: Time) {
        self.kept.reset(block);
        self.registers(block).into_iter().for_each(|registers| registers.reset(now));
    }

    pub fn at_zero(&self) -> AtZero {
        self.syscfg.at_zero()
    }

    /// Brings the chip into the state in which the boot loader in ROM starts a program after `dfu-util ... :leave` with
    /// BOOT0 high (AN2606): 60 MHz from crystal and PLL with wait states and caches on, CSS on, USB with a clock, system
    /// memory at address 0.
    pub fn leave_loader(&mut self, now: Time) {
        self.rcc.leave_loader(now);
        self.flash.leave_loader();
        self.syscfg = Syscfg::new(AtZero::System);
        self.follow_clocks(now);
    }

    pub fn read(&mut self, access: Access) -> Result<u32, BusFault> {
        let Access { address, width, now, .. } = access;
        let (block, offset) = Block::of(self.part.family(), address);
        if !self.is_clocked(block) {
            self.report(access, None, Problem::ClockOff);
            return Ok(0);
        }
        let word = match block {
            Block::Factory => self.factory_word(address & !3),
            _ => self.read_register(block, offset & !3, now),
        };
        if word.is_none() {
            self.report(access, None, Problem::Unmodelled);
        }
        let word = word.unwrap_or(0) | self.kept.bits(block, address & !3);
        Ok(word >> (8 * (address & 3)) & width.mask())
    }

    fn read_register(&mut self, block: Block, offset: u32, now: Time) -> Option<u32> {
        match block {
            Block::Rcc => self.rcc.read(offset, now),
            _ => self.registers(block)?.read(offset, now),
        }
    }

    /// The registers of a block other than RCC.
    fn registers(&mut self, block: Block) -> Option<&mut dyn Registers> {
        Some(match block {
            Block::FlashRegisters => &mut self.flash,
            Block::Pwr => &mut *self.pwr,
            Block::Timer(timer) => &mut self.timers[timer],
            Block::Spi(spi) => &mut self.spis[spi],
            Block::Crc => &mut self.crc,
            Block::Iwdg => &mut self.iwdg,
            Block::Adc => &mut self.adc,
            Block::Can(can) => self.cans.get_mut(can)?,
            Block::Syscfg => &mut self.syscfg,
            Block::Exti => &mut self.exti,
            Block::Gpio(port) => self.gpio.port(port)?,
            Block::Dbgmcu => &mut self.dbgmcu,
            Block::Rcc | Block::Flash | Block::Factory | Block::Unknown => return None,
        })
    }

    fn factory_word(&self, address: u32) -> Option<u32> {
        let bytes = [0, 1, 2, 3].map(|i| self.factory.byte(address + i));
        bytes
            .iter()
            .any(Option::is_some)
            .then(|| u32::from_le_bytes(bytes.map(|byte| byte.unwrap_or(0xFF))))
    }

    /// Stores to a peripheral or into the flash.
    pub fn write(&mut self, access: Access, value: u32) -> Result<(), BusFault> {
        let Access { address, width, now, .. } = access;
        let (block, offset) = Block::of(self.part.family(), address);
        let value = value & width.mask();
        if block == Block::Flash {
            if let Err(problem) = self.flash.program(offset, width, value, now) {
                self.report(access, Some(value), problem);
            }
            return Ok(());
        }
        if block != Block::FlashRegisters && self.flash.take_stale_data_cache() {
            let why = "the data cache holds what was erased: no DCRST since";
            self.report(access, Some(value), Problem::Misuse(why));
        }
        if !self.is_clocked(block) {
            self.report(access, Some(value), Problem::ClockOff);
            return Ok(());
        }
        let shift = 8 * (address & 3);
        let word = match width {
            Width::Word => value,
            // RM0090 4.4: by words only.
            _ if block == Block::Crc => {
                self.report(access, Some(value), Problem::Width);
                return Ok(());
            }
            _ if block == Block::FlashRegisters && !self.flash.takes_narrow_writes(offset & !3) => {
                self.report(access, Some(value), Problem::Width);
                return Ok(());
            }
            // Its bits are cleared by writing 1: not those of the other bytes.
            _ if block == Block::FlashRegisters && offset & !3 == Flash::SR => value << shift,
            Width::Byte if is_on_apb(address) => value * 0x0101_0101,
            Width::Half if is_on_apb(address) => value * 0x0001_0001,
            _ => {
                let old = self.read_register(block, offset & !3, now).unwrap_or(0)
                    | self.kept.bits(block, address & !3);
                old & !(width.mask() << shift) | value << shift
            }
        };
        let written = self.write_register(block, offset & !3, word, now);
        let taken = match written {
            Err(Problem::Unmodelled) if !block.is_strict() => {
                self.read_register(block, offset & !3, now).unwrap_or(0)
            }
            _ => word,
        };
        self.kept.set(block, address & !3, word & !taken);
        match written {
            Err(Problem::BusFault) => return Err(BusFault),
            Err(problem) => self.report(access, Some(value), problem),
            Ok(()) => {}
        }
        Ok(())
    }

    fn write_register(
        &mut self,
        block: Block,
        offset: u32,
        value: u32,
        now: Time,
    ) -> Result<(), Problem> {
        let is_backup_domain = block == Block::Rcc && self.rcc.is_backup_domain(offset);
        if is_backup_domain && !self.pwr.backup_domain_is_writable() {
            return Err(Problem::Misuse("the backup domain is written while DBP protects it"));
        }
        if block == Block::Rcc {
            return self.write_rcc(offset, value, now);
        }
        let written = match self.registers(block) {
            Some(registers) => registers.write(offset, value, now),
            None => Err(Problem::Unmodelled),
        };
        match block {
            Block::FlashRegisters => return written.and_then(|()| self.check_latency()),
            Block::Can(can) => {
                self.can_written = true;
                return written.and_then(|()| self.check_can(can, offset, value));
            }
            Block::Gpio(_) => {
                self.connect_cans(now);
                self.select_spi_devices();
            }
            Block::Iwdg if self.iwdg.running() => self.rcc.force_lsi(now),
            _ => {}
        }
        written
    }

    fn write_rcc(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
        let (before, before_rtc) = (self.clocks(), self.rcc.hse_rtc());
        let written = self.rcc.write(offset, value, now);
        self.carry_out_resets(now);
        if self.clocks() != before || self.rcc.hse_rtc() != before_rtc {
            self.follow_clocks(now);
        }
        written.and_then(|()| self.check_latency()).and_then(|()| self.check_voltage())
    }

    fn check_can(&mut self, can: usize, offset: u32, value: u32) -> Result<(), Problem> {
        if can == 0 {
            self.share_filters();
        }
        let is_start = self.cans[can].is_start(offset, value);
        if is_start && !self.can_has_its_pins(can) {
            return Err(Problem::Misuse(
                "a CAN controller leaves initialisation with no pins in its alternate function",
            ));
        }
        if is_start && can == 1 && !self.is_clocked(Block::Can(0)) {
            return Err(Problem::Misuse(
                "CAN2 leaves initialisation while CAN1, which has its memory, has no clock",
            ));
        }
        Ok(())
    }

    /// Gives the peripherals the clocks that RCC now makes.
    fn follow_clocks(&mut self, now: Time) {
        let clocks = self.clocks();
        for can in &mut self.cans {
            can.set_clock(clocks.can);
        }
        self.adc.set_clock(clocks.pclk2);
        for timer in &mut self.timers {
            let clock = match timer.place().0 {
                Apb::One => clocks.timclk1,
                Apb::Two => clocks.timclk2,
            };
            timer.set_clock(clock, now);
            timer.set_hse_rtc(self.rcc.hse_rtc(), now);
        }
        for spi in &mut self.spis {
            let clock = match spi.place().0 {
                Apb::One => clocks.pclk1,
                Apb::Two => clocks.pclk2,
            };
            spi.set_clock(clock, now);
        }
    }

    /// CAN2 keeps its filters when it is reset; CAN1 loses those of both.
    fn carry_out_resets(&mut self, now: Time) {
        let family = self.part.family();
        let is_held = |block: &Block| self.rcc.held_in_reset(block.gate(family));
        for block in self.gated().filter(is_held).collect::<Vec<_>>() {
            self.reset_block(block, now);
            self.can_written |= matches!(block, Block::Can(_));
        }
        self.share_filters();
        self.connect_cans(now);
    }

    fn check_latency(&self) -> Result<(), Problem> {
        let (hclk, supply_mv) = (self.clocks().hclk.hz, self.pwr.supply());
        if self.flash.latency() < self.part.wait_states(hclk, self.pwr.is_boosted(), supply_mv) {
            return Err(Problem::Misuse("too few flash wait states for this HCLK and supply"));
        }
        if self.flash.prefetches() && supply_mv < LEAST_FOR_PREFETCH_MV {
            return Err(Problem::Misuse("prefetch of the flash at a supply below 2.1 V"));
        }
        Ok(())
    }

    fn check_voltage(&self) -> Result<(), Problem> {
        if self.clocks().hclk.hz > self.pwr.max_hclk() {
            return Err(Problem::Misuse("HCLK above the limit of the voltage scale (PWR_CR.VOS)"));
        }
        Ok(())
    }
}
