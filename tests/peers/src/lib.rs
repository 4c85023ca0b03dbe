//! The harness for all measured slaves: a receive and a transmit mailbox in RAM in place of the CAN controller's.
//!
//! A program has two functions. `prepare` is called once; `receive` is called for each frame, and its cost is counted
//! from its first instruction to its return.

#![no_std]

pub mod own;

use core::{
    arch::global_asm,
    cell::UnsafeCell,
    hint::spin_loop,
    mem::MaybeUninit,
    panic::PanicInfo,
    ptr::{read_volatile, write_volatile},
};

// Fills the stack below `receive` with a pattern, so that its high-water mark can be seen.
global_asm!(
    ".section .vectors, \"a\"",
    ".word stack_top",
    ".word start",
    ".section .text.start, \"ax\"",
    ".global start",
    ".type start, %function",
    ".thumb_func",
    "start:",
    "ldr r0, =0xE000ED88", // CPACR: the FPU on
    "ldr r1, =0x00F00000",
    "str r1, [r0]",
    "dsb",
    "isb",
    "bl prepare",
    "ldr r0, =stack_bottom",
    "ldr r1, =0xC5C5C5C5",
    "mov r2, sp",
    "0: str r1, [r0], #4",
    "cmp r0, r2",
    "blo 0b",
    "ldr r4, =WAITING",
    ".global idle",
    "idle:",
    "ldr r0, [r4]",
    "cmp r0, #0",
    "beq idle",
    "bl receive",
    ".global returned",
    "returned:",
    "movs r0, #0",
    "str r0, [r4]",
    "b idle",
);

/// A word that is also read and written from outside.
#[repr(transparent)]
pub struct Register(UnsafeCell<u32>);

// SAFETY: there is one thread.
unsafe impl Sync for Register {}

impl Register {
    /// A register with the value 0.
    pub const fn zero() -> Self {
        Self(UnsafeCell::new(0))
    }

    /// The value of the register.
    #[inline(always)]
    pub fn read(&self) -> u32 {
        // SAFETY: a valid word without references.
        unsafe { read_volatile(self.0.get()) }
    }

    /// Sets the value of the register.
    #[inline(always)]
    pub fn write(&self, value: u32) {
        // SAFETY: a valid word without references.
        unsafe { write_volatile(self.0.get(), value) }
    }
}

/// A mailbox of bxCAN (RM0090, 32.9.3): the 11-bit identifier in bits 31..21, and in bit 0 of a transmit mailbox the
/// request; the data length code; bytes 0..=3; bytes 4..=7.
type Mailbox = [Register; 4];

/// Nonzero while a frame is in [`RECEIVED`].
// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
static WAITING: Register = Register::zero();
// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
static RECEIVED: Mailbox = [const { Register::zero() }; 4];
// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
static TRANSMITTED: Mailbox = [const { Register::zero() }; 4];

/// The clock in microseconds.
// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
pub static NOW: Register = Register::zero();

/// The identifier of the received frame.
#[inline(always)]
pub fn received_identifier() -> u16 {
    (RECEIVED[0].read() >> 21) as u16
}

/// The data length code of the received frame, 0..=15, and its data.
#[inline(always)]
pub fn received_data() -> (usize, [u8; 8]) {
    let length = RECEIVED[1].read() as usize & 0xF;
    let [low, high] = [RECEIVED[2].read(), RECEIVED[3].read()];
    (length, (u64::from(high) << 32 | u64::from(low)).to_le_bytes())
}

/// Requests transmission of a frame with up to eight bytes; bytes beyond its length do not matter.
#[inline(always)]
pub fn transmit(identifier: u16, length: usize, data: [u8; 8]) {
    let data = u64::from_le_bytes(data);
    TRANSMITTED[1].write(length as u32);
    TRANSMITTED[2].write(data as u32);
    TRANSMITTED[3].write((data >> 32) as u32);
    TRANSMITTED[0].write(u32::from(identifier) << 21 | 1);
}

/// The eight bytes of a transmit mailbox, starting with `data`.
#[inline(always)]
pub fn padded(data: &[u8]) -> [u8; 8] {
    let mut bytes = [0; 8];
    for (to, from) in bytes.iter_mut().zip(data) {
        *to = *from;
    }
    bytes
}

/// The memory of a slave, which `prepare` fills.
pub struct Place<T>(UnsafeCell<MaybeUninit<T>>);

// SAFETY: there is one thread.
unsafe impl<T> Sync for Place<T> {}

impl<T> Place<T> {
    /// An empty place.
    pub const fn empty() -> Self {
        Self(UnsafeCell::new(MaybeUninit::uninit()))
    }

    /// Stores the slave.
    pub fn fill(&'static self, value: T) {
        // SAFETY: there is one thread, and `prepare` is over before `receive` is called.
        unsafe { (*self.0.get()).write(value) };
    }

    /// The stored slave.
    ///
    /// # Safety
    /// It has been filled, and the result of an earlier call is no longer used.
    #[expect(clippy::mut_from_ref, reason = "the caller promises it")]
    #[inline(always)]
    pub unsafe fn get(&'static self) -> &'static mut T {
        // SAFETY: as the caller promises.
        unsafe { (*self.0.get()).assume_init_mut() }
    }
}

/// Vendor-ID, product code, revision number and serial number: 16 ones in each.
pub const IDENTITY: [u32; 4] = [0x5AA5_3CC3, 0x0FF0_A55A, 0x3333_CCCC, 0x6996_9669];

/// The device name 1008h, which takes four segments.
pub const DEVICE_NAME: &str = "A device of the bench.";

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    loop {
        spin_loop();
    }
}
