//! The common instructions, executed on a copy of the registers in a tenth of the time that rsemu takes.

use std::ops::Range;

use rsemu::{
    core::{
        space::RamStore,
        value::{Endian, Width},
    },
    cpu::arm::v7m::{
        Regs,
        isa::{
            BitfieldOp, Cond, DpOp, ExtendOp, HintOp, Insn, MemOffset, MiscOp, Operand, Shift,
            ShiftType, Size, decode, is_32bit,
        },
        sys::{control, exc_return},
        xpsr,
    },
};

use super::bus::Aperture;
use crate::chip::{CCM_BASE, FLASH_BASE, RAM_BASE};

/// The peripherals on APB and AHB1.
const PERIPHERALS: Range<u32> = 0x4000_0000..0x4008_0000;
/// Those of them that may answer with a bus fault: the flash's of an STM32F4 and of an STM32G4.
const MAY_FAULT: [Range<u32>; 2] = [0x4002_3C00..0x4002_4000, 0x4002_2000..0x4002_2400];

/// The length of a line of the RAM, as a power of two: what a store may change of the decoded instructions.
const LINE_BITS: u32 = 6;

/// A RAM that notes which of its lines were written.
pub fn ram(length: u32) -> RamStore {
    RamStore::with_page_bits(length.into(), LINE_BITS)
}

/// What loads, stores and fetches reach.
pub struct Memories<'a> {
    pub flash: &'a RamStore,
    pub ram: &'a RamStore,
    pub ccm: &'a RamStore,
    pub chip: &'a Aperture,
    /// The addresses that only rsemu accesses.
    pub guarded: Range<u32>,
    /// The double words of the flash that only rsemu reads.
    pub double_errors: &'a [u32],
    /// Only rsemu reads the flash, as it may have to wait.
    pub is_flash_busy: bool,
}

impl<'a> Memories<'a> {
    fn is_guarded(&self, address: u32, length: u32) -> bool {
        address < self.guarded.end && self.guarded.start < address.saturating_add(length)
    }

    /// The writable memory that has `length` bytes at `address`, and the offset in it.
    fn writable(&self, address: u32, length: u32) -> Option<(&'a RamStore, u64)> {
        let memory = within(self.ram, RAM_BASE, address, length)
            .or_else(|| within(self.ccm, CCM_BASE, address, length))?;
        (!self.is_guarded(address, length)).then_some(memory)
    }

    fn readable(&self, address: u32, length: u32) -> Option<(&'a RamStore, u64)> {
        self.flash(address, length).or_else(|| self.writable(address, length))
    }

    fn flash(&self, address: u32, length: u32) -> Option<(&'a RamStore, u64)> {
        let (store, offset) = within(self.flash, FLASH_BASE, address, length)?;
        let is_good = !self.is_flash_busy && !self.double_errors.contains(&(offset as u32 & !7));
        is_good.then_some((store, offset))
    }

    fn is_peripheral(&self, address: u32, size: Size) -> bool {
        PERIPHERALS.contains(&address)
            && !MAY_FAULT.iter().any(|range| range.contains(&address))
            && !self.is_guarded(address, size.bytes())
            && address.is_multiple_of(size.bytes())
    }

    fn code(&self, address: u32) -> Option<u16> {
        let in_ram = || within(self.ram, RAM_BASE, address, 2);
        let (memory, offset) = self.flash(address, 2).or_else(in_ram)?;
        Some(read(memory, offset, Size::Half)? as u16)
    }
}

fn within(store: &RamStore, base: u32, address: u32, length: u32) -> Option<(&RamStore, u64)> {
    let offset = u64::from(address.checked_sub(base)?);
    (offset + u64::from(length) <= store.len()).then_some((store, offset))
}

fn width(size: Size) -> Width {
    match size {
        Size::Byte => Width::U8,
        Size::Half => Width::U16,
        Size::Word => Width::U32,
    }
}

fn read(store: &RamStore, offset: u64, size: Size) -> Option<u32> {
    store.read_value(offset, width(size), Endian::Little).ok().map(|value| value as u32)
}

fn write(store: &RamStore, offset: u64, size: Size, value: u32) -> Option<()> {
    store.write_value(offset, width(size), value.into(), Endian::Little).ok()
}

/// The latest instructions, decoded.
pub struct Decoded(Vec<Place>);

/// An instruction, where it is, and whether it is 32 bits long.
#[derive(Clone, Copy)]
struct Place {
    address: u32,
    insn: Insn,
    is_wide: bool,
}

impl Decoded {
    /// A power of two.
    const LENGTH: usize = 4096;
    /// Where no instruction is.
    const NOWHERE: u32 = 1;

    pub fn new() -> Self {
        let (address, insn) = (Self::NOWHERE, Insn::Undefined);
        Self(vec![Place { address, insn, is_wide: false }; Self::LENGTH])
    }

    /// Forgets what may lie at these addresses, whose content has changed.
    pub fn forget(&mut self, changed: Range<u32>) {
        // An instruction of 32 bits may begin before them.
        let changed = (changed.start & !1) - 2..changed.end;
        for pc in changed.clone().step_by(2).take(Self::LENGTH) {
            let Place { address, .. } = self.place(pc);
            if changed.contains(address) {
                *address = Self::NOWHERE;
            }
        }
    }

    fn place(&mut self, pc: u32) -> &mut Place {
        &mut self.0[pc as usize / 2 % Self::LENGTH]
    }

    /// Forgets what lies in the line of the RAM at this address, if its content has changed.
    fn follow(&mut self, ram: &RamStore, address: u32) {
        let line = u64::from(address.wrapping_sub(RAM_BASE) >> LINE_BITS);
        if ram.is_page_dirty(line) {
            ram.take_page_dirty(line);
            let start = address >> LINE_BITS << LINE_BITS;
            self.forget(start..start + (1 << LINE_BITS));
        }
    }

    /// The instruction at `pc`.
    fn instruction(&mut self, pc: u32, memories: &Memories) -> Option<&Place> {
        if pc >= CCM_BASE {
            self.follow(memories.ram, pc);
            if pc >> LINE_BITS != pc.wrapping_add(2) >> LINE_BITS {
                self.follow(memories.ram, pc.wrapping_add(2));
            }
            if memories.is_guarded(pc, 4) {
                return None;
            }
        } else if memories.is_flash_busy {
            return None;
        }
        let place = self.place(pc);
        if place.address != pc {
            let first = memories.code(pc)?;
            let is_wide = is_32bit(first);
            let second = if is_wide { memories.code(pc.wrapping_add(2))? } else { 0 };
            *place = Place { address: pc, insn: decode(first, second), is_wide };
        }
        Some(place)
    }
}

/// A core in privileged mode between two events, without an exception that it could take.
pub struct Fast<'a> {
    pub regs: Regs,
    pub memories: Memories<'a>,
    decoded: &'a mut Decoded,
    /// The cycles of the instruction so far, and the address that it jumps to.
    cycles: u64,
    jump: Option<u32>,
    /// Whether the chip has changed.
    pub has_stored: bool,
    /// Whether an exception that was masked may be taken.
    pub has_unmasked: bool,
}

impl<'a> Fast<'a> {
    pub fn new(regs: Regs, memories: Memories<'a>, decoded: &'a mut Decoded) -> Self {
        Self {
            regs,
            memories,
            decoded,
            cycles: 0,
            jump: None,
            has_stored: false,
            has_unmasked: false,
        }
    }

    /// The registers in the form that rsemu takes.
    pub fn into_regs(mut self) -> Regs {
        if self.in_handler() || self.regs.control & control::SPSEL == 0 {
            self.regs.msp = self.regs.r[13];
        } else {
            self.regs.psp = self.regs.r[13];
        }
        self.regs
    }

    /// Executes an instruction and returns its cycles. Without an answer nothing has changed: the instruction is a rare
    /// one, jumps to itself, or concerns peripherals, exceptions or faults.
    pub fn step(&mut self) -> Option<u64> {
        let pc = self.regs.r[15];
        if self.regs.xpsr & xpsr::T == 0 {
            return None;
        }
        let &Place { insn, is_wide, .. } = self.decoded.instruction(pc, &self.memories)?;
        let it = it_state(self.regs.xpsr);
        if it != 0 && matches!(insn, Insn::It { .. }) {
            return None;
        }
        self.cycles = 1;
        self.jump = None;
        if it == 0 || Cond(it >> 4).passes(self.regs.xpsr) {
            // What an instruction reads as its PC.
            self.regs.r[15] = pc.wrapping_add(4);
            // In an IT block the narrow instructions leave the flags alone.
            if self.execute(insn, pc, is_wide || it == 0).is_none() {
                self.regs.r[15] = pc;
                return None;
            }
        }
        // IT itself has set the state of the next instruction.
        if it != 0 {
            self.set_it_state(if it & 0b111 == 0 { 0 } else { it & 0xE0 | it << 1 & 0x1F });
        }
        self.regs.r[15] = self.jump.unwrap_or(pc.wrapping_add(if is_wide { 4 } else { 2 }));
        Some(self.cycles)
    }

    fn in_handler(&self) -> bool {
        self.regs.xpsr & xpsr::EXCEPTION != 0
    }

    fn get(&self, register: u8) -> u32 {
        self.regs.r[usize::from(register & 15)]
    }

    /// Sets a register other than the PC.
    fn set(&mut self, register: u8, value: u32) {
        if register != 15 {
            self.regs.r[usize::from(register & 15)] = value;
        }
    }

    fn has(&self, flag: u32) -> bool {
        self.regs.xpsr & flag != 0
    }

    fn set_flag(&mut self, flag: u32, value: bool) {
        self.regs.xpsr = self.regs.xpsr & !flag | if value { flag } else { 0 };
    }

    fn set_nz(&mut self, result: u32) {
        self.set_flag(xpsr::N, result >> 31 == 1);
        self.set_flag(xpsr::Z, result == 0);
    }

    fn set_it_state(&mut self, it: u8) {
        let it = u32::from(it);
        self.regs.xpsr = self.regs.xpsr & !xpsr::IT_MASK | (it >> 2) << 10 | (it & 0b11) << 25;
    }

    /// Jumps, if that leaves the instruction at `pc`.
    fn jump(&mut self, target: u32, pc: u32) -> Option<()> {
        (target != pc).then(|| {
            self.jump = Some(target);
            self.cycles += 2;
        })
    }

    /// Jumps to an address with its Thumb bit, if that is no exception return.
    fn interwork(&mut self, target: u32, pc: u32) -> Option<()> {
        if target & 1 == 0 || self.in_handler() && exc_return::is_magic(target) {
            return None;
        }
        self.jump(target & !1, pc)
    }

    fn load_from_memory(&mut self, address: u32, size: Size) -> Option<u32> {
        if !address.is_multiple_of(size.bytes()) {
            return None;
        }
        let (store, offset) = self.memories.readable(address, size.bytes())?;
        self.cycles += 1;
        read(store, offset, size)
    }

    fn load(&mut self, address: u32, size: Size) -> Option<u32> {
        if !self.memories.is_peripheral(address, size) {
            return self.load_from_memory(address, size);
        }
        self.cycles += 1;
        self.memories.chip.load(address, size.bytes() as usize).ok()
    }

    fn store_to_memory(&mut self, address: u32, size: Size, value: u32) -> Option<()> {
        if !address.is_multiple_of(size.bytes()) {
            return None;
        }
        let (store, offset) = self.memories.writable(address, size.bytes())?;
        self.cycles += 1;
        write(store, offset, size, value)
    }

    fn store(&mut self, address: u32, size: Size, value: u32) -> Option<()> {
        if !self.memories.is_peripheral(address, size) {
            return self.store_to_memory(address, size, value);
        }
        self.cycles += 1;
        self.has_stored = true;
        self.memories.chip.store(address, size.bytes() as usize, value).ok()
    }

    fn execute(&mut self, insn: Insn, pc: u32, may_set_flags: bool) -> Option<()> {
        match insn {
            Insn::DataProc { op, s, rd, rn, operand } => {
                self.data(op, s && may_set_flags, rd, rn, operand, pc)?;
            }
            Insn::ShiftReg { ty, s, rd, rn, rm } => {
                let (result, carry) =
                    shift(ty, self.get(rn), self.get(rm) & 0xFF, self.has(xpsr::C));
                self.set(rd, result);
                if s && may_set_flags {
                    self.set_nz(result);
                    self.set_flag(xpsr::C, carry);
                }
            }
            Insn::Adr { rd, imm, add } => self.set(rd, offset(self.get(15) & !3, imm, add)),
            Insn::MovImm16 { top: false, rd, imm } => self.set(rd, imm.into()),
            Insn::MovImm16 { top: true, rd, imm } => {
                self.set(rd, self.get(rd) & 0xFFFF | u32::from(imm) << 16);
            }
            Insn::Branch { cond, offset } => {
                if cond.is_none_or(|cond| cond.passes(self.regs.xpsr)) {
                    self.jump(self.get(15).wrapping_add(offset as u32), pc)?;
                }
            }
            Insn::BranchLink { offset } => {
                self.jump(self.get(15).wrapping_add(offset as u32), pc)?;
                self.set(14, pc.wrapping_add(4) | 1);
            }
            Insn::Bx { rm } => self.interwork(self.get(rm), pc)?,
            Insn::Blx { rm } => {
                self.interwork(self.get(rm), pc)?;
                self.set(14, pc.wrapping_add(2) | 1);
            }
            Insn::Cbz { nonzero, rn, offset } => {
                if (self.get(rn) != 0) == nonzero {
                    self.jump(self.get(15).wrapping_add(offset), pc)?;
                }
            }
            Insn::TableBranch { rn, rm, half } => {
                let (size, scale) = if half { (Size::Half, 2) } else { (Size::Byte, 1) };
                let place = self.get(rn).wrapping_add(self.get(rm).wrapping_mul(scale));
                let entry = self.load_from_memory(place, size)?;
                self.jump(self.get(15).wrapping_add(2 * entry), pc)?;
            }
            Insn::It { cond, mask } => self.set_it_state(cond.0 << 4 | mask),
            Insn::LoadStore {
                load,
                size,
                signed,
                rt,
                rn,
                offset: by,
                index,
                add,
                wback,
                unpriv: false,
            } => {
                let by = match by {
                    MemOffset::Imm(by) => by,
                    MemOffset::Reg { rm, lsl } => self.get(rm) << lsl,
                };
                let base = self.get(rn);
                let moved = offset(base, by, add);
                let address = if index { moved } else { base };
                let loaded = if !load {
                    self.store(address, size, self.get(rt))?;
                    None
                } else if rt == 15 {
                    let target = self.load_from_memory(address, size)?;
                    self.interwork(target, pc)?;
                    None
                } else {
                    Some(extended(self.load(address, size)?, size, signed))
                };
                if wback {
                    self.set(rn, moved);
                }
                if let Some(value) = loaded {
                    self.set(rt, value);
                }
            }
            Insn::LoadLiteral { size, signed, rt, imm, add } => {
                let place = offset(self.get(15) & !3, imm, add);
                let value = self.load_from_memory(place, size)?;
                let value = extended(value, size, signed);
                if rt == 15 {
                    self.interwork(value, pc)?;
                }
                self.set(rt, value);
            }
            Insn::LoadStoreDual { load, rt, rt2, rn, imm, index, add, wback } => {
                let base = if rn == 15 { self.get(15) & !3 } else { self.get(rn) };
                let moved = offset(base, imm, add);
                let address = if index { moved } else { base };
                let next = address.wrapping_add(4);
                if load {
                    let first = self.load_from_memory(address, Size::Word)?;
                    let second = self.load_from_memory(next, Size::Word)?;
                    self.set(rt, first);
                    self.set(rt2, second);
                } else {
                    self.memories.writable(address, 8)?;
                    self.store_to_memory(address, Size::Word, self.get(rt))?;
                    self.store_to_memory(next, Size::Word, self.get(rt2))?;
                }
                if wback {
                    self.set(rn, moved);
                }
            }
            Insn::LoadStoreMultiple { load, rn, list, wback, before } => {
                self.multiple(load, rn, list, wback, before, pc)?;
            }
            Insn::Mul { rd, rn, rm, ra, sub, s } => {
                let product = self.get(rn).wrapping_mul(self.get(rm));
                let result = match ra {
                    None => product,
                    Some(ra) if sub => self.get(ra).wrapping_sub(product),
                    Some(ra) => self.get(ra).wrapping_add(product),
                };
                self.set(rd, result);
                if s && may_set_flags {
                    self.set_nz(result);
                }
            }
            Insn::MulLong { signed, accumulate, rdlo, rdhi, rn, rm, umaal: false } => {
                let (a, b) = (self.get(rn), self.get(rm));
                let product = if signed {
                    (i64::from(a as i32) * i64::from(b as i32)) as u64
                } else {
                    u64::from(a) * u64::from(b)
                };
                let sum = u64::from(self.get(rdhi)) << 32 | u64::from(self.get(rdlo));
                let result = product.wrapping_add(if accumulate { sum } else { 0 });
                self.set(rdlo, result as u32);
                self.set(rdhi, (result >> 32) as u32);
                self.cycles += 1;
            }
            Insn::Div { signed, rd, rn, rm } => {
                let (a, b) = (self.get(rn), self.get(rm));
                let quotient = if signed {
                    // Checked for 0 alone: the lowest number by -1 is itself.
                    (b != 0).then(|| (a as i32).wrapping_div(b as i32) as u32)
                } else {
                    a.checked_div(b)
                };
                self.set(rd, quotient?);
                self.cycles += 2;
            }
            Insn::Extend { op, rd, rn, rm, rotate } => {
                let value = self.get(rm).rotate_right(rotate.into());
                let value = match op {
                    ExtendOp::Sxtb => value as i8 as u32,
                    ExtendOp::Sxth => value as i16 as u32,
                    ExtendOp::Uxtb => value & 0xFF,
                    ExtendOp::Uxth => value & 0xFFFF,
                    _ => return None,
                };
                let sum = if rn == 15 { 0 } else { self.get(rn) };
                self.set(rd, sum.wrapping_add(value));
            }
            Insn::Misc { op, rd, rm } => {
                let value = self.get(rm);
                let result = match op {
                    MiscOp::Clz => value.leading_zeros(),
                    MiscOp::Rbit => value.reverse_bits(),
                    MiscOp::Rev => value.swap_bytes(),
                    MiscOp::Rev16 => value.swap_bytes().rotate_right(16),
                    MiscOp::Revsh => (value as i16).swap_bytes() as u32,
                };
                self.set(rd, result);
            }
            Insn::Bitfield { op, rd, rn, lsb, width } => {
                let (lsb, unused) = (u32::from(lsb), 32_u32.checked_sub(width.into())?);
                let mask = u32::MAX.checked_shr(unused)?;
                let (old, value) = (self.get(rd), self.get(rn));
                let result = match op {
                    BitfieldOp::Ubfx => value >> lsb & mask,
                    BitfieldOp::Sbfx => ((value >> lsb << unused) as i32 >> unused) as u32,
                    BitfieldOp::Bfi => old & !(mask << lsb) | (value & mask) << lsb,
                    BitfieldOp::Bfc => old & !(mask << lsb),
                };
                self.set(rd, result);
            }
            Insn::Mrs { rd, sysm: 16 } => {
                self.set(rd, self.regs.primask.into());
            }
            Insn::Mrs { rd, sysm: 17 | 18 } => {
                self.set(rd, self.regs.basepri.into());
            }
            Insn::Msr { rn, sysm: 17, .. } => {
                self.regs.basepri = self.get(rn) as u8;
                self.has_unmasked = true;
            }
            Insn::Msr { rn, sysm: 18, .. } => {
                let (old, new) = (self.regs.basepri, self.get(rn) as u8);
                if new != 0 && (old == 0 || new < old) {
                    self.regs.basepri = new;
                }
            }
            Insn::Cps { enable, i: true, f: false } => {
                self.regs.primask = !enable;
                self.has_unmasked |= enable;
            }
            Insn::Barrier { .. } | Insn::Hint { op: HintOp::Nop } => {}
            _ => return None,
        }
        Some(())
    }

    fn data(&mut self, op: DpOp, s: bool, rd: u8, rn: u8, operand: Operand, pc: u32) -> Option<()> {
        let carry = self.has(xpsr::C);
        let (b, shifted_out) = match operand {
            Operand::Imm { value, carry: out } => (value, out.unwrap_or(carry)),
            Operand::Reg { rm, shift: Shift { ty, amount } } => {
                shift(ty, self.get(rm), amount.into(), carry)
            }
        };
        let a = self.get(rn);
        let logical = |result| (result, shifted_out, self.has(xpsr::V));
        let (result, carry, overflow) = match op {
            DpOp::And | DpOp::Tst => logical(a & b),
            DpOp::Bic => logical(a & !b),
            DpOp::Orr => logical(a | b),
            DpOp::Orn => logical(a | !b),
            DpOp::Eor | DpOp::Teq => logical(a ^ b),
            DpOp::Mov => logical(b),
            DpOp::Mvn => logical(!b),
            DpOp::Add | DpOp::Cmn => sum(a, b, false),
            DpOp::Adc => sum(a, b, carry),
            DpOp::Sub | DpOp::Cmp => sum(a, !b, true),
            DpOp::Sbc => sum(a, !b, carry),
            DpOp::Rsb => sum(!a, b, true),
        };
        if !op.is_test() {
            if rd == 15 {
                self.jump(result & !1, pc)?;
            }
            self.set(rd, result);
        }
        if s || op.is_test() {
            self.set_nz(result);
            self.set_flag(xpsr::C, carry);
            self.set_flag(xpsr::V, overflow);
        }
        Some(())
    }

    fn multiple(
        &mut self,
        load: bool,
        rn: u8,
        list: u16,
        wback: bool,
        before: bool,
        pc: u32,
    ) -> Option<()> {
        let length = 4 * list.count_ones();
        let base = self.get(rn);
        let moved = offset(base, length, !before);
        let start = if before { moved } else { base };
        if length == 0 || !start.is_multiple_of(4) {
            return None;
        }
        let registers = (0..16_u8).filter(|register| list >> register & 1 == 1);
        if load {
            let (store, place) = self.memories.readable(start, length)?;
            if list >> 15 == 1 {
                self.interwork(read(store, place + u64::from(length) - 4, Size::Word)?, pc)?;
            }
            if wback {
                self.set(rn, moved);
            }
            for (register, place) in registers.zip((place..).step_by(4)) {
                self.set(register, read(store, place, Size::Word)?);
            }
        } else {
            let (store, place) = self.memories.writable(start, length)?;
            for (register, place) in registers.zip((place..).step_by(4)) {
                write(store, place, Size::Word, self.get(register))?;
            }
            if wback {
                self.set(rn, moved);
            }
        }
        self.cycles += u64::from(length / 4);
        Some(())
    }
}

/// ITSTATE, from its two places in xPSR.
fn it_state(xpsr: u32) -> u8 {
    ((xpsr >> 10 & 0x3F) << 2 | xpsr >> 25 & 0b11) as u8
}

fn offset(base: u32, by: u32, add: bool) -> u32 {
    if add { base.wrapping_add(by) } else { base.wrapping_sub(by) }
}

fn extended(value: u32, size: Size, signed: bool) -> u32 {
    match (size, signed) {
        (Size::Byte, true) => value as i8 as u32,
        (Size::Half, true) => value as i16 as u32,
        _ => value,
    }
}

/// The sum, its carry and its overflow.
fn sum(a: u32, b: u32, carry: bool) -> (u32, bool, bool) {
    let (partial, first) = a.overflowing_add(b);
    let (result, second) = partial.overflowing_add(carry.into());
    (result, first | second, ((a ^ result) & (b ^ result)) >> 31 == 1)
}

/// The shifted value and its carry (ARM DDI 0403, A2.2.1).
fn shift(ty: ShiftType, value: u32, amount: u32, carry: bool) -> (u32, bool) {
    if amount == 0 {
        return (value, carry);
    }
    match ty {
        ShiftType::Lsl => {
            let wide = u64::from(value).checked_shl(amount).unwrap_or(0);
            (wide as u32, wide >> 32 & 1 == 1)
        }
        ShiftType::Lsr => {
            let wide = (u64::from(value) << 32).checked_shr(amount).unwrap_or(0);
            ((wide >> 32) as u32, wide >> 31 & 1 == 1)
        }
        ShiftType::Asr => {
            let wide = (i64::from(value as i32) << 32) >> amount.min(63);
            ((wide >> 32) as u32, wide >> 31 & 1 == 1)
        }
        ShiftType::Ror => {
            let result = value.rotate_right(amount % 32);
            (result, result >> 31 == 1)
        }
        ShiftType::Rrx => (u32::from(carry) << 31 | value >> 1, value & 1 == 1),
    }
}

#[cfg(test)]
mod tests;
