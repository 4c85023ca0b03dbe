//! The chip and the adapter on their bus, in QEMU's time.

use std::{collections::VecDeque, io::Write};

use emulator::{
    Time,
    can::{Adapter, Bus, Clock, Frame, Station},
    chip::{Access, BusFault, Chip, FLASH_BASE, Part, Request, ResetCause, Width},
};

use crate::{
    arguments::Arguments,
    sys::{self, Machine},
};

const CAN1: std::ops::Range<u32> = 0x4000_6400..0x4000_6800;

/// The time for which an internal reset pulls NRST low (RM0090 7.1.1).
const RESET_HOLD: Time = Time::from_us(20);

/// Everything around QEMU's CPU.
pub struct Board {
    chip: Chip,
    bus: Bus,
    adapter: Adapter,
    to_send: VecDeque<Frame>,
    interval: Time,
    /// The time at which the next frame is queued, or of the end.
    next_frame: Time,
    machine: Machine,
    irqs: u128,
    core_clock: u32,
    /// The cause of the next reset.
    reset_cause: ResetCause,
    /// Whether the chip has requested a reset.
    is_resetting: bool,
}

impl Board {
    /// A board with an 8 MHz crystal and erased settings.
    pub fn new(arguments: &Arguments, machine: Machine) -> Self {
        let crystal = Clock { hz: 8_000_000, ppm: 0 };
        Self {
            chip: Chip::new(Part::Stm32f405, crystal, arguments.unique_id),
            bus: Bus::new(),
            adapter: Adapter::new(arguments.bit_rate),
            to_send: arguments.frames.iter().copied().collect(),
            interval: arguments.interval,
            next_frame: arguments.start,
            machine,
            irqs: 0,
            core_clock: 0,
            reset_cause: ResetCause::PowerOn,
            is_resetting: false,
        }
    }

    /// Handles a reset of the machine.
    pub fn reset(&mut self) {
        // If the chip did not request it, the program did.
        let cause = std::mem::replace(&mut self.reset_cause, ResetCause::Software);
        self.is_resetting = false;
        self.chip.reset(cause, self.machine.now());
        self.update();
    }

    /// Handles the expiry of the timer.
    pub fn advance(&mut self) {
        self.machine.timer_expired();
        let now = self.machine.now();
        if !self.is_resetting && now >= self.chip.next_event() {
            self.chip.advance(now);
        }
        if let Some(Request::Reset(cause)) = self.chip.take_request() {
            self.reset_cause = cause;
            self.is_resetting = true;
            sys::request_reset();
        }
        self.run_bus(now);
        if now >= self.next_frame {
            self.next_frame += self.interval;
            match self.to_send.pop_front() {
                Some(frame) => self.send(frame, now),
                None => self.end(),
            }
            self.run_bus(now);
        }
        self.update();
    }

    /// Handles a load of the CPU.
    pub fn read(&mut self, address: u32, width: Width) -> Result<u32, BusFault> {
        let flash = self.chip.flash().bytes();
        let offset = address.wrapping_sub(FLASH_BASE) as usize & !3;
        if let Some(word) = flash.get(offset..offset + 4) {
            let word = u32::from_le_bytes(word.try_into().expect("four bytes"));
            return Ok(word >> (8 * (address & 3)));
        }
        let access = self.access(address, width);
        let value = self.chip.read(access);
        self.update();
        value
    }

    /// Handles a store of the CPU. If it makes the flash busy, the CPU stalls, as at its next fetch.
    pub fn write(&mut self, address: u32, width: Width, value: u32) -> Result<(), BusFault> {
        let access = self.access(address, width);
        let result = self.chip.write(access, value);
        if self.chip.take_can_written() {
            self.run_bus(access.now);
        }
        if let Some(end) = self.chip.stalled_until(FLASH_BASE, access.now) {
            self.machine.stall(end - access.now);
        }
        self.update();
        result
    }

    /// An access at the current time; for the CAN controller the bus is brought up to date first.
    fn access(&mut self, address: u32, width: Width) -> Access {
        let now = self.machine.now();
        if CAN1.contains(&address) {
            self.run_bus(now);
        }
        // QEMU does not report the program counter to a device.
        Access { address, width, now, pc: 0 }
    }

    fn send(&mut self, frame: Frame, now: Time) {
        print(now, '>', frame);
        self.adapter.send(frame);
    }

    fn end(&mut self) {
        for finding in self.chip.findings() {
            println!("finding: {finding}");
        }
        self.next_frame = Time::MAX;
        sys::request_shutdown();
    }

    /// Runs the bus up to the CPU's time.
    fn run_bus(&mut self, now: Time) {
        loop {
            let stations: &mut [&mut dyn Station] = &mut [self.chip.can_mut(1), &mut self.adapter];
            let reached = self.bus.advance(now, stations, &mut |_, _, _| {});
            while let Some((time, frame)) = self.adapter.receive() {
                print(time, '<', frame);
            }
            if reached >= now {
                break;
            }
        }
        self.chip.can_mut(1).update_irq();
        self.chip.can_mut(1).take_notes();
    }

    /// Reports the chip's outputs and its next event to QEMU.
    fn update(&mut self) {
        let irqs = self.chip.irqs();
        let mut changed = irqs ^ self.irqs;
        self.irqs = irqs;
        while changed != 0 {
            let number = changed.trailing_zeros();
            changed &= changed - 1;
            self.machine.set_irq(number, irqs >> number & 1 == 1);
        }
        let hz = self.chip.clocks().hclk.hz;
        if std::mem::replace(&mut self.core_clock, hz) != hz {
            self.machine.set_clock(hz);
        }
        // A reset is carried out late, and QEMU's time may jump to the timer meanwhile.
        let event = match self.is_resetting {
            true => self.machine.now() + RESET_HOLD,
            false => self.chip.next_event(),
        };
        self.machine.set_timer(event.min(self.bus.next_action()).min(self.next_frame));
    }
}

/// Prints a line that a program can read: time in ms, direction as seen by the adapter, frame.
fn print(time: Time, direction: char, frame: Frame) {
    println!("{time} {direction} {frame}");
    // QEMU ends without Rust's clean-up.
    let _ = std::io::stdout().flush();
}
