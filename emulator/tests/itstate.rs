//! An interrupted IT block continues correctly (ARM DDI 0403, B1.5.6: ITSTATE is stacked in the xPSR).

use std::collections::BTreeSet;

use emulator::{
    Time,
    board::{Board, Settings},
    chip::Part,
    image::Image,
};

const FLASH: u32 = 0x0800_0000;
/// The code's address, behind the vectors of the system exceptions.
const CODE: u32 = FLASH + 4 * 16;
/// The place where the program stores the PC that SysTick interrupted, r5 and r6.
const RESULT: u32 = 0x2000_0100;
const SYSTICK: usize = 15;
const SYST_CSR: u32 = 0xE000_E010;

/// Number of conditional instructions.
const BLOCK: u32 = 4;

struct Program {
    image: Image,
    /// Address of the first conditional instruction.
    block: u32,
}

/// MOVW and MOVT.
fn set(register: u16, value: u32) -> [u16; 4] {
    let half = |opcode: u16, half: u16| {
        let first = opcode | half >> 12 | (half >> 11 & 1) << 10;
        [first, (half >> 8 & 7) << 12 | register << 8 | half & 0xFF]
    };
    let ([a, b], [c, d]) = (half(0xF240, value as u16), half(0xF2C0, (value >> 16) as u16));
    [a, b, c, d]
}

/// Interrupts itself once, `reload` + 1 cycles after SysTick was switched on. The block counts in r5 if `is_equal`,
/// otherwise in r6.
fn program(reload: u32, is_equal: bool) -> Program {
    let mut code: Vec<u16> = Vec::new();
    code.extend(set(4, RESULT));
    code.extend(set(7, SYST_CSR));
    code.extend(set(0, reload));
    // MOVS r5, #0; MOVS r6, #0; MOVS r1, #7
    code.extend([0x2500, 0x2600, 0x2107]);
    // STR r0, [r7, #4]; STR r5, [r7, #8]; STR r1, [r7]; CMP r5, #0 or #1
    code.extend([0x6078, 0x60BD, 0x6039, 0x2D00 | u16::from(!is_equal)]);
    // ITETE EQ
    code.push(0xBF0B);
    let block = CODE + 2 * code.len() as u32;
    // ADDEQ r5, #1; ADDNE r6, #1; ADDEQ r5, #1; ADDNE r6, #1
    code.extend([0x3501, 0x3601, 0x3501, 0x3601]);
    // STR r5, [r4, #4]; STR r6, [r4, #8]; B to itself
    code.extend([0x6065, 0x60A6, 0xE7FE]);
    let handler = CODE + 2 * code.len() as u32;
    // LDR r2, [sp, #24]; STR r2, [r4]; MOVS r2, #0; STR r2, [r7]; BX lr
    code.extend([0x9A06, 0x6022, 0x2200, 0x603A, 0x4770]);

    let mut vectors = [0; 16];
    vectors[0] = 0x2001_0000;
    vectors[1] = CODE + 1;
    vectors[SYSTICK] = handler + 1;
    let mut bytes: Vec<u8> = vectors.iter().flat_map(|word: &u32| word.to_le_bytes()).collect();
    bytes.extend(code.iter().flat_map(|half| half.to_le_bytes()));
    Program { image: Image::from_segments(vec![(FLASH, bytes)]), block }
}

/// The interrupted PC, r5 and r6.
fn run(program: &Program) -> [u32; 3] {
    let mut board = Board::new(Part::Stm32f405, &program.image, Settings::default());
    board.run_until(Time::from_ms(2));
    assert_eq!(board.findings(), []);
    [0, 4, 8].map(|offset| {
        let mut bytes = [0; 4];
        assert!(board.read_memory(RESULT + offset, &mut bytes));
        u32::from_le_bytes(bytes)
    })
}

fn interrupt_everywhere(is_equal: bool, expected: [u32; 2]) {
    let mut interrupted = BTreeSet::new();
    for reload in 1..40 {
        let program = program(reload, is_equal);
        let [pc, r5, r6] = run(&program);
        assert_eq!([r5, r6], expected, "reload {reload}, interrupted at {pc:#x}");
        interrupted.insert(pc.wrapping_sub(program.block));
    }
    let block: BTreeSet<u32> = (0..BLOCK).map(|number| 2 * number).collect();
    assert!(block.is_subset(&interrupted), "interrupted at {interrupted:?}");
}

#[test]
fn a_taken_block_is_finished_after_an_interrupt_at_any_instruction() {
    interrupt_everywhere(true, [2, 0]);
}

#[test]
fn a_skipped_block_is_finished_after_an_interrupt_at_any_instruction() {
    interrupt_everywhere(false, [0, 2]);
}
