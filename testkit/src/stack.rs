//! How deep the stack of the release image gets: it is painted before the program starts, and looked at later.

use std::ops::Range;

use emulator::{board::Board, image::Image};

/// What is on a stack that was never used.
const PAINT: u8 = 0xA5;

/// The addresses of the stack.
pub fn stack(image: &Image) -> Range<u32> {
    let symbol = |name| image.symbol(name).unwrap_or_else(|| panic!("no {name} in the image"));
    symbol("_stack_end")..symbol("_stack_start")
}

/// Paints what the program does not use of the stack at this moment.
pub fn paint(board: &mut Board, image: &Image) {
    let mut stack = stack(image);
    // Before the program has started there is no stack pointer.
    if stack.contains(&board.sp()) {
        stack.end = board.sp();
    }
    assert!(board.write_memory(stack.start, &vec![PAINT; stack.len()]), "the stack is in RAM");
}

/// Bytes of the stack that were used since it was painted.
pub fn deepest(board: &Board, image: &Image) -> usize {
    let stack = stack(image);
    let mut bytes = vec![0; stack.len()];
    assert!(board.read_memory(stack.start, &mut bytes), "the stack is in RAM");
    bytes.iter().skip_while(|&&byte| byte == PAINT).count()
}
