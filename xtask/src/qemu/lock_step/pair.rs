//! Both cores: QEMU's is led where the emulator's has gone, and compared.

use std::ops::Range;

use anyhow::{Context, bail, ensure};
use emulator::{
    chip::RAM_BASE,
    engine::{Engine, Registers, Step},
    image::Image,
};

use super::{
    Limits, PART, Tally,
    difference::{Access, Difference, halfword, list, place},
};
use crate::qemu::gdb::Gdb;

/// The plugin's window, see `qemu/src/mirror.rs`.
mod window {
    pub const LOADS: u32 = 0x6000_0000;
    pub const LOADS_AT_ONCE: usize = 0x40;
    pub const RAISE: u32 = 0x6000_0100;
    pub const LOWER: u32 = 0x6000_0104;
    pub const PEND_SYSTICK: u32 = 0x6000_0108;
    pub const RESET: u32 = 0x6000_010C;
    pub const SYSTICK: u32 = 0x6000_0110;
    pub const ACCESSES: u32 = 0x6000_0200;
    /// Of three words each.
    pub const ACCESSES_AT_ONCE: usize = 0x15;
    pub const SETTINGS: u32 = 0x6000_8000;
}

/// Sectors 1 and 2 of the flash.
const SETTINGS: Range<usize> = 0x4000..0xC000;
/// A load with a base from here can reach SysTick: an instruction's offset is -255 to 4095.
const NEAR_SYSTICK: Range<u32> = 0xE000_D000..0xE000_E120;
/// The same for the ICSR, 0xE000_ED04.
const NEAR_ICSR: Range<u32> = 0xE000_DD00..0xE000_EE08;
/// What no single step shows is compared after so many instructions.
const CHECK_INTERVAL: u64 = 50_000;
const VECTORS: u32 = 0x0800_0000;
const SP: usize = 13;
const LR: usize = 14;
pub const PC: usize = 15;
/// IPSR in the xPSR.
const EXCEPTION: u32 = 0x1FF;
/// APSR in the xPSR.
const FLAGS: u32 = 0xF80F_0000;
const ITSTATE: u32 = 0x0600_FC00;
const WFI: u16 = 0xBF30;

/// What a step was.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// An instruction; it may have returned from an exception.
    Instruction,
    /// An instruction that returned from an exception and went on to the next.
    TailChain,
    /// An exception entry.
    Entry,
    Reset,
}

impl Kind {
    fn of(step: &Step, now: &Registers, core: &dyn Engine) -> Self {
        let exception = now.xpsr & EXCEPTION;
        let mut vector = [0; 4];
        core.read_memory(VECTORS + 4 * exception, &mut vector);
        let is_entry = exception != 0
            && exception != step.before.xpsr & EXCEPTION
            && u32::from_le_bytes(vector) & !1 == now.r[PC];
        match is_entry {
            _ if step.from_reset => Self::Reset,
            false => Self::Instruction,
            // The program has one stack.
            true if now.r[SP] < step.before.r[SP] => Self::Entry,
            true => Self::TailChain,
        }
    }
}

/// QEMU's core, and how far it has come after the emulator's.
pub struct Pair {
    gdb: Gdb,
    image: Image,
    limits: Limits,
    tally: Tally,
    /// The interrupt lines that QEMU has high.
    irqs: u128,
    /// Whether SysTick was pending in the emulator when QEMU was told last.
    systick_pending: bool,
    /// The registers before each instruction that QEMU has not executed yet.
    behind: Vec<Registers>,
}

impl Pair {
    pub fn new(gdb: Gdb, image: Image, limits: Limits) -> Self {
        Self {
            gdb,
            image,
            limits,
            tally: Tally::default(),
            irqs: 0,
            systick_pending: false,
            behind: Vec::new(),
        }
    }

    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    /// Whether as much has been compared as was asked for.
    pub fn is_complete(&self) -> bool {
        self.tally.instructions >= self.limits.instructions
    }

    /// The emulator's core has made a step.
    pub fn follow(&mut self, step: &Step, core: &dyn Engine) -> anyhow::Result<()> {
        let now = core.registers();
        let kind = Kind::of(step, &now, core);
        let can_wait = kind == Kind::Instruction && !self.meets_anything(step, core);
        if !can_wait {
            self.catch_up(&step.before, core)?;
        }
        self.interrupt(step)?;
        if kind == Kind::Reset {
            return self.reset(step, &now, core);
        }
        self.count(kind, &step.before, &now);
        if kind != Kind::Entry && self.limits.corrupt == Some(self.tally.instructions) {
            for (number, value) in step.before.r[..SP].iter().enumerate() {
                self.gdb.set_register(number, value ^ 1)?;
            }
        }
        if can_wait {
            self.behind.push(step.before);
            if self.behind.len() >= self.limits.stride {
                self.catch_up(&now, core)?;
            }
        } else {
            self.step(step, kind, &now, core)?;
        }
        if kind != Kind::Entry
            && (self.is_complete() || self.tally.instructions.is_multiple_of(CHECK_INTERVAL))
        {
            self.catch_up(&now, core)?;
            self.check(core)?;
        }
        Ok(())
    }

    fn count(&mut self, kind: Kind, before: &Registers, now: &Registers) {
        if kind != Kind::Entry {
            self.tally.instructions += 1;
        }
        if kind != Kind::Instruction {
            let handler = match self.image.symbol_at(now.r[PC]) {
                Some((name, _)) => name.to_owned(),
                None => format!("{:08x}", now.r[PC]),
            };
            *self.tally.exceptions.entry(handler).or_default() += 1;
        }
        match kind {
            Kind::TailChain => self.tally.tail_chained += 1,
            Kind::Entry => {
                self.tally.nested += u64::from(before.xpsr & EXCEPTION != 0);
                self.tally.in_it_block += u64::from(before.xpsr & ITSTATE != 0);
            }
            Kind::Instruction | Kind::Reset => {}
        }
    }

    /// Whether an instruction takes anything from outside of the core and its memories, or gives it there.
    fn meets_anything(&self, step: &Step, core: &dyn Engine) -> bool {
        step.requests_reset
            || !step.transfers.is_empty()
            || step.irqs != self.irqs
            || step.systick_pending != self.systick_pending
            || may_load(step, core, NEAR_SYSTICK)
            || may_load(step, core, NEAR_ICSR)
            || is_sleep(step, core)
    }

    /// Lets QEMU execute what it is behind, up to where the registers are `now`, and compares.
    fn catch_up(&mut self, now: &Registers, core: &dyn Engine) -> anyhow::Result<()> {
        let behind = std::mem::take(&mut self.behind);
        let Some(first) = behind.first() else {
            return Ok(());
        };
        if let [_, others @ .., last] = behind.as_slice() {
            let passed = others.iter().filter(|before| before.r[PC] == last.r[PC]).count();
            self.gdb.run_to(last.r[PC], passed + 1).with_context(|| {
                let from = place(&self.image, first.r[PC]);
                format!(
                    "within {} instructions from {from} on, up to instruction {}. To see where, \
                     run it without --stride",
                    behind.len(),
                    self.tally.instructions
                )
            })?;
        }
        // Only a step ends before an exception that the instruction lets happen.
        self.gdb.step()?;
        self.compare(behind.len(), first, now, core)
    }

    /// Lets QEMU make a step, with what it needs from outside, and compares.
    fn step(
        &mut self,
        step: &Step,
        kind: Kind,
        now: &Registers,
        core: &dyn Engine,
    ) -> anyhow::Result<()> {
        if may_load(step, core, NEAR_SYSTICK) {
            self.gdb.write(window::SYSTICK, step.systick.map(u32::to_le_bytes).as_flattened())?;
        }
        let loaded = step.transfers.iter().filter(|transfer| !transfer.is_store);
        let loads: Vec<u8> = loaded.flat_map(|load| load.value.to_le_bytes()).collect();
        ensure!(loads.len() <= 4 * window::LOADS_AT_ONCE, "one instruction loads too much");
        self.gdb.write(window::LOADS, &loads)?;
        if step.requests_reset {
            // Of a reset that it makes by itself, QEMU does not say when it is over.
            return self.gdb.write(window::RESET, &[0; 4]);
        }
        if kind != Kind::Entry && is_sleep(step, core) {
            // It may do nothing (ARM DDI 0403, B1.5.19). In QEMU the step would last until the next interrupt.
            self.tally.sleeps += 1;
            self.gdb.set_register(PC, step.before.r[PC] + 2)?;
        } else {
            self.gdb.step()?;
        }
        if may_load(step, core, NEAR_ICSR) {
            self.leave_out_vectactive(now)?;
        }
        self.compare_accesses(step)?;
        self.compare(usize::from(kind != Kind::Entry), &step.before, now, core)
    }

    /// rsemu 0.0.7 has no VECTACTIVE in the ICSR, the number of the exception that is served: a register of QEMU that differs
    /// in nothing else takes over ours.
    fn leave_out_vectactive(&mut self, ours: &Registers) -> anyhow::Result<()> {
        let (theirs, _) = self.gdb.registers()?;
        for (number, (theirs, ours_is)) in theirs.iter().zip(ours.r).enumerate().take(SP) {
            if *theirs != ours_is && *theirs == ours_is | ours.xpsr & EXCEPTION {
                self.gdb.set_register(number, ours_is)?;
                self.tally.vectactive += 1;
            }
        }
        Ok(())
    }

    /// Drives QEMU's interrupt lines and SysTick's exception as they were before the step.
    fn interrupt(&mut self, step: &Step) -> anyhow::Result<()> {
        let mut changed = self.irqs ^ step.irqs;
        self.irqs = step.irqs;
        while changed != 0 {
            let number = changed.trailing_zeros();
            changed &= changed - 1;
            let is_high = step.irqs >> number & 1 == 1;
            let place = if is_high { window::RAISE } else { window::LOWER };
            self.gdb.write(place, &number.to_le_bytes())?;
        }
        if step.systick_pending && !self.systick_pending {
            self.gdb.write(window::PEND_SYSTICK, &[0; 4])?;
        }
        self.systick_pending = step.systick_pending;
        Ok(())
    }

    /// Both begin anew. A reset leaves anything in most registers, a power-on in RAM too: QEMU takes over ours.
    fn reset(&mut self, step: &Step, now: &Registers, core: &dyn Engine) -> anyhow::Result<()> {
        if self.tally.resets == 0 {
            let mut ram = vec![0; PART.ram_size() as usize];
            ensure!(core.read_memory(RAM_BASE, &mut ram), "the emulator has too little RAM");
            self.gdb.write(RAM_BASE, &ram)?;
        }
        self.tally.resets += 1;
        let (_, xpsr) = self.gdb.registers()?;
        for number in (0..SP).chain([LR]) {
            self.gdb.set_register(number, now.r[number])?;
        }
        self.gdb.set_xpsr(xpsr & !FLAGS | now.xpsr & FLAGS)?;
        self.compare(0, &step.before, now, core)?;
        self.check(core)
    }

    /// Compares the registers; QEMU has executed so many instructions since `before`.
    fn compare(
        &mut self,
        executed: usize,
        before: &Registers,
        ours: &Registers,
        core: &dyn Engine,
    ) -> anyhow::Result<()> {
        let (r, xpsr) = self.gdb.registers()?;
        let theirs = &Registers { r, xpsr, ..*ours };
        let instruction = self.tally.instructions;
        let image = &self.image;
        ensure!(
            theirs == ours,
            "{}",
            Difference { instruction, executed, before, ours, theirs, image, core }
        );
        self.tally.comparisons += 1;
        Ok(())
    }

    /// Compares the accesses to peripherals and to flash.
    fn compare_accesses(&mut self, step: &Step) -> anyhow::Result<()> {
        if step.transfers.is_empty() {
            return Ok(());
        }
        let theirs = self.take_accesses()?;
        let ours: Vec<Access> = step.transfers.iter().map(Access::from).collect();
        ensure!(
            theirs == ours,
            "the first difference is in what {}, instruction {}, accesses\n\
             emulator: {}\n    QEMU: {}",
            place(&self.image, step.before.r[PC]),
            self.tally.instructions,
            list(&ours),
            list(&theirs),
        );
        let stores = step.transfers.iter().filter(|transfer| transfer.is_store).count();
        self.tally.stores += stores as u64;
        self.tally.loads += (ours.len() - stores) as u64;
        Ok(())
    }

    /// QEMU's accesses to peripherals since the last call.
    fn take_accesses(&mut self) -> anyhow::Result<Vec<Access>> {
        let mut bytes = [0; 12 * window::ACCESSES_AT_ONCE];
        self.gdb.read(window::ACCESSES, &mut bytes)?;
        let (words, _) = bytes.as_chunks::<4>();
        let accesses = words.as_chunks::<3>().0.iter().map(|words| {
            let [kind, address, value] = words.map(u32::from_le_bytes);
            Access { kind, address, value }
        });
        Ok(accesses.take_while(|access| access.kind != 0).collect())
    }

    /// Compares what no single step shows.
    fn check(&mut self, core: &dyn Engine) -> anyhow::Result<()> {
        let instruction = self.tally.instructions;
        let surplus = self.take_accesses()?;
        ensure!(
            surplus.is_empty(),
            "in QEMU alone the program accesses peripherals, up to instruction {instruction}: {}",
            list(&surplus)
        );
        let ours = core.registers();
        let (s, fpscr) = self.gdb.fp_registers()?;
        ensure!(
            (s, fpscr) == (ours.s, ours.fpscr),
            "the floating-point registers differ after instruction {instruction}:\n\
             emulator: {:08x?}, FPSCR {:08x}\n    QEMU: {s:08x?}, FPSCR {fpscr:08x}",
            ours.s,
            ours.fpscr,
        );
        let mut ours = vec![0; PART.ram_size() as usize];
        let mut theirs = ours.clone();
        ensure!(core.read_memory(RAM_BASE, &mut ours), "the emulator has too little RAM");
        self.gdb.read(RAM_BASE, &mut theirs)?;
        if let Some(offset) = ours.iter().zip(&theirs).position(|(ours, theirs)| ours != theirs) {
            let (ours, theirs) = (ours[offset], theirs[offset]);
            bail!(
                "RAM differs after instruction {instruction}: {:#010x} holds {ours:02x} in the \
                 emulator, {theirs:02x} in QEMU",
                RAM_BASE + offset as u32,
            );
        }
        self.tally.checks += 1;
        Ok(())
    }

    /// The emulator's chip has programmed or erased.
    pub fn change_flash(
        &mut self,
        offset: usize,
        bytes: &[u8],
        core: &dyn Engine,
    ) -> anyhow::Result<()> {
        self.catch_up(&core.registers(), core)?;
        let is_inside = SETTINGS.start <= offset && offset + bytes.len() <= SETTINGS.end;
        ensure!(is_inside, "the program changes the flash outside of the settings, at {offset:#x}");
        self.gdb.write(window::SETTINGS + (offset - SETTINGS.start) as u32, bytes)
    }

    /// The emulator's debug probe has written to RAM, as it does when it has fetched the log.
    pub fn change_ram(
        &mut self,
        address: u32,
        bytes: &[u8],
        core: &dyn Engine,
    ) -> anyhow::Result<()> {
        self.catch_up(&core.registers(), core)?;
        self.gdb.write(address, bytes)
    }
}

/// Whether an instruction may load a word from what is `near` its base. Were a load of SysTick missed, QEMU would have what was
/// there before: a difference.
fn may_load(step: &Step, core: &dyn Engine, near: Range<u32>) -> bool {
    // ARM DDI 0403, A5.2 and A5.3: loads of words.
    let is_load = match halfword(core, step.before.r[PC]).to_be_bytes() {
        [0x58..=0x5F | 0x68..=0x6F | 0xC8..=0xCF, _] => true,
        [0xE8 | 0xE9 | 0xF8, low] => low & 0x10 != 0,
        _ => false,
    };
    is_load && step.before.r.iter().any(|register| near.contains(register))
}

fn is_sleep(step: &Step, core: &dyn Engine) -> bool {
    halfword(core, step.before.r[PC]) == WFI
}
