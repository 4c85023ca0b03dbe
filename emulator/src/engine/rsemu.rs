//! The engine: rsemu's ARMv7E-M core with the chip's memories mapped directly and its peripherals behind calls.

mod accelerator;
mod bus;
mod follow;
mod watched;

use std::sync::{Arc, Mutex, MutexGuard, atomic::Ordering::Relaxed};

use rsemu::{
    core::{
        device::{Device, ResetKind},
        space::RamStore,
    },
    cpu::arm::v7m::{
        ArmV7m, Config,
        sys::{Exception, control},
        xpsr,
    },
};

use super::{Engine, Halt, Lockup, Registers, Watcher, clock::CycleClock};
use crate::{
    Time,
    chip::{Access, CCM_BASE, Chip, FLASH_BASE, Problem, RAM_BASE, Width},
    coverage::{Executed, Recorder},
};
use accelerator::Accelerator;
use bus::{Link, Space};

/// Bits of SYST_CSR: counter enabled, and its interrupt enabled.
const SYSTICK_INTERRUPTS: u32 = 0b11;
/// The number of instructions that may pass before a reset request is noticed.
const RESET_POLL: u32 = 64;

/// A Cortex-M4F that executes one instruction at a time.
pub struct Rsemu {
    cpu: ArmV7m,
    space: Space,
    chip: Arc<Mutex<Chip>>,
    link: Arc<Link>,
    flash: Arc<RamStore>,
    ram: Arc<RamStore>,
    ccm: Arc<RamStore>,
    clock: CycleClock,
    cycles: u64,
    asleep_cycles: u64,
    /// The CPU does nothing before this cycle.
    stalled_until: u64,
    /// Whether the flash is busy, so that every fetch has to be checked.
    flash_busy: bool,
    /// The cycles of the last instruction, if it was a jump to itself.
    spin: Option<u64>,
    /// The factor by which an instruction's cycles are multiplied.
    slowdown: u64,
    /// Whether reads of the flash have wait states.
    flash_waits: bool,
    irqs: u128,
    polls: u32,
    recorder: Option<Recorder>,
    watcher: Option<Box<dyn Watcher>>,
}

impl Rsemu {
    /// A CPU for `chip`, not yet reset, with the chip's flash content and empty RAM.
    pub fn new(chip: Arc<Mutex<Chip>>) -> Self {
        let mut guard = lock(&chip);
        let part = guard.part();
        let clock = CycleClock::new(guard.clocks().hclk, 0, Time::ZERO);
        let flash = Arc::new(RamStore::new(part.flash_size().into()));
        copy(&flash, 0, guard.flash().bytes());
        guard.flash_mut().take_changed();
        let readings = guard.readings();
        drop(guard);
        let link = Arc::new(Link::new(clock));
        let ram = Arc::new(RamStore::new(part.ram_size().into()));
        let ccm = Arc::new(RamStore::new(part.ccm_size().into()));
        let config = Config::CORTEX_M4F.with_priority_bits(4);
        let cpu = ArmV7m::new(config);
        let space = Space::new(&chip, &link, &flash, &ram, &ccm, readings);
        cpu.attach_space(space.shared());
        Self {
            cpu,
            space,
            chip,
            link,
            flash,
            ram,
            ccm,
            clock,
            cycles: 0,
            asleep_cycles: 0,
            stalled_until: 0,
            flash_busy: false,
            spin: None,
            slowdown: readings.slowdown.max(1).into(),
            flash_waits: readings.flash_waits,
            irqs: 0,
            polls: 0,
            recorder: None,
            watcher: None,
        }
    }

    /// Advances by cycles in which the core executes nothing.
    fn skip(&mut self, cycles: u64) {
        self.cpu.with_sys(|sys| {
            sys.tick_cyccnt(cycles);
            if sys.tick_systick(cycles) && sys.syst_csr & SYSTICK_INTERRUPTS == SYSTICK_INTERRUPTS {
                sys.set_pending(Exception::SYSTICK, true);
            }
        });
        self.cycles += cycles;
    }

    /// Cycles until SysTick interrupts, if it is enabled.
    fn cycles_to_systick(&self) -> Option<u64> {
        self.cpu.with_sys(|sys| {
            let runs = sys.syst_csr & SYSTICK_INTERRUPTS == SYSTICK_INTERRUPTS && sys.syst_rvr != 0;
            runs.then_some(match sys.syst_cvr {
                0 => u64::from(sys.syst_rvr) + 1,
                count => u64::from(count),
            })
        })
    }

    /// The program counter and xPSR, in one access: each takes a lock.
    fn program_state(&self) -> (u32, u32) {
        let regs = self.cpu.regs();
        (regs.r[15], regs.xpsr)
    }

    fn exception_pending(&self) -> bool {
        self.cpu.with_sys(|sys| sys.highest_pending().is_some())
    }

    /// Skips the rest of a sleep, or of an instruction's jumps to itself, up to cycle `target`.
    fn idle(&mut self, used: u64, target: u64) {
        let asleep = self.cpu.is_asleep();
        if asleep {
            self.asleep_cycles += used;
            if self.exception_pending() {
                return;
            }
            self.check_sleep();
        } else if used <= 3 {
            self.spin = Some(used * self.slowdown);
        } else {
            return;
        }
        let step = if asleep { 1 } else { used * self.slowdown };
        let room = target.saturating_sub(self.cycles);
        let cycles = self.cycles_to_systick().map_or(room, |ticks| room.min(ticks));
        let cycles = cycles - cycles % step;
        if cycles > 0 {
            self.skip(cycles);
            if asleep {
                self.asleep_cycles += cycles;
            }
        }
    }

    /// The address of the xPSR that an exception entry has stacked, if the step was one.
    ///
    /// `before` and `pc` are the values before the step.
    fn entry(&self, before: u32, pc: u32) -> Option<u32> {
        const STACKED_PC: u32 = 6 * 4;
        let regs = self.cpu.regs();
        if (regs.xpsr ^ before) & xpsr::EXCEPTION == 0 {
            return None;
        }
        let was_handler = before & xpsr::EXCEPTION != 0;
        let used_psp = !was_handler && regs.control & control::SPSEL != 0;
        let frame = if used_psp { regs.psp } else { regs.msp };
        let mut stacked = [0; 4];
        // An exception return changes the exception number too, but has not stacked this PC.
        let has_stacked =
            self.read_memory(frame + STACKED_PC, &mut stacked) && stacked == pc.to_le_bytes();
        has_stacked.then_some(frame + STACKED_PC + 4)
    }

    /// Restores ITSTATE in the stacked xPSR: rsemu 0.0.7 leaves it out at an exception entry, so that the rest of an
    /// interrupted IT block would run unconditionally.
    ///
    /// `before` and `pc` are the values before the step that may have been the entry.
    fn mend_stacked_itstate(&mut self, before: u32, pc: u32) {
        let mut stacked = [0; 4];
        if let Some(address) = self.entry(before, pc)
            && self.read_memory(address, &mut stacked)
        {
            let mended = u32::from_le_bytes(stacked) | before & xpsr::IT_MASK;
            self.write_ram(address, &mended.to_le_bytes());
        }
    }

    /// Records the step, unless it was an exception entry.
    fn record_step(&mut self, before: u32, pc: u32, next: u32) {
        if self.recorder.is_some()
            && self.entry(before, pc).is_none()
            && let Some(recorder) = &mut self.recorder
        {
            recorder.executed(Executed { pc, next, xpsr: before });
        }
    }

    fn write_ram(&self, address: u32, bytes: &[u8]) -> bool {
        address >= CCM_BASE
            && self
                .store(address, bytes.len())
                .is_some_and(|(store, offset)| store.write_at(offset, bytes).is_ok())
    }

    /// Takes over changes of the chip's flash.
    fn take_flash(&mut self, chip: &mut Chip) {
        if let Some(range) = chip.flash_mut().take_changed() {
            let bytes = &chip.flash().bytes()[range.clone()];
            copy(&self.flash, range.start, bytes);
            self.notify(|watcher, core| watcher.flash_changed(range.start, bytes, core));
        }
    }

    fn check_sleep(&self) {
        let (deep, external_clock) =
            self.cpu.with_sys(|sys| (sys.scr & 1 << 2 != 0, sys.syst_csr & 0b101 == 0b001));
        if deep {
            self.report(
                0xE000_ED10,
                Problem::Misuse("SLEEPDEEP: stop and standby are not modelled"),
            );
        }
        if external_clock {
            self.report(0xE000_E010, Problem::Misuse("SysTick on HCLK/8 is not modelled"));
        }
    }

    fn report(&self, address: u32, problem: Problem) {
        let access =
            Access { address, width: Width::Word, now: self.now(), pc: self.link.pc.load(Relaxed) };
        lock(&self.chip).report(access, Some(0), problem);
    }

    /// Notes a stall if the next fetch has to wait for the flash.
    fn check_stall(&mut self, pc: u32) {
        let now = self.now();
        let chip = lock(&self.chip);
        if let Some(end) = chip.stalled_until(pc, now) {
            self.stalled_until = self.clock.cycle_at(end);
        }
        self.flash_busy = chip.flash().operation_end().is_some_and(|end| end > now);
    }

    fn store(&self, address: u32, length: usize) -> Option<(&RamStore, u64)> {
        [(&self.ram, RAM_BASE), (&self.ccm, CCM_BASE), (&self.flash, FLASH_BASE)]
            .into_iter()
            .find_map(|(store, base)| {
                let offset = u64::from(address.checked_sub(base)?);
                (offset + length as u64 <= store.len()).then_some((store.as_ref(), offset))
            })
    }
}

impl Engine for Rsemu {
    fn reset(&mut self, now: Time, hold: Time) {
        // A warm reset would leave NVIC and SysTick on.
        self.cpu.reset(ResetKind::Cold);
        self.irqs = 0;
        let (hclk, at_zero) = {
            let chip = lock(&self.chip);
            (chip.clocks().hclk, chip.at_zero())
        };
        self.space.put_at_zero(at_zero);
        // The new clock starts at the last whole cycle of the old one, so time never goes back.
        let reached = self.now().as_ps().max(now.as_ps());
        self.clock = CycleClock::new(hclk, self.cycles, Time::from_ps(reached));
        self.link.set_clock(self.clock);
        self.stalled_until = self.clock.cycle_at(Time::from_ps(reached) + hold);
        self.flash_busy = false;
        self.spin = None;
        *self.link.accelerator() = Accelerator::new();
        self.sync_flash();
    }

    fn start_from_loader(&mut self, now: Time, hold: Time) {
        /// OTG_FS.
        const USB: Exception = Exception(16 + 67);
        self.reset(now, hold);
        // Takes the first stack pointer and program counter.
        self.cpu.step();
        let chip = Arc::clone(&self.chip);
        let mut chip = lock(&chip);
        chip.leave_loader(self.now());
        self.sync(&chip);
        let mut regs = self.cpu.regs();
        regs.control = control::SPSEL;
        regs.psp = RAM_BASE + 0x1_0000;
        self.cpu.set_regs(regs);
        self.cpu.with_sys(|sys| {
            sys.vtor = 0;
            sys.syst_rvr = 59_999;
            sys.syst_csr = 0b111;
            sys.enable[usize::from(USB.0 / 32)] |= 1 << (USB.0 % 32);
            sys.set_pending(USB, true);
        });
    }

    fn run(&mut self, until: Time) -> Halt {
        let chip = Arc::clone(&self.chip);
        self.sync(&lock(&chip));
        let mut target = self.clock.cycle_at(until);
        let (mut pc, mut before) = self.program_state();
        while self.cycles < target {
            if self.flash_busy {
                self.check_stall(pc);
            }
            if self.stalled_until > self.cycles {
                self.skip(self.stalled_until.min(target) - self.cycles);
                continue;
            }
            self.link.cycles.store(self.cycles, Relaxed);
            self.link.pc.store(pc, Relaxed);
            let step = self.observe();
            let used = self.cpu.step();
            self.cycles += used;
            if self.slowdown > 1 && !self.cpu.is_asleep() {
                self.skip(used * (self.slowdown - 1));
            }
            if self.flash_waits {
                let waits = self.link.accelerator().take_waits();
                if waits > 0 {
                    self.skip(waits);
                }
            }
            if before & xpsr::IT_MASK != 0 {
                self.mend_stacked_itstate(before, pc);
            }
            let (next, after) = self.program_state();
            self.record_step(before, pc, next);
            if let Some(step) = step {
                self.notify_step(step);
            }
            if self.link.written.load(Relaxed) {
                self.link.written.store(false, Relaxed);
                if let Some(halt) = self.after_write(until) {
                    return halt;
                }
                target = self.clock.cycle_at(until);
            }
            self.polls += 1;
            if self.polls >= RESET_POLL || next == pc || self.watcher.is_some() {
                self.polls = 0;
                if self.cpu.reset_requested() {
                    return Halt::ResetRequested;
                }
            }
            self.spin = None;
            if next == pc {
                self.idle(used, target);
            }
            (pc, before) = (next, after);
        }
        Halt::Deadline
    }

    fn sleep(&mut self, until: Time) -> bool {
        let is_asleep = self.cpu.is_asleep() && self.stalled_until <= self.cycles;
        if is_asleep {
            let cycles = self.clock.cycle_at(until).saturating_sub(self.cycles);
            self.skip(cycles);
            self.asleep_cycles += cycles;
        }
        is_asleep
    }

    fn now(&self) -> Time {
        self.clock.time_at(self.cycles)
    }

    fn wake_time(&self) -> Time {
        if self.stalled_until == u64::MAX {
            return Time::MAX;
        }
        if self.stalled_until > self.cycles {
            return self.clock.time_at(self.stalled_until);
        }
        let (irqs, nmi) = {
            let chip = lock(&self.chip);
            (chip.irqs(), chip.nmi())
        };
        let interrupted = self.cpu.with_sys(|sys| {
            let enabled = |irq: u16| irqs >> irq & 1 == 1 && sys.is_enabled(Exception(16 + irq));
            sys.highest_pending().is_some() || irqs != 0 && (0..128).any(enabled)
        });
        let idle = self.spin.is_some() || self.cpu.is_asleep();
        if interrupted || nmi || !idle {
            return self.now();
        }
        self.cycles_to_systick()
            .map_or(Time::MAX, |cycles| self.clock.time_at(self.cycles + cycles))
    }

    fn cycles(&self) -> u64 {
        self.cycles
    }

    fn busy_cycles(&self) -> u64 {
        self.cycles - self.asleep_cycles
    }

    fn read_memory(&self, address: u32, bytes: &mut [u8]) -> bool {
        self.store(address, bytes.len())
            .is_some_and(|(store, offset)| store.read_at(offset, bytes).is_ok())
    }

    fn write_memory(&mut self, address: u32, bytes: &[u8]) -> bool {
        let written = self.write_ram(address, bytes);
        if written {
            self.notify(|watcher, core| watcher.ram_changed(address, bytes, core));
        }
        written
    }

    fn sync_flash(&mut self) {
        let chip = Arc::clone(&self.chip);
        self.take_flash(&mut lock(&chip));
    }

    fn scramble_ram(&mut self, seed: u64) {
        let mut state = seed | 1;
        for store in [&self.ram, &self.ccm] {
            let bytes: Vec<u8> = (0..store.len())
                .map(|_| {
                    state ^= state << 13;
                    state ^= state >> 7;
                    state ^= state << 17;
                    state as u8
                })
                .collect();
            copy(store, 0, &bytes);
        }
    }

    fn lockup(&self) -> Option<Lockup> {
        self.cpu.is_locked_up().then(|| {
            self.cpu.with_sys(|sys| Lockup { cfsr: sys.cfsr, hfsr: sys.hfsr, bfar: sys.bfar })
        })
    }

    fn pc(&self) -> u32 {
        self.cpu.pc()
    }

    fn sp(&self) -> u32 {
        self.cpu.regs().r[13]
    }

    fn registers(&self) -> Registers {
        Registers {
            r: self.cpu.regs().r,
            xpsr: self.cpu.xpsr(),
            s: std::array::from_fn(|number| self.cpu.s(number as u8)),
            fpscr: self.cpu.fpscr(),
        }
    }

    fn record(&mut self, recorder: Recorder) {
        self.recorder = Some(recorder);
    }

    fn watch(&mut self, watcher: Box<dyn Watcher>) {
        self.link.watched.store(true, Relaxed);
        self.watcher = Some(watcher);
    }
}

fn lock(chip: &Mutex<Chip>) -> MutexGuard<'_, Chip> {
    chip.lock().expect("a panic while the chip was in use")
}

fn copy(store: &RamStore, offset: usize, bytes: &[u8]) {
    store.write_at(offset as u64, bytes).expect("the store has the size of the memory");
}
