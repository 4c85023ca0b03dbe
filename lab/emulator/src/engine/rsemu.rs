//! The engine: rsemu's ARMv7E-M core with the chip's memories mapped directly and its peripherals behind calls.

mod accelerator;
mod bus;
mod fast;
mod follow;

use std::{
    iter,
    ops::Range,
    sync::{Arc, Mutex, MutexGuard, atomic::Ordering::Relaxed},
};

use rsemu::{
    core::{
        device::{Device, ResetKind},
        space::RamStore,
    },
    cpu::arm::v7m::{
        ArmV7m, Config,
        sys::{Exception, Sys, control},
        xpsr,
    },
};

use super::{Engine, Halt, Lockup, clock::CycleClock};
use crate::{
    Time,
    chip::{Access, CCM_BASE, Chip, FLASH_BASE, Problem, RAM_BASE, Width},
};
use accelerator::Accelerator;
use bus::{Link, Space};
use fast::{Decoded, Fast, Memories};

/// Bits of SYST_CSR: counter enabled, and its interrupt enabled.
const SYSTICK_INTERRUPTS: u32 = 0b11;

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
    /// The number of waits for a busy bank of the flash.
    stalls: u64,
    is_halted: bool,
    /// The cycles of the last instruction, if it was a jump to itself.
    spin: Option<u64>,
    /// The factor by which an instruction's cycles are multiplied.
    slowdown: u64,
    /// Whether reads of the flash have wait states.
    flash_waits: bool,
    irqs: u128,
    /// The cycles until a line that falls reaches the core, and the cycle at which those do that have fallen.
    late_lines: u64,
    fall_at: Option<u64>,
    /// Set while no exception can be taken before SysTick interrupts, the chip changes or rsemu executes an instruction:
    /// the addresses that the MPU guards.
    settled: Option<Range<u32>>,
    /// The double words of the flash with a double error.
    double_errors: Vec<u32>,
    decoded: Decoded,
}

impl Rsemu {
    /// A CPU for `chip`, not yet reset, with empty memories.
    pub fn new(chip: Arc<Mutex<Chip>>) -> Self {
        let (part, variant, hclk) = {
            let chip = lock(&chip);
            (chip.part(), chip.variant(), chip.clocks().hclk)
        };
        let clock = CycleClock::new(hclk, 0, Time::ZERO);
        let flash = Arc::new(RamStore::new(part.flash_size().into()));
        let link = Arc::new(Link::new(clock));
        let ram = Arc::new(fast::ram(part.ram_size()));
        let ccm = Arc::new(RamStore::new(part.ccm_size().into()));
        let config = Config::CORTEX_M4F.with_priority_bits(4);
        let cpu = ArmV7m::new(config);
        let space = Space::new(&chip, &link, [&flash, &ram, &ccm], part, variant);
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
            stalls: 0,
            is_halted: false,
            spin: None,
            slowdown: variant.slowdown.max(1).into(),
            flash_waits: variant.flash_waits,
            irqs: 0,
            late_lines: variant.late_lines.into(),
            fall_at: None,
            settled: None,
            double_errors: Vec::new(),
            decoded: Decoded::new(),
        }
    }

    /// Advances by cycles in which the core executes nothing.
    fn skip(&mut self, cycles: u64) {
        let interrupts = self.cpu.with_sys(|sys| {
            sys.tick_cyccnt(cycles);
            let interrupts =
                sys.tick_systick(cycles) && sys.syst_csr & SYSTICK_INTERRUPTS == SYSTICK_INTERRUPTS;
            if interrupts {
                sys.set_pending(Exception::SYSTICK, true);
            }
            interrupts
        });
        if interrupts {
            self.settled = None;
        }
        self.cycles += cycles;
    }

    /// Whether rsemu would now execute privileged instructions, one after the other; then the addresses that the MPU
    /// guards.
    fn settled(&self) -> Option<Range<u32>> {
        if self.cpu.is_asleep() || self.cpu.regs().control & control::NPRIV != 0 {
            return None;
        }
        let priority = self.cpu.execution_priority();
        self.cpu.with_sys(|sys| {
            let has_taken_all = sys.highest_pending().is_none_or(|(_, waits)| waits >= priority)
                && exceptions(self.irqs).all(|irq| sys.is_pending(irq) || sys.is_active(irq));
            if has_taken_all { guarded(sys) } else { None }
        })
    }

    /// Executes common instructions up to cycle `target`, if the next ones are; returns the cycles.
    fn run_fast(&mut self, target: u64) -> u64 {
        let Some(guarded) = self.settled.clone() else { return 0 };
        let target = self.fall_at.map_or(target, |fall| target.min(fall));
        let target = match self.cycles_to_systick() {
            Some(ticks) => target.min(self.cycles + ticks),
            None => target,
        };
        let memories = Memories {
            flash: &self.flash,
            ram: &self.ram,
            ccm: &self.ccm,
            chip: &self.space.chip,
            guarded,
            double_errors: &self.double_errors,
            is_flash_busy: self.link.flash_busy.load(Relaxed),
        };
        let mut fast = Fast::new(self.cpu.regs(), memories, &mut self.decoded);
        let mut used = 0;
        while self.cycles + used < target && !fast.has_stored && !fast.has_unmasked {
            self.link.cycles.store(self.cycles + used, Relaxed);
            self.link.pc.store(fast.regs.r[15], Relaxed);
            let Some(cycles) = fast.step() else { break };
            used += cycles * self.slowdown;
        }
        if used > 0 {
            let may_interrupt = fast.has_unmasked;
            self.cpu.set_regs(fast.into_regs());
            self.skip(used);
            self.spin = None;
            if may_interrupt {
                self.settled = self.settled();
            }
        }
        used
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

    /// Advances to `until` while a debugger halts the core: neither SysTick nor DWT_CYCCNT counts.
    fn pass_halted(&mut self, until: Time) {
        let cycles = self.clock.cycle_at(until).saturating_sub(self.cycles);
        self.cycles += cycles;
        self.asleep_cycles += cycles;
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

    /// Follows the chip if the program has written to it.
    fn after_step(&mut self, until: Time, target: &mut u64) -> Option<Halt> {
        if !self.link.written.load(Relaxed) {
            return None;
        }
        self.link.written.store(false, Relaxed);
        let halt = self.after_write(until);
        *target = self.clock.cycle_at(until);
        halt
    }

    /// Restores ITSTATE in the stacked xPSR: rsemu 0.0.7 leaves it out at an exception entry, so that the rest of an
    /// interrupted IT block would run unconditionally.
    ///
    /// `before` and `pc` are the values before the step that may have been the entry.
    fn mend_stacked_itstate(&mut self, before: u32, pc: u32) {
        const STACKED_PC: u32 = 6 * 4;
        let regs = self.cpu.regs();
        if (regs.xpsr ^ before) & xpsr::EXCEPTION == 0 {
            return;
        }
        let was_handler = before & xpsr::EXCEPTION != 0;
        let used_psp = !was_handler && regs.control & control::SPSEL != 0;
        let frame = if used_psp { regs.psp } else { regs.msp };
        let address = frame + STACKED_PC;
        let mut stacked = [0; 8];
        // An exception return changes the exception number too, but has not stacked this PC.
        if self.read_memory(address, &mut stacked) && stacked[..4] == pc.to_le_bytes() {
            let [.., a, b, c, d] = stacked;
            let mended = u32::from_le_bytes([a, b, c, d]) | before & xpsr::IT_MASK;
            self.write_ram(address + 4, &mended.to_le_bytes());
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
            self.decoded.forget(FLASH_BASE + range.start as u32..FLASH_BASE + range.end as u32);
            self.double_errors = chip.flash().double_errors().collect();
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
            self.stalls += 1;
        }
        let is_busy = chip.flash().operation_end().is_some_and(|end| end > now);
        self.link.flash_busy.store(is_busy, Relaxed);
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
        self.settled = None;
        self.irqs = 0;
        let (hclk, at_zero, stays_in_loader) = {
            let chip = lock(&self.chip);
            (chip.clocks().hclk, chip.at_zero(), chip.stays_in_loader())
        };
        self.space.put_at_zero(at_zero);
        // The new clock starts at the last whole cycle of the old one, so time never goes back.
        let reached = self.now().as_ps().max(now.as_ps());
        self.clock = CycleClock::new(hclk, self.cycles, Time::from_ps(reached));
        self.link.set_clock(self.clock);
        self.stalled_until = match stays_in_loader {
            true => u64::MAX,
            false => self.clock.cycle_at(Time::from_ps(reached) + hold),
        };
        self.link.flash_busy.store(false, Relaxed);
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
        if self.is_halted {
            self.pass_halted(until);
            return Halt::Deadline;
        }
        while self.cycles < target {
            if self.fall_at.is_some_and(|fall| self.cycles >= fall) {
                self.sync_irqs(&lock(&chip));
            }
            if self.link.flash_busy.load(Relaxed) {
                self.check_stall(self.cpu.pc());
            }
            if self.stalled_until > self.cycles {
                self.skip(self.stalled_until.min(target) - self.cycles);
                continue;
            }
            let is_busy = self.link.flash_busy.load(Relaxed);
            if !self.flash_waits && self.run_fast(target) > 0 {
                if let Some(halt) = self.after_step(until, &mut target) {
                    return halt;
                }
                continue;
            }
            let (pc, before) = self.program_state();
            self.link.cycles.store(self.cycles, Relaxed);
            self.link.pc.store(pc, Relaxed);
            self.settled = None;
            let used = self.cpu.step();
            self.cycles += used;
            if is_busy {
                let end = self.link.load_waits_until.swap(0, Relaxed);
                self.stalled_until = self.stalled_until.max(end);
                self.stalls += u64::from(end > self.cycles);
            }
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
            let next = self.cpu.pc();
            if let Some(halt) = self.after_step(until, &mut target) {
                return halt;
            }
            if self.cpu.reset_requested() {
                return Halt::ResetRequested;
            }
            self.spin = None;
            self.settled = self.settled();
            if next == pc {
                self.idle(used, target);
            }
        }
        Halt::Deadline
    }

    fn set_halted(&mut self, is_halted: bool) {
        self.is_halted = is_halted;
    }

    fn sleep(&mut self, until: Time) -> bool {
        if self.is_halted {
            self.pass_halted(until);
            return true;
        }
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
        if self.stalled_until == u64::MAX || self.is_halted {
            return Time::MAX;
        }
        if self.stalled_until > self.cycles {
            return self.clock.time_at(self.stalled_until);
        }
        if self.spin.is_none() && !self.cpu.is_asleep() {
            return self.now();
        }
        let (irqs, nmi) = {
            let chip = lock(&self.chip);
            (chip.irqs(), chip.nmi())
        };
        let interrupted = self.cpu.with_sys(|sys| {
            sys.highest_pending().is_some() || exceptions(irqs).any(|irq| sys.is_enabled(irq))
        });
        if interrupted || nmi {
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

    fn stalls(&self) -> u64 {
        self.stalls
    }

    fn read_memory(&self, address: u32, bytes: &mut [u8]) -> bool {
        self.store(address, bytes.len())
            .is_some_and(|(store, offset)| store.read_at(offset, bytes).is_ok())
    }

    fn write_memory(&mut self, address: u32, bytes: &[u8]) -> bool {
        self.write_ram(address, bytes)
    }

    fn sync_flash(&mut self) {
        let chip = Arc::clone(&self.chip);
        self.take_flash(&mut lock(&chip));
    }

    fn scramble_ram(&mut self, seed: u64) {
        let mut state = seed | 1;
        for store in [&self.ram, &self.ccm] {
            let words = (0..store.len() / 8).flat_map(|_| {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                state.to_le_bytes()
            });
            let bytes: Vec<u8> = words.collect();
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
}

/// The addresses of the MPU's only region, above those of the flash and with the default map elsewhere.
fn guarded(sys: &Sys) -> Option<Range<u32>> {
    /// MPU_CTRL: the MPU is on, and privileged code has the default map elsewhere.
    const ON: u32 = 0b001;
    const DEFAULT_MAP: u32 = 0b100;
    if sys.mpu_ctrl & ON == 0 {
        return Some(0..0);
    }
    let mut regions = iter::zip(sys.mpu_rbar, sys.mpu_rasr).filter(|(_, rasr)| rasr & 1 == 1);
    let (Some((rbar, rasr)), None) = (regions.next(), regions.next()) else { return None };
    let size = 1_u32.checked_shl((rasr >> 1 & 0x1F) + 1)?;
    let base = rbar & !(size - 1);
    let is_simple = sys.mpu_ctrl & DEFAULT_MAP != 0 && base >= CCM_BASE;
    is_simple.then(|| base..base.saturating_add(size))
}

/// The exceptions of the interrupt lines that are high.
fn exceptions(mut irqs: u128) -> impl Iterator<Item = Exception> {
    iter::from_fn(move || {
        let irq = irqs.trailing_zeros() as u16;
        irqs &= irqs.wrapping_sub(1);
        (irq < 128).then_some(Exception(16 + irq))
    })
}

fn lock(chip: &Mutex<Chip>) -> MutexGuard<'_, Chip> {
    chip.lock().expect("a panic while the chip was in use")
}

fn copy(store: &RamStore, offset: usize, bytes: &[u8]) {
    store.write_at(offset as u64, bytes).expect("the store has the size of the memory");
}
