//! The bus matrix: the address ranges that are memory, and the calls for loads and stores elsewhere.

use std::sync::{
    Arc, Mutex, MutexGuard,
    atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering::Relaxed},
};

use rsemu::core::{
    error::BusError,
    space::{
        AddressSpace, Mapping, MappingId, MemAttrs, MemOps, MemResult, Perms, RamStore, Region,
    },
};

use super::accelerator::Accelerator;
use crate::{
    chip::{
        Access, AtZero, BusFault, CCM_BASE, Chip, ChipVariant, FLASH_BASE, Part, RAM_BASE, Width,
    },
    engine::clock::CycleClock,
};

/// The system memory and the option bytes.
const SYSTEM_BASE: u32 = 0x1FFF_0000;
const SYSTEM_LENGTH: u64 = 0xC010;

/// State shared by the CPU loop and the calls made during its instructions.
#[derive(Debug)]
pub struct Link {
    /// The cycle at which the current instruction started.
    pub cycles: AtomicU64,
    /// The address of the current instruction.
    pub pc: AtomicU32,
    /// Whether the instruction stored to the chip.
    pub written: AtomicBool,
    /// Whether the flash may be busy, so that each read of it has to be checked.
    pub flash_busy: AtomicBool,
    /// The cycle until which a load or the read of a vector waits for a busy bank; 0 if none does.
    pub load_waits_until: AtomicU64,
    clock: Mutex<CycleClock>,
    accelerator: Mutex<Accelerator>,
}

impl Link {
    pub fn new(clock: CycleClock) -> Self {
        Self {
            cycles: AtomicU64::new(0),
            pc: AtomicU32::new(0),
            written: AtomicBool::new(false),
            flash_busy: AtomicBool::new(false),
            load_waits_until: AtomicU64::new(0),
            clock: Mutex::new(clock),
            accelerator: Mutex::new(Accelerator::new()),
        }
    }

    /// The flash's accelerator, which works only if the chip's variant asks for it.
    pub fn accelerator(&self) -> MutexGuard<'_, Accelerator> {
        self.accelerator.lock().expect("nothing panics while it holds the accelerator")
    }

    pub fn set_clock(&self, clock: CycleClock) {
        *self.clock.lock().expect("nothing panics while it holds the clock") = clock;
    }
}

/// A range of addresses handled by the chip.
#[derive(Clone, Debug)]
pub struct Aperture {
    base: u32,
    chip: Arc<Mutex<Chip>>,
    link: Arc<Link>,
}

impl Aperture {
    fn access(&self, offset: u32, length: usize) -> Result<Access, BusError> {
        let width = Width::of(length).ok_or(BusError::BadAccess)?;
        let cycles = self.link.cycles.load(Relaxed);
        let now = self.link.clock.lock().map_err(|_| BusError::BadAccess)?.time_at(cycles);
        let address = self.base + offset;
        Ok(Access { address, width, now, pc: self.link.pc.load(Relaxed) })
    }

    pub fn load(&self, offset: u32, length: usize) -> MemResult<u32> {
        let access = self.access(offset, length)?;
        let mut chip = self.chip.lock().map_err(|_| BusError::BadAccess)?;
        let value = chip.read(access).map_err(|BusFault| BusError::Unassigned)?;
        Ok(value)
    }

    pub fn store(&self, offset: u32, length: usize, value: u32) -> MemResult {
        let access = self.access(offset, length)?;
        self.link.written.store(true, Relaxed);
        let mut chip = self.chip.lock().map_err(|_| BusError::BadAccess)?;
        chip.write(access, value).map_err(|BusFault| BusError::Unassigned)
    }
}

impl MemOps for Aperture {
    fn read(&self, offset: u64, dst: &mut [u8], _: MemAttrs) -> MemResult {
        let value = self.load(offset as u32, dst.len())?;
        dst.copy_from_slice(&value.to_le_bytes()[..dst.len()]);
        Ok(())
    }

    fn write(&self, offset: u64, src: &[u8], _: MemAttrs) -> MemResult {
        let mut bytes = [0; 4];
        bytes.get_mut(..src.len()).ok_or(BusError::BadAccess)?.copy_from_slice(src);
        self.store(offset as u32, src.len(), u32::from_le_bytes(bytes))
    }
}

/// Reads of the flash: a bank that programs or erases stalls them, they have wait states if the chip's variant asks for
/// them, and the error correction of an STM32G4 finds double errors.
#[derive(Debug)]
struct FlashReads {
    extra: Extra,
    flash: Arc<RamStore>,
    chip: Aperture,
}

/// What reads of the flash do beside reading.
#[derive(Clone, Copy, Debug)]
enum Extra {
    Nothing,
    WaitStates,
    Correction,
}

impl FlashReads {
    /// Notes the end of the wait for a busy bank. The engine itself holds back fetches.
    fn wait_for_bank(&self, offset: u32) -> MemResult {
        let link = &self.chip.link;
        let clock = *link.clock.lock().map_err(|_| BusError::BadAccess)?;
        let now = clock.time_at(link.cycles.load(Relaxed));
        let chip = self.chip.chip.lock().map_err(|_| BusError::BadAccess)?;
        if let Some(end) = chip.flash().busy_until(offset, now) {
            link.load_waits_until.store(clock.cycle_at(end), Relaxed);
        }
        Ok(())
    }
}

impl MemOps for FlashReads {
    fn read(&self, offset: u64, dst: &mut [u8], attrs: MemAttrs) -> MemResult {
        if attrs.debug {
            return self.flash.read_at(offset, dst);
        }
        let link = &self.chip.link;
        if !attrs.is_fetch() && link.flash_busy.load(Relaxed) {
            self.wait_for_bank(offset as u32)?;
        }
        match self.extra {
            Extra::Nothing => {}
            Extra::WaitStates => {
                let (address, cycle) = (FLASH_BASE + offset as u32, link.cycles.load(Relaxed));
                let mut accelerator = link.accelerator();
                if attrs.is_fetch() {
                    accelerator.fetch(address, cycle);
                } else {
                    accelerator.load(address, cycle);
                }
            }
            Extra::Correction => {
                let mut chip = self.chip.chip.lock().map_err(|_| BusError::BadAccess)?;
                chip.flash_mut().note_read(offset as u32, dst.len() as u32);
                if chip.nmi() {
                    link.written.store(true, Relaxed);
                }
            }
        }
        self.flash.read_at(offset, dst)
    }

    fn write(&self, _: u64, _: &[u8], _: MemAttrs) -> MemResult {
        Err(BusError::Unassigned)
    }
}

/// A range of addresses without a register that causes no fault.
#[derive(Debug)]
struct Nothing;

impl MemOps for Nothing {
    fn read(&self, _: u64, dst: &mut [u8], _: MemAttrs) -> MemResult {
        dst.fill(0);
        Ok(())
    }

    fn write(&self, _: u64, _: &[u8], _: MemAttrs) -> MemResult {
        Ok(())
    }
}

/// The address map (RM0090 2.3). An address outside of it causes a BusFault.
pub struct Space {
    shared: Arc<AddressSpace>,
    /// All that the chip handles, by address.
    pub chip: Aperture,
    flash: Arc<RamStore>,
    ram: Arc<RamStore>,
    extra: Extra,
    /// What lies at address 0, and its place among the mappings.
    at_zero: (AtZero, MappingId),
}

impl Space {
    pub fn new(
        chip: &Arc<Mutex<Chip>>,
        link: &Arc<Link>,
        [flash, ram, ccm]: [&Arc<RamStore>; 3],
        part: Part,
        variant: ChipVariant,
    ) -> Self {
        let shared = Arc::new(AddressSpace::new("cortex-m4", 32));
        let map = |mapping| {
            shared.topology().map_with(mapping).expect("every range lies in the 32-bit space")
        };
        let extra = match part {
            Part::Stm32g431 => Extra::Correction,
            _ if variant.flash_waits => Extra::WaitStates,
            _ => Extra::Nothing,
        };
        let aperture = Aperture { base: 0, chip: Arc::clone(chip), link: Arc::clone(link) };
        let at_zero = map(code("flash at 0", flash, &aperture, extra, 0));
        let io = |name: &str, base: u32, length: u64| {
            let region = Region::io(name, length, Arc::new(Aperture { base, ..aperture.clone() }));
            Mapping::new(region, base.into()).with_perms(Perms::RW)
        };
        let mut mappings = vec![
            code("flash", flash, &aperture, extra, FLASH_BASE),
            io("flash programming", FLASH_BASE, flash.len()).with_perms(Perms::WRITE),
            io("system memory", SYSTEM_BASE, SYSTEM_LENGTH).with_perms(Perms::RWX),
            memory("sram", ram, RAM_BASE, Perms::RWX),
            io("apb and ahb1", 0x4000_0000, 0x8_0000),
            io("ahb2", 0x5000_0000, 0x6_1000),
            io("dbgmcu", 0xE004_2000, 0x400),
        ];
        if part == Part::Stm32g431 {
            mappings.push(io("ahb2 with gpio", 0x4800_0000, 0x2000));
        }
        if !ccm.is_empty() {
            mappings.push(memory("ccm", ccm, CCM_BASE, Perms::RW));
        }
        if variant.no_fault_below_ram {
            const BASE: u32 = 0x1FFF_C010;
            let nothing = Region::io("nothing", (RAM_BASE - BASE).into(), Arc::new(Nothing));
            mappings.push(Mapping::new(nothing, BASE.into()).with_perms(Perms::RW));
        }
        for mapping in mappings {
            map(mapping);
        }
        Self {
            shared,
            chip: aperture,
            flash: Arc::clone(flash),
            ram: Arc::clone(ram),
            extra,
            at_zero: (AtZero::Flash, at_zero),
        }
    }

    pub fn shared(&self) -> Arc<AddressSpace> {
        Arc::clone(&self.shared)
    }

    /// Puts this memory at address 0 too.
    pub fn put_at_zero(&mut self, what: AtZero) {
        if self.at_zero.0 == what {
            return;
        }
        self.at_zero.0 = what;
        let mapping = match what {
            AtZero::Flash => code("flash at 0", &self.flash, &self.chip, self.extra, 0),
            AtZero::Sram => memory("sram at 0", &self.ram, 0, Perms::RWX),
            AtZero::System => {
                let aperture = Arc::new(Aperture { base: SYSTEM_BASE, ..self.chip.clone() });
                let region = Region::io("system memory at 0", SYSTEM_LENGTH, aperture);
                Mapping::new(region, 0).with_perms(Perms::RWX)
            }
        };
        let replaced = self.shared.topology().replace(self.at_zero.1, mapping);
        replaced.expect("the mapping exists, and every range lies in the 32-bit space");
    }
}

fn memory(name: &str, store: &Arc<RamStore>, base: u32, perms: Perms) -> Mapping {
    Mapping::new(Region::ram(name, Arc::clone(store)), base.into()).with_perms(perms)
}

/// The flash for fetches and loads, at its address or at 0. Both have the same lines in the caches.
fn code(name: &str, flash: &Arc<RamStore>, chip: &Aperture, extra: Extra, base: u32) -> Mapping {
    let reads = FlashReads { extra, flash: Arc::clone(flash), chip: chip.clone() };
    let region = Region::io(name, flash.len(), Arc::new(reads));
    Mapping::new(region, base.into()).with_perms(Perms::RX)
}
