//! The stack depth of the release image: the stack is painted before the program starts, and inspected later.

use std::ops::Range;

use emulator::{board::Board, image::Image};

/// The content of unused stack.
const PAINT: u8 = 0xA5;

/// The address range of the stack.
pub fn stack(image: &Image) -> Range<u32> {
    let symbol = |name| image.symbol(name).unwrap_or_else(|| panic!("no {name} in the image"));
    symbol("_stack_end")..symbol("_stack_start")
}

/// Paints the part of the stack that the program does not use now.
pub fn paint(board: &mut Board, image: &Image) {
    let mut stack = stack(image);
    // There is no stack pointer before the program has started.
    if stack.contains(&board.sp()) {
        stack.end = board.sp();
    }
    assert!(board.write_memory(stack.start, &vec![PAINT; stack.len()]), "the stack is in RAM");
}

/// The number of stack bytes used since the painting.
pub fn deepest(board: &Board, image: &Image) -> usize {
    let stack = stack(image);
    let mut bytes = vec![0; stack.len()];
    assert!(board.read_memory(stack.start, &mut bytes), "the stack is in RAM");
    bytes.iter().skip_while(|&&byte| byte == PAINT).count()
}
