//! For a run in lock-step: no chip at all. What the program loads from peripherals is what another run loaded there.
//!
//! A debugger drives it through the window from [`WINDOW`] on, by physical accesses (`qemu.PhyMemMode`), while the core
//! stands still. Offsets, of words:
//!
//! - `0000..0100`, written: what the next loads from peripherals give, in order;
//! - `0100`, `0104`, written: the number of an interrupt line that rises, that falls;
//! - `0108`, written: SysTick becomes pending;
//! - `010C`, written: a reset, which is over at the next access;
//! - `0110..0120`, written: what `SYST_CSR`, `SYST_RVR`, `SYST_CVR`, `SYST_CALIB` read as;
//! - `0200..0300`, read: the accesses to peripherals since the last read, oldest first, as three words each: kind (bytes,
//!   and `100` for a store), address, value; zeros when there are no more;
//! - `8000..10000`, written: content of the flash sectors with the settings.

use std::{
    collections::VecDeque,
    ffi::{c_uint, c_void},
    sync::{Mutex, MutexGuard, OnceLock},
};

use crate::{
    RANGES, SETTINGS, address,
    sys::{self, Interrupts, MEMTX_ERROR, MEMTX_OK, MemoryRegionOps},
};

/// Where the chip has nothing.
const WINDOW: u32 = 0x6000_0000;
const WINDOW_LENGTH: u64 = 0x1_0000;
const SETTINGS_IN_WINDOW: u32 = 0x8000;
const SYSTICK: u32 = 0xE000_E010;
const STORE: u32 = 0x100;

static OPS: MemoryRegionOps = MemoryRegionOps::little_endian(read, write);
static SYSTICK_OPS: MemoryRegionOps = MemoryRegionOps::little_endian(read_systick, write_systick);
static WINDOW_OPS: MemoryRegionOps = MemoryRegionOps::little_endian(read_window, write_window);

static MIRROR: OnceLock<Mutex<Mirror>> = OnceLock::new();

struct Mirror {
    interrupts: Interrupts,
    loads: VecDeque<u32>,
    accesses: VecDeque<u32>,
    systick: [u32; 4],
    settings: Vec<u8>,
}

/// Takes the place of all peripherals in a complete machine.
pub fn install() {
    let mirror = Mirror {
        interrupts: Interrupts::find(),
        loads: VecDeque::new(),
        accesses: VecDeque::new(),
        systick: [0; 4],
        settings: vec![0xFF; SETTINGS.2 as usize],
    };
    MIRROR.get_or_init(|| Mutex::new(mirror));
    for (name, base, length) in RANGES {
        sys::map(name, base, length, &OPS);
    }
    sys::map(c"lock-step", WINDOW, WINDOW_LENGTH, &WINDOW_OPS);
    sys::map_in_core(c"mirrored systick", SYSTICK, 0x10, &SYSTICK_OPS);
    sys::map_in_core(c"dbgmcu", 0xE004_2000, 0x400, &OPS);
}

fn mirror() -> MutexGuard<'static, Mirror> {
    let mirror = MIRROR.get().expect("QEMU calls back after the machine is made");
    mirror.lock().expect("a panic in a callback ends QEMU")
}

impl Mirror {
    fn read(&mut self, address: u32, size: u32) -> u32 {
        let offset = address.wrapping_sub(SETTINGS.1) as usize;
        if let Some(bytes) = self.settings.get(offset..offset.saturating_add(size as usize)) {
            return bytes.iter().rev().fold(0, |value, byte| value << 8 | u32::from(*byte));
        }
        let value = self.loads.pop_front().unwrap_or(0);
        self.accesses.extend([size, address, value]);
        value
    }

    fn write_window(&mut self, offset: u32, size: u32, value: u32) {
        match offset {
            0x000..0x100 => self.loads.push_back(value),
            0x100 => self.interrupts.set_irq(value, true),
            0x104 => self.interrupts.set_irq(value, false),
            0x108 => self.interrupts.pend_systick(),
            0x10C => sys::request_reset(),
            0x110..0x120 => self.systick[(offset - 0x110) as usize / 4] = value,
            SETTINGS_IN_WINDOW.. => {
                let start = (offset - SETTINGS_IN_WINDOW) as usize;
                for (place, byte) in
                    self.settings[start..].iter_mut().zip(value.to_le_bytes()).take(size as usize)
                {
                    *place = byte;
                }
            }
            _ => {}
        }
    }
}

extern "C" fn read(base: *mut c_void, offset: u64, data: &mut u64, size: c_uint) -> c_uint {
    *data = mirror().read(address(base, offset), size).into();
    MEMTX_OK
}

extern "C" fn write(base: *mut c_void, offset: u64, data: u64, size: c_uint) -> c_uint {
    mirror().accesses.extend([STORE | size, address(base, offset), data as u32]);
    MEMTX_OK
}

extern "C" fn read_systick(_: *mut c_void, offset: u64, data: &mut u64, size: c_uint) -> c_uint {
    if size != 4 {
        return MEMTX_ERROR;
    }
    *data = mirror().systick[offset as usize / 4].into();
    MEMTX_OK
}

/// The other run's SysTick counts for both.
extern "C" fn write_systick(_: *mut c_void, _: u64, _: u64, _: c_uint) -> c_uint {
    MEMTX_OK
}

extern "C" fn read_window(_: *mut c_void, offset: u64, data: &mut u64, _: c_uint) -> c_uint {
    *data = match offset {
        0x200..0x300 => mirror().accesses.pop_front().unwrap_or(0).into(),
        _ => 0,
    };
    MEMTX_OK
}

extern "C" fn write_window(_: *mut c_void, offset: u64, data: u64, size: c_uint) -> c_uint {
    mirror().write_window(offset as u32, size, data as u32);
    MEMTX_OK
}
