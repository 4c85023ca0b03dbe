//! A program of less than 4 KB for boards with a loader: boot-up, 100Ah, 1F51h, 1F56h, 2001h, and nothing else. It is written
//! without the libraries, for node 5 on CAN1 of an STM32F407 at 1 Mbit/s, and stands in place of a product's main.rs.

#![no_std]
#![no_main]

use core::{panic::PanicInfo, ptr};

use stm32f4xx_hal as _;

const NODE: u32 = 5;
/// Tests put another one in its place.
static VERSION: [u8; 5] = *b"0.1.0";

/// The header of this program, and the words TRY and KEPT of the journal.
const HEADER_CRC: usize = 0x0801_0000 + 12;
const TRY: [usize; 3] = [0x0804_01CC, 0x0804_01D0, 0x0804_01D4];
const KEPT: [usize; 2] = [0x0804_01D8, 0x0804_01DC];
const SET: u32 = 0x5AA5_3CC3;

const GPIOB: usize = 0x4002_0400;
const RCC: usize = 0x4002_3800;
const FLASH: usize = 0x4002_3C00;
const CAN: usize = 0x4000_6400;
const IWDG: usize = 0x4000_3000;
const AIRCR: usize = 0xE000_ED0C;

unsafe extern "C" {
    /// The mailbox follows the stack.
    static _stack_start: [u32; 8];
}

fn read(address: usize) -> u32 {
    // SAFETY: a register, or a word of the flash.
    unsafe { (address as *const u32).read_volatile() }
}

fn write(address: usize, value: u32) {
    // SAFETY: a register, or a word of the flash that is unlocked.
    unsafe { (address as *mut u32).write_volatile(value) }
}

fn set(address: usize, clear: u32, set: u32) {
    write(address, read(address) & !clear | set);
}

#[panic_handler]
fn panic(_: &PanicInfo) -> ! {
    write(AIRCR, 0x05FA_0004);
    loop {}
}

/// Joins the bus at 1 Mbit/s, from the oscillator of 16 MHz.
fn join() {
    set(RCC + 0x30, 0, 1 << 1); // the clocks of GPIOB and CAN1
    set(RCC + 0x40, 0, 1 << 25);
    set(GPIOB, 0xF << 16, 0xA << 16); // PB8 and PB9: alternate function 9
    set(GPIOB + 0x24, 0xFF, 0x99);
    write(CAN, 1); // INRQ
    while read(CAN + 4) & 1 == 0 {}
    write(CAN + 0x1C, 12 << 16 | 1 << 20);
    write(CAN + 0x20C, 1); // a filter that takes all
    write(CAN + 0x240, 0);
    write(CAN + 0x244, 0);
    write(CAN + 0x21C, 1);
    set(CAN + 0x200, 1, 0);
    write(CAN, 0);
    while read(CAN + 4) & 1 == 1 {}
}

fn send(id: u32, length: u32, data: [u32; 2]) {
    while read(CAN + 8) & 1 << 26 == 0 {
        write(IWDG, 0xAAAA);
    }
    write(CAN + 0x184, length);
    write(CAN + 0x188, data[0]);
    write(CAN + 0x18C, data[1]);
    write(CAN + 0x180, id << 21 | 1);
}

/// Leaves the loader what is in force, and that it owes an answer.
fn stop() -> ! {
    let mut words = [u32::from_le_bytes(*b"MAIL"), NODE << 24 | 1, 1000 << 16, 0, 0, 0, 0, 0];
    let mut crc = u32::MAX;
    for word in &words[..7] {
        crc ^= word;
        for _ in 0..32 {
            crc = crc >> 1 ^ if crc & 1 == 1 { 0xEDB8_8320 } else { 0 };
        }
    }
    words[7] = !crc;
    // SAFETY: nothing else has this RAM.
    unsafe { (&raw const _stack_start).cast_mut().write_volatile(words) };
    write(AIRCR, 0x05FA_0004);
    loop {}
}

fn confirm() {
    for word in KEPT {
        write(FLASH + 4, 0x4567_0123);
        write(FLASH + 4, 0xCDEF_89AB);
        write(FLASH + 0x10, 1 | 2 << 8);
        write(word, SET);
        while read(FLASH + 0xC) & 1 << 16 != 0 {}
        write(FLASH + 0x10, 1 << 31);
    }
}

/// The number of words that are set.
fn count(words: &[usize]) -> u32 {
    words.iter().map(|word| u32::from(read(*word) == SET)).sum()
}

/// The answer to an SDO request.
fn answer([request, data]: [u32; 2]) -> [u32; 2] {
    // SAFETY: the compiler is not to know its content.
    let [a, b, c, d, e] = unsafe { ptr::read_volatile(&raw const VERSION) };
    let object = request & 0xFFFF_FF00;
    match request {
        // 100Ah in a segment.
        0x0010_0A40 => [object | 0x41, 5],
        0x60 => [u32::from_le_bytes([5, a, b, c]), u32::from_le_bytes([d, e, 0, 0])],
        0x011F_5140 => [object | 0x4F, 1],
        0x011F_5640 => [object | 0x43, read(HEADER_CRC)],
        0x0120_0140 => [object | 0x4F, 2 + count(&KEPT).min(1)],
        0x0220_0140 => [object | 0x4F, count(&TRY)],
        0x011F_512F if data == 0 => stop(),
        0x011F_512F => {
            if data == 0x80 {
                confirm();
            }
            [object | 0x60, 0]
        }
        _ => [object | 0x80, 0x0602_0000],
    }
}

#[unsafe(no_mangle)]
extern "C" fn main() -> ! {
    join();
    send(0x700 + NODE, 1, [0, 0]);
    loop {
        write(IWDG, 0xAAAA);
        if read(CAN + 0xC) & 3 == 0 {
            continue;
        }
        let id = read(CAN + 0x1B0) >> 21;
        let data = [read(CAN + 0x1B8), read(CAN + 0x1BC)];
        write(CAN + 0xC, 1 << 5);
        if id == 0x600 + NODE {
            send(0x580 + NODE, 8, answer(data));
        }
    }
}
