//! Copying and clearing memory in a few bytes of flash. The compiler's own, 1.1 KB, are made for speed, which nothing here
//! needs: what is copied is a log line, or the node once at the start.

use core::arch::global_asm;

// The names that the ABI gives them (RTABI 32, 4.3.4); r0 is the destination, to be kept for `memcpy`.
global_asm!(
    ".section .text.memory, \"ax\"",
    ".thumb",
    ".macro function name", // another name of what follows
    ".global \\name",
    ".type \\name, %function",
    ".thumb_func",
    "\\name:",
    ".endm",
    "function memcpy",
    "function __aeabi_memcpy",
    "function __aeabi_memcpy4",
    "function __aeabi_memcpy8",
    "0: subs r2, #1", // r1: the source, r2: the length
    "itt pl",
    "ldrbpl r3, [r1, r2]",
    "strbpl r3, [r0, r2]",
    "bpl 0b",
    "bx lr",
    "function __aeabi_memclr",
    "function __aeabi_memclr4",
    "function __aeabi_memclr8",
    "movs r2, #0",
    "0: subs r1, #1", // r1: the length
    "it pl",
    "strbpl r2, [r0, r1]",
    "bpl 0b",
    "bx lr",
    ".purgem function",
);
