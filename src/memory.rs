//! Copying and clearing memory in a few bytes of flash. The compiler's own functions take 1.1 KB for a speed that is
//! not needed here: they copy log lines, settings records and, once at the start, the node.

use core::arch::global_asm;

// The names that the ABI prescribes (RTABI 32, 4.3.4); r0 is the destination, which `memcpy` must preserve.
global_asm!(
    ".section .text.memory, \"ax\"",
    ".thumb",
    ".macro function name", // another name for the code that follows
    ".global \\name",
    ".type \\name, %function",
    ".thumb_func",
    "\\name:",
    ".endm",
    "function memcpy",
    "function __aeabi_memcpy",
    "function __aeabi_memcpy4",
    "function __aeabi_memcpy8",
    "subs r2, #4", // r1: the source, r2: the length
    "0: ittt pl",  // words from the end, aligned or not
    "ldrpl r3, [r1, r2]",
    "strpl r3, [r0, r2]",
    "subspl r2, #4",
    "bpl 0b",
    "adds r2, #3", // the rest at the start
    "1: ittt pl",
    "ldrbpl r3, [r1, r2]",
    "strbpl r3, [r0, r2]",
    "subspl r2, #1",
    "bpl 1b",
    "bx lr",
    "function __aeabi_memclr",
    "function __aeabi_memclr4",
    "function __aeabi_memclr8",
    "movs r2, #0",
    "subs r1, #4", // r1: the length
    "0: itt pl",
    "strpl r2, [r0, r1]",
    "subspl r1, #4",
    "bpl 0b",
    "adds r1, #3",
    "1: itt pl",
    "strbpl r2, [r0, r1]",
    "subspl r1, #1",
    "bpl 1b",
    "bx lr",
    ".purgem function",
);
