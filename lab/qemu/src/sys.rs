//! The required part of QEMU's C interface, and safe calls of it; all of it runs under QEMU's big lock.

use std::{
    ffi::{CStr, c_char, c_int, c_uint, c_void},
    ptr,
};

use emulator::Time;

/// `MemTxResult` of a successful access.
pub const MEMTX_OK: c_uint = 0;
/// `MemTxResult` that causes a BusFault.
pub const MEMTX_ERROR: c_uint = 1;

/// `enum QEMUClockType`: time that stands still while the machine is stopped.
const QEMU_CLOCK_VIRTUAL: c_int = 1;
/// `enum device_endian`.
const DEVICE_LITTLE_ENDIAN: c_int = 2;
/// `enum ShutdownCause`.
const SHUTDOWN_CAUSE_GUEST_SHUTDOWN: c_int = 6;
/// `CLOCK_PERIOD_1SEC`: clocks have periods in units of 2^-32 ns.
const PERIOD_OF_1_HZ: u64 = 1_000_000_000 << 32;

/// Zeroed memory that is never freed, as QEMU keeps pointers to it: far more than a `MemoryRegion` or a `QEMUTimer` needs.
fn leak_opaque() -> *mut c_void {
    ptr::from_mut(Box::leak(Box::new([0_u128; 256]))).cast()
}

type Callback = extern "C" fn(opaque: *mut c_void);
type Notify = extern "C" fn(notifier: *mut c_void, data: *mut c_void);
/// `read_with_attrs`; its last parameter, the attributes, is ignored.
type Read = extern "C" fn(opaque: *mut c_void, offset: u64, data: &mut u64, size: c_uint) -> c_uint;
/// `write_with_attrs`, likewise.
type Write = extern "C" fn(opaque: *mut c_void, offset: u64, data: u64, size: c_uint) -> c_uint;

/// `struct MemoryRegionOps`, the same from QEMU 2 to 10.
#[repr(C)]
pub struct MemoryRegionOps {
    read: Option<Callback>,
    write: Option<Callback>,
    read_with_attrs: Read,
    write_with_attrs: Write,
    endianness: c_int,
    valid: AccessSizes<Option<Callback>>,
    implemented: AccessSizes<()>,
}

#[repr(C)]
struct AccessSizes<Accepts> {
    min: c_uint,
    max: c_uint,
    unaligned: bool,
    accepts: Accepts,
}

impl MemoryRegionOps {
    /// The operations of a device with aligned accesses of 1, 2 and 4 bytes.
    pub const fn little_endian(read: Read, write: Write) -> Self {
        Self {
            read: None,
            write: None,
            read_with_attrs: read,
            write_with_attrs: write,
            endianness: DEVICE_LITTLE_ENDIAN,
            valid: AccessSizes { min: 1, max: 4, unaligned: false, accepts: None },
            implemented: AccessSizes { min: 1, max: 4, unaligned: false, accepts: () },
        }
    }
}

/// `struct Notifier`, with the links of its list.
#[repr(C)]
struct Notifier {
    notify: Notify,
    links: [*mut c_void; 2],
}

// SAFETY: as the headers of QEMU 7.2 to 10.0 and of the C library declare them.
unsafe extern "C" {
    fn dlsym(library: *mut c_void, name: *const c_char) -> *mut c_void;
    fn qemu_add_machine_init_done_notifier(notifier: *mut Notifier);
    fn qemu_register_reset(callback: Callback, opaque: *mut c_void);
    fn qemu_system_shutdown_request(cause: c_int);
    fn qemu_clock_get_ns(clock: c_int) -> i64;
    fn timer_init_full(
        timer: *mut c_void,
        group: *mut c_void,
        clock: c_int,
        scale: c_int,
        attributes: c_int,
        callback: Callback,
        opaque: *mut c_void,
    );
    fn timer_mod(timer: *mut c_void, expires: i64);
    fn get_system_memory() -> *mut c_void;
    fn memory_region_init_io(
        region: *mut c_void,
        owner: *mut c_void,
        ops: *const MemoryRegionOps,
        opaque: *mut c_void,
        name: *const c_char,
        length: u64,
    );
    fn memory_region_add_subregion_overlap(
        region: *mut c_void,
        offset: u64,
        inner: *mut c_void,
        priority: c_int,
    );
    fn object_resolve_path(path: *const c_char, ambiguous: *mut bool) -> *mut c_void;
    fn object_resolve_path_type(
        path: *const c_char,
        type_name: *const c_char,
        ambiguous: *mut bool,
    ) -> *mut c_void;
    fn qdev_get_gpio_in(device: *mut c_void, number: c_int) -> *mut c_void;
    fn qemu_set_irq(line: *mut c_void, level: c_int);
    fn clock_set(clock: *mut c_void, period: u64) -> bool;
    fn clock_propagate(clock: *mut c_void);
}

/// Whether QEMU has a symbol.
pub fn exports(name: &CStr) -> bool {
    // SAFETY: the null library is the whole program.
    let symbol = unsafe { dlsym(ptr::null_mut(), name.as_ptr()) };
    !symbol.is_null()
}

/// Converts the arguments of a C program.
///
/// # Safety
/// `argv` points to `count` strings.
pub unsafe fn strings(count: c_int, argv: *const *const c_char) -> Vec<String> {
    let string = |index: c_int| {
        // SAFETY: `index` is below `count`.
        let string = unsafe { CStr::from_ptr(*argv.offset(index as isize)) };
        string.to_string_lossy().into_owned()
    };
    (0..count).map(string).collect()
}

/// Registers `notify` to be called once the machine is complete and before its first reset.
pub fn on_machine_ready(notify: Notify) {
    let notifier = Box::leak(Box::new(Notifier { notify, links: [ptr::null_mut(); 2] }));
    // SAFETY: it lives forever, and only QEMU uses it from here on.
    unsafe { qemu_add_machine_init_done_notifier(notifier) }
}

/// Registers `callback` for every reset of the machine, after those of QEMU's own devices.
pub fn on_reset(callback: Callback) {
    // SAFETY: the callback does not use its argument.
    unsafe { qemu_register_reset(callback, ptr::null_mut()) }
}

/// Requests QEMU's successful end.
pub fn request_shutdown() {
    // SAFETY: may be called by any thread at any time.
    unsafe { qemu_system_shutdown_request(SHUTDOWN_CAUSE_GUEST_SHUTDOWN) }
}

/// Maps `ops` over `length` bytes from `base` on, above QEMU's own regions; they get `base` as their `opaque`.
pub fn map(name: &CStr, base: u32, length: u64, ops: &'static MemoryRegionOps) {
    // SAFETY: there is a machine whenever a region is mapped.
    let memory = unsafe { get_system_memory() };
    let region = leak_opaque();
    let opaque = ptr::without_provenance_mut(base as usize);
    // SAFETY: region and operations live forever, the name is copied, and the region is larger than a MemoryRegion.
    unsafe {
        memory_region_init_io(region, ptr::null_mut(), ops, opaque, name.as_ptr(), length);
        memory_region_add_subregion_overlap(memory, base.into(), region, 10);
    }
}

/// QEMU's objects that the chip drives: the core's interrupt lines, its clock, and a timer.
pub struct Machine {
    core: *mut c_void,
    clock: *mut c_void,
    timer: *mut c_void,
    /// The lead of the board's time over QEMU's, in which the core never stalls.
    stalled: Time,
}

// SAFETY: QEMU's threads use its objects in turn, under the big lock, which every callback holds.
unsafe impl Send for Machine {}

impl Machine {
    /// Finds the objects in a complete machine; `tick` is called when the timer expires.
    ///
    /// # Panics
    /// The machine does not have one Cortex-M and a clock called SYSCLK, as netduinoplus2 has.
    pub fn find(tick: Callback) -> Self {
        let timer = leak_opaque();
        let null = ptr::null_mut();
        // SAFETY: the paths and names are strings, the timer lives forever and is larger than a QEMUTimer.
        let (clock, core) = unsafe {
            timer_init_full(timer, null, QEMU_CLOCK_VIRTUAL, 1, 0, tick, null);
            (
                object_resolve_path(c"/machine/SYSCLK".as_ptr(), ptr::null_mut()),
                object_resolve_path_type(c"".as_ptr(), c"armv7m".as_ptr(), ptr::null_mut()),
            )
        };
        assert!(!clock.is_null() && !core.is_null(), "the machine must be netduinoplus2");
        Self { core, clock, timer, stalled: Time::ZERO }
    }

    /// The current time of the board.
    pub fn now(&self) -> Time {
        // SAFETY: every caller is a device's or a timer's callback, where instructions are counted exactly.
        let ns = unsafe { qemu_clock_get_ns(QEMU_CLOCK_VIRTUAL) };
        Time::from_ns(ns as u64) + self.stalled
    }

    /// Lets time pass in which the core does nothing. SysTick misses it, as well as its interrupts.
    pub fn stall(&mut self, span: Time) {
        self.stalled += span;
    }

    /// Sets interrupt line `number`.
    pub fn set_irq(&self, number: u32, level: bool) {
        // SAFETY: the core is an ARMv7M with 96 lines, and the chip has fewer.
        unsafe { qemu_set_irq(qdev_get_gpio_in(self.core, number as c_int), level.into()) }
    }

    /// Sets the frequency of the core and of SysTick.
    pub fn set_clock(&self, hz: u32) {
        // SAFETY: it is a Clock that no other object drives.
        unsafe {
            if clock_set(self.clock, PERIOD_OF_1_HZ / u64::from(hz)) {
                clock_propagate(self.clock);
            }
        }
    }

    /// Lets the timer expire at the first nanosecond at or after `at`.
    pub fn set_timer(&self, at: Time) {
        let ns = at.saturating_sub(self.stalled).as_ps().div_ceil(1000);
        // SAFETY: the timer is initialised; the number of nanoseconds is far below the limit.
        unsafe { timer_mod(self.timer, ns as i64) }
    }
}
