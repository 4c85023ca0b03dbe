//! An interrupted IT block continues correctly (ARM DDI 0403, B1.5.6: ITSTATE is stacked in the xPSR).

#[expect(dead_code, reason = "this program needs only a part of the assembler")]
mod programs;

use std::collections::BTreeSet;

use emulator::{
    Time,
    board::{Board, Settings},
    chip::Part,
    image::Image,
};
use programs::{Program, R0, R4, R7};

/// The place where the program stores the PC that SysTick interrupted, r5 and r6.
const RESULT: u32 = 0x2000_0100;
const SYSTICK: usize = 15;
const SYST_CSR: u32 = 0xE000_E010;

/// Number of conditional instructions.
const BLOCK: u32 = 4;

/// A program and the address of its first conditional instruction. It interrupts itself once, `reload` + 1 cycles after
/// SysTick was switched on. The block counts in r5 if `is_equal`, otherwise in r6.
fn program(reload: u32, is_equal: bool) -> (Image, u32) {
    let mut program = Program::new();
    program.set(R4, RESULT).set(R7, SYST_CSR).set(R0, reload);
    // MOVS r5, #0; MOVS r6, #0; MOVS r1, #7
    program.emit(&[0x2500, 0x2600, 0x2107]);
    // STR r0, [r7, #4]; STR r5, [r7, #8]; STR r1, [r7]; CMP r5, #0 or #1; ITETE EQ
    program.emit(&[0x6078, 0x60BD, 0x6039, 0x2D00 | u16::from(!is_equal), 0xBF0B]);
    let block = program.here();
    // ADDEQ r5, #1; ADDNE r6, #1; ADDEQ r5, #1; ADDNE r6, #1
    program.emit(&[0x3501, 0x3601, 0x3501, 0x3601]);
    // STR r5, [r4, #4]; STR r6, [r4, #8]
    program.emit(&[0x6065, 0x60A6]).stop();
    // LDR r2, [sp, #24]; STR r2, [r4]; MOVS r2, #0; STR r2, [r7]
    program.handler(SYSTICK).emit(&[0x9A06, 0x6022, 0x2200, 0x603A]).back();
    (program.image(), block)
}

/// The interrupted PC, r5 and r6.
fn run(image: &Image) -> [u32; 3] {
    let mut board = Board::new(Part::Stm32f405, image, Settings::default());
    board.run_until(Time::from_ms(2));
    assert_eq!(board.findings(), []);
    [0, 4, 8].map(|offset| {
        let mut bytes = [0; 4];
        assert!(board.read_memory(RESULT + offset, &mut bytes));
        u32::from_le_bytes(bytes)
    })
}

#[test]
fn a_block_is_finished_after_an_interrupt_at_any_instruction() {
    for (is_equal, expected) in [(true, [2, 0]), (false, [0, 2])] {
        let mut interrupted = BTreeSet::new();
        for reload in 1..40 {
            let (image, block) = program(reload, is_equal);
            let [pc, r5, r6] = run(&image);
            assert_eq!([r5, r6], expected, "reload {reload}, interrupted at {pc:#x}");
            interrupted.insert(pc.wrapping_sub(block));
        }
        let block: BTreeSet<u32> = (0..BLOCK).map(|number| 2 * number).collect();
        assert!(block.is_subset(&interrupted), "interrupted at {interrupted:?}");
    }
}
