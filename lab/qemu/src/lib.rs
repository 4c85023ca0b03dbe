//! A plugin for `qemu-system-arm -M netduinoplus2`: the emulated chip, on a CAN bus, around QEMU's CPU.
//!
//! QEMU provides the Cortex-M4F with NVIC, SysTick, RAM and flash; the [`emulator`]'s models replace all other
//! peripherals, and the flash sectors that hold the firmware's settings. An adapter on the bus, at 125 kbit/s, sends the
//! frames given as arguments, prints those that it receives, and ends QEMU. An argument is `send=7E5#0401`: identifier
//! and data.
//!
//! Works with QEMU 7.2 to 10.0 if it exports its symbols, as Debian's build does; the dynamic linker names a missing
//! one.
#![cfg(target_os = "linux")]

mod board;
mod sys;

use std::{
    ffi::{CStr, c_char, c_int, c_uint, c_void},
    sync::{
        Mutex, MutexGuard, OnceLock,
        atomic::{AtomicI32, Ordering::Relaxed},
    },
};

use emulator::{
    can::{Frame, Id},
    chip::{BusFault, FLASH_BASE, Width},
};

use board::Board;
use sys::{MEMTX_ERROR, MEMTX_OK, Machine, MemoryRegionOps};

/// The supported version of the plugin interface: any, as only the entry is used. QEMU reads it after it has loaded the
/// plugin.
// SAFETY: a plugin has to have a word of this name.
#[unsafe(no_mangle)]
pub static qemu_plugin_version: AtomicI32 = AtomicI32::new(1);

/// Runs while the plugin is loaded: from version 9.0 on QEMU requires at least 2, and before it at most 1.
#[used]
// SAFETY: the section holds pointers to functions that the loader calls.
#[unsafe(link_section = ".init_array")]
static CHOOSE_VERSION: extern "C" fn() = choose_version;

extern "C" fn choose_version() {
    if sys::exports(c"qemu_plugin_scoreboard_new") {
        qemu_plugin_version.store(2, Relaxed);
    }
}

/// The name, start and length in bytes of each range of addresses. Sectors 1 and 2 of the flash are never executed; the
/// rest of it is QEMU's.
const RANGES: [(&CStr, u32, u64); 4] = [
    (c"settings", FLASH_BASE + 0x4000, 0x8000),
    (c"system memory", 0x1FFF_0000, 0xC000),
    (c"apb and ahb1", 0x4000_0000, 0x8_0000),
    (c"ahb2", 0x5000_0000, 0x6_1000),
];

static OPS: MemoryRegionOps = MemoryRegionOps::little_endian(read, write);

/// Set at the start, for use once there is a machine.
static FRAMES: OnceLock<Vec<Frame>> = OnceLock::new();
static BOARD: OnceLock<Mutex<Board>> = OnceLock::new();

/// QEMU's entry point. It is called early, before there is a machine.
///
/// # Safety
/// QEMU calls it, with `argc` strings in `argv`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn qemu_plugin_install(
    _id: u64,
    _info: *const c_void,
    argc: c_int,
    argv: *const *const c_char,
) -> c_int {
    // SAFETY: the caller's promise.
    let arguments = unsafe { sys::strings(argc, argv) };
    let Some(frames) = arguments.iter().map(|argument| frame(argument)).collect() else {
        eprintln!("qemu-bridge: an argument is like `send=7E5#0401`");
        return 1;
    };
    FRAMES.get_or_init(|| frames);
    sys::on_machine_ready(machine_ready);
    0
}

/// The frame of an argument, in the notation of candump.
fn frame(argument: &str) -> Option<Frame> {
    let (id, data) = argument.strip_prefix("send=")?.split_once('#')?;
    let byte = |pair: &[u8]| u8::from_str_radix(str::from_utf8(pair).ok()?, 16).ok();
    let data: Option<Vec<u8>> = data.as_bytes().chunks(2).map(byte).collect();
    Some(Frame::data(Id::Standard(u16::from_str_radix(id, 16).ok()?), &data?))
}

extern "C" fn machine_ready(_: *mut c_void, _: *mut c_void) {
    let frames = FRAMES.get().expect("the plugin is installed before the machine is made");
    BOARD.get_or_init(|| Mutex::new(Board::new(frames, Machine::find(tick))));
    for (name, base, length) in RANGES {
        sys::map(name, base, length, &OPS);
    }
    sys::on_reset(reset);
}

fn board() -> MutexGuard<'static, Board> {
    let board = BOARD.get().expect("QEMU calls back after the machine is made");
    board.lock().expect("a panic in a callback ends QEMU")
}

extern "C" fn reset(_: *mut c_void) {
    board().reset();
}

extern "C" fn tick(_: *mut c_void) {
    board().advance();
}

extern "C" fn read(base: *mut c_void, offset: u64, data: &mut u64, size: c_uint) -> c_uint {
    match board().read(address(base, offset), width(size)) {
        Ok(value) => {
            *data = value.into();
            MEMTX_OK
        }
        Err(BusFault) => MEMTX_ERROR,
    }
}

extern "C" fn write(base: *mut c_void, offset: u64, data: u64, size: c_uint) -> c_uint {
    match board().write(address(base, offset), width(size), data as u32) {
        Ok(()) => MEMTX_OK,
        Err(BusFault) => MEMTX_ERROR,
    }
}

fn address(base: *mut c_void, offset: u64) -> u32 {
    base.addr() as u32 + offset as u32
}

fn width(size: c_uint) -> Width {
    Width::of(size as usize).expect("QEMU has no other accesses")
}
