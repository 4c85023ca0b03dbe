//! The common instructions compared with rsemu's, one by one and at random.

use std::{
    collections::HashMap,
    mem::discriminant,
    sync::{Arc, Mutex},
};

use rsemu::cpu::arm::v7m::{ArmV7m, Config};

use super::{
    super::bus::{Link, Space},
    *,
};
use crate::{
    Time,
    can::Clock,
    chip::{Access, Chip, ChipVariant, Part, Width},
    engine::clock::CycleClock,
};

const FLASH_LENGTH: u32 = 0x1_0000;
const RAM_LENGTH: u32 = 0x100;
const GPIO: u32 = 0x4002_0000;

/// Memories and a chip, and an address space with them.
struct Machine {
    flash: Arc<RamStore>,
    ram: Arc<RamStore>,
    ccm: Arc<RamStore>,
    space: Space,
}

impl Machine {
    /// Their content is that of each other machine with the same seed.
    fn new(seed: u64) -> Self {
        const RCC_AHB1ENR: u32 = 0x4002_3830;
        let mut random = Random(seed);
        let crystal = Clock { hz: 8_000_000, ppm: 0 };
        let mut chip =
            Chip::with_variant(Part::Stm32f405, crystal, [0; 12], ChipVariant::default());
        let access =
            Access { address: RCC_AHB1ENR, width: Width::Word, now: Time::ZERO, pc: FLASH_BASE };
        chip.write(access, 0x1FF).expect("a register");
        let chip = Arc::new(Mutex::new(chip));
        let link = Arc::new(Link::new(CycleClock::new(crystal, 0, Time::ZERO)));
        let mut store = |length: u32| {
            let store = Arc::new(ram(length));
            let words = (0..length / 4).flat_map(|_| random.instruction());
            let bytes: Vec<u8> = words.flat_map(u16::to_le_bytes).collect();
            store.write_at(0, &bytes).expect("it has this length");
            store
        };
        let (flash, ram, ccm) = (store(FLASH_LENGTH), store(RAM_LENGTH), store(RAM_LENGTH));
        let space =
            Space::new(&chip, &link, [&flash, &ram, &ccm], Part::Stm32f405, ChipVariant::default());
        Self { flash, ram, ccm, space }
    }

    fn memories(&self) -> Memories<'_> {
        Memories {
            flash: &self.flash,
            ram: &self.ram,
            ccm: &self.ccm,
            chip: &self.space.chip,
            guarded: 0..0,
            double_errors: &[],
            is_flash_busy: false,
        }
    }

    /// The content of the writable memories and the first registers of GPIOA.
    fn content(&self) -> Vec<u8> {
        let mut content = vec![0; 2 * RAM_LENGTH as usize];
        let (ram, ccm) = content.split_at_mut(RAM_LENGTH as usize);
        self.ram.read_at(0, ram).expect("it has this length");
        self.ccm.read_at(0, ccm).expect("it has this length");
        for register in (0..0x18).step_by(4) {
            let value = self.space.chip.load(GPIO + register, 4).expect("a register");
            content.extend(value.to_le_bytes());
        }
        content
    }
}

struct Random(u64);

impl Random {
    fn next(&mut self) -> u32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 16) as u32
    }

    fn below(&mut self, end: u32) -> u32 {
        self.next() % end
    }

    /// Two halfwords: anything, anything that is 32 bits long, or an encoding that chance seldom makes.
    fn instruction(&mut self) -> [u16; 2] {
        /// Each with the bits that may be anything: its registers and amounts.
        const RARE: [[(u16, u16); 2]; 9] = [
            // MRS of PRIMASK and BASEPRI, MSR to BASEPRI and BASEPRI_MAX.
            [(0xF3EF, 0), (0x8010, 0xF01)],
            [(0xF380, 0xF), (0x8811, 0)],
            [(0xF380, 0xF), (0x8812, 0)],
            // DSB, DMB or ISB, and CPS.
            [(0xF3BF, 0), (0x8F4F, 0x30)],
            [(0xB662, 0x11), (0xBF00, 0)],
            // TBB or TBH, division, multiplication to 64 bits, and the other operations of one register.
            [(0xE8D0, 0xF), (0xF000, 0x1F)],
            [(0xFB90, 0x2F), (0xF0F0, 0xF0F)],
            [(0xFB80, 0x6F), (0x0000, 0xFF0F)],
            [(0xFA90, 0x2F), (0xF080, 0xF3F)],
        ];
        let halves = [self.next() as u16, self.next() as u16];
        match self.below(4) {
            0 => halves,
            1 | 2 => [halves[0] | 0xE800, halves[1]],
            _ => {
                let rare = RARE[self.below(RARE.len() as u32) as usize];
                std::array::from_fn(|at| rare[at].0 | halves[at] & rare[at].1)
            }
        }
    }

    /// The content of a register: any number, or one that makes sense as an address or an amount.
    fn word(&mut self) -> u32 {
        match self.below(8) {
            0 => self.next(),
            1 => self.below(64),
            2 => FLASH_BASE + self.below(FLASH_LENGTH),
            3 => CCM_BASE + self.below(RAM_LENGTH + 8),
            4 => GPIO + 4 * self.below(6),
            5 => [0, 1, u32::MAX, 1 << 31, i32::MAX as u32][self.below(5) as usize],
            _ => RAM_BASE + 4 * self.below(RAM_LENGTH / 4 + 2),
        }
    }

    fn regs(&mut self) -> Regs {
        let mut regs = Regs::new();
        regs.r = std::array::from_fn(|_| self.word());
        regs.r[15] = FLASH_BASE + 2 * self.below(FLASH_LENGTH / 2 - 2);
        regs.xpsr = self.next() & xpsr::FLAGS | xpsr::T;
        if self.below(4) == 0 {
            regs.xpsr |= self.next() & xpsr::IT_MASK;
        }
        if self.below(4) == 0 {
            regs.xpsr |= 16 + self.below(80);
        }
        regs.control = control::SPSEL * self.below(2);
        regs.basepri = self.below(3) as u8 * 0x50;
        regs.primask = self.below(2) == 0;
        (regs.msp, regs.psp) = (regs.r[13] & !3, self.word() & !3);
        regs
    }
}

#[test]
fn a_common_instruction_does_what_rsemu_does_and_takes_as_long() {
    const SEED: u64 = 0x5EED_0305;
    let (fast, slow) = (Machine::new(SEED), Machine::new(SEED));
    let cpu = ArmV7m::new(Config::CORTEX_M4F.with_priority_bits(4));
    cpu.attach_space(slow.space.shared());
    // The load of the first stack pointer and program counter.
    cpu.step();
    let mut random = Random(SEED);
    let mut decoded = Decoded::new();
    let mut executed: HashMap<_, u32> = HashMap::new();
    for trial in 0..400_000 {
        // As rsemu holds them: the stack pointer in use is one of the two.
        cpu.set_regs(random.regs());
        let before = cpu.regs();
        let word = |at: u32| fast.memories().code(before.r[15] + at).expect("it is in the flash");
        let insn = decode(word(0), word(2));
        let mut core = Fast::new(before, fast.memories(), &mut decoded);
        let cycles = core.step();
        let after = core.into_regs();
        if cycles.is_some() {
            let is_unconditional = before.xpsr & xpsr::IT_MASK == 0;
            *executed.entry(discriminant(&insn)).or_default() += u32::from(is_unconditional);
            assert_eq!(cycles, Some(cpu.step()), "trial {trial}: cycles of {insn:?}, {before}");
        }
        assert_eq!(after, cpu.regs(), "trial {trial}: {insn:?}, {before}");
        if trial % 16 == 0 {
            assert_eq!(fast.content(), slow.content(), "before trial {trial}");
        }
    }
    let tried = executed.values().filter(|times| **times >= 20).count();
    assert!(tried >= 26, "{tried} kinds of instructions: {executed:?}");
}

#[test]
fn a_guarded_address_is_left_to_rsemu() {
    let machine = Machine::new(1);
    // LDR R0, [R1]
    machine.flash.write_at(0, &0x6808_u16.to_le_bytes()).expect("it is in the flash");
    let mut regs = Regs::new();
    regs.r[15] = FLASH_BASE;
    for (address, is_executed) in [(-4_i32, true), (0, false), (28, false), (32, true)] {
        regs.r[1] = (RAM_BASE + 64).wrapping_add_signed(address);
        let memories = Memories { guarded: RAM_BASE + 64..RAM_BASE + 96, ..machine.memories() };
        let mut decoded = Decoded::new();
        let mut core = Fast::new(regs, memories, &mut decoded);
        assert_eq!(core.step().is_some(), is_executed, "{address}");
    }
}

#[test]
fn a_changed_instruction_is_decoded_again() {
    let machine = Machine::new(1);
    let mut decoded = Decoded::new();
    let mut regs = Regs::new();
    // The second halfword changes; in the RAM it is in the next line.
    let places = [(&machine.flash, FLASH_BASE, 2), (&machine.ram, RAM_BASE, 62)];
    for (memory, base, offset) in places {
        regs.r[15] = base + offset;
        let write = |offset: u32, half: u16| {
            memory.write_at(offset.into(), &half.to_le_bytes()).expect("it is in the memory");
        };
        // MOVW R0, #1 and the same with R1.
        write(offset, 0xF240);
        for (second, expected) in [(0x0001, [1, 0]), (0x0101, [0, 1])] {
            write(offset + 2, second);
            if base == FLASH_BASE {
                decoded.forget(base + offset + 2..base + offset + 4);
            }
            let mut core = Fast::new(regs, machine.memories(), &mut decoded);
            assert_eq!(core.step(), Some(1));
            assert_eq!(core.regs.r[..2], expected);
        }
    }
}
