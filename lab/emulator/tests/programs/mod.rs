//! A small assembler for Thumb-2 (ARM DDI 0403, A7.7), sufficient to write registers, sleep and count.

use emulator::image::Image;

/// A low register.
#[derive(Clone, Copy)]
pub struct Register(u16);

pub const R0: Register = Register(0);
pub const R1: Register = Register(1);
pub const R2: Register = Register(2);
pub const R3: Register = Register(3);
pub const R4: Register = Register(4);
/// Holds addresses.
pub const R7: Register = Register(7);
/// Holds values to be stored.
const R6: Register = Register(6);

pub const RCC_CR: u32 = 0x4002_3800;
pub const RCC_CFGR: u32 = 0x4002_3808;
pub const RCC_AHB1ENR: u32 = 0x4002_3830;
pub const RCC_APB1ENR: u32 = 0x4002_3840;

const FLASH: u32 = 0x0800_0000;
const RAM: u32 = 0x2000_0000;
/// The address at which a copy in RAM runs.
const RAM_CODE: u32 = RAM + 0x1000;
const VECTORS: usize = 128;

/// Instructions behind a vector table of 128 entries at the start of the flash.
pub struct Program {
    vectors: [u32; VECTORS],
    code: Vec<u16>,
}

impl Program {
    /// A program that starts with the next instruction, with its stack at the end of the first 32 KB of RAM.
    pub fn new() -> Self {
        let mut vectors = [0; VECTORS];
        vectors[0] = RAM + 0x8000;
        vectors[1] = FLASH + 4 * VECTORS as u32 + 1;
        Self { vectors, code: Vec::new() }
    }

    /// Address of the next instruction.
    pub fn here(&self) -> u32 {
        FLASH + 4 * VECTORS as u32 + 2 * self.code.len() as u32
    }

    /// Makes the next instruction the handler of exception number `exception`.
    pub fn handler(&mut self, exception: usize) -> &mut Self {
        self.vectors[exception] = self.here() + 1;
        self
    }

    /// Appends instructions.
    pub fn emit(&mut self, instructions: &[u16]) -> &mut Self {
        self.code.extend(instructions);
        self
    }

    /// MOVW and MOVT.
    pub fn set(&mut self, register: Register, value: u32) -> &mut Self {
        for (opcode, half) in [(0xF240, value as u16), (0xF2C0, (value >> 16) as u16)] {
            let first = opcode | half >> 12 | (half >> 11 & 1) << 10;
            let second = (half >> 8 & 7) << 12 | register.0 << 8 | half & 0xFF;
            self.emit(&[first, second]);
        }
        self
    }

    /// Stores a word.
    pub fn store(&mut self, address: u32, value: u32) -> &mut Self {
        self.set(R6, value).store_register(address, R6)
    }

    /// Stores a register.
    pub fn store_register(&mut self, address: u32, register: Register) -> &mut Self {
        self.set(R7, address).emit(&[0x6000 | R7.0 << 3 | register.0])
    }

    /// Loads a word.
    pub fn load(&mut self, register: Register, address: u32) -> &mut Self {
        self.set(R7, address).emit(&[0x6800 | R7.0 << 3 | register.0])
    }

    /// Adds 0..=255.
    pub fn add(&mut self, register: Register, value: u8) -> &mut Self {
        self.emit(&[0x3000 | register.0 << 8 | u16::from(value)])
    }

    /// Waits until a word has all bits of `mask`, which has one bit.
    pub fn wait_for_ones(&mut self, address: u32, mask: u32) -> &mut Self {
        // loop: LDR r0, [r7]; TST r0, r6; BEQ loop
        self.set(R7, address).set(R6, mask).emit(&[0x6838, 0x4230, 0xD0FC])
    }

    /// Executes WFI repeatedly.
    pub fn sleep_forever(&mut self) -> &mut Self {
        self.emit(&[0xBF30, 0xE7FD])
    }

    /// Branches to itself.
    pub fn stop(&mut self) -> &mut Self {
        self.emit(&[0xE7FE])
    }

    /// BKPT.
    pub fn breakpoint(&mut self) -> &mut Self {
        self.emit(&[0xBE00])
    }

    /// UDF.
    pub fn undefined(&mut self) -> &mut Self {
        self.emit(&[0xDE00])
    }

    /// Returns from a handler.
    pub fn back(&mut self) -> &mut Self {
        self.emit(&[0x4770])
    }

    /// The same program behind a start that copies it to RAM and continues there. The vector table stays in the flash.
    pub fn in_ram(self) -> Self {
        const START_HALFWORDS: u32 = 22;
        let mut program = Self::new();
        let code = program.here();
        for (vector, handler) in program.vectors.iter_mut().zip(self.vectors).skip(2) {
            *vector = handler.checked_sub(code).map_or(0, |offset| RAM_CODE + offset);
        }
        let from = program.here() + 2 * START_HALFWORDS;
        let words = self.code.len().div_ceil(2) as u32;
        program.set(R0, from).set(R1, RAM_CODE).set(R2, RAM_CODE + 4 * words);
        // loop: LDMIA r0!, {r3}; STMIA r1!, {r3}; CMP r1, r2; BNE loop
        program.emit(&[0xC808, 0xC108, 0x4291, 0xD1FB]);
        // BX r3
        program.set(R3, RAM_CODE + 1).emit(&[0x4718]);
        let pad = (from - program.here()) / 2;
        program.emit(&vec![0xBF00; pad as usize]).emit(&self.code);
        program
    }

    /// The content for the flash.
    pub fn image(&self) -> Image {
        let mut bytes: Vec<u8> = self.vectors.iter().flat_map(|word| word.to_le_bytes()).collect();
        bytes.extend(self.code.iter().flat_map(|half| half.to_le_bytes()));
        Image::from_segments(vec![(FLASH, bytes)])
    }
}
