//! The chip and the adapter on their bus, in QEMU's time.

use std::{collections::VecDeque, io::Write};

use emulator::{
    Time,
    can::{Adapter, Bus, Clock, Frame, Station},
    chip::{Access, BusFault, Chip, FLASH_BASE, Part, ResetCause, Width},
};

use crate::sys::{self, Machine};

/// The time at which the first frame is queued.
const START: Time = Time::from_s(1);
/// The time from one frame to the next, and from the last to the end.
const INTERVAL: Time = Time::from_ms(50);

/// Everything around QEMU's CPU.
pub struct Board {
    chip: Chip,
    bus: Bus,
    adapter: Adapter,
    to_send: VecDeque<Frame>,
    /// The time at which the next frame is queued, or of the end.
    next_frame: Time,
    machine: Machine,
    irqs: u128,
    /// The cause of the next reset: after the first one, only the program asks for any.
    reset_cause: ResetCause,
}

impl Board {
    /// A board with an 8 MHz crystal and erased settings.
    pub fn new(frames: &[Frame], machine: Machine) -> Self {
        Self {
            chip: Chip::new(Part::Stm32f407, Clock { hz: 8_000_000, ppm: 0 }, [0; 12]),
            bus: Bus::new(),
            adapter: Adapter::new(125_000),
            to_send: frames.iter().copied().collect(),
            next_frame: START,
            machine,
            irqs: 0,
            reset_cause: ResetCause::PowerOn,
        }
    }

    /// Handles a reset of the machine.
    pub fn reset(&mut self) {
        let cause = std::mem::replace(&mut self.reset_cause, ResetCause::Software);
        self.chip.reset(cause, self.machine.now());
        self.update();
    }

    /// Handles the expiry of the timer.
    pub fn advance(&mut self) {
        let now = self.machine.now();
        if now >= self.chip.next_event() {
            let request = self.chip.advance(now);
            assert_eq!(request, None, "only the program resets the chip");
        }
        self.run_bus(now);
        if now >= self.next_frame {
            self.next_frame += INTERVAL;
            match self.to_send.pop_front() {
                Some(frame) => {
                    print(now, '>', frame);
                    self.adapter.send(frame);
                }
                None => self.end(),
            }
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
        if let Some(end) = self.chip.stalled_until(FLASH_BASE, access.now) {
            self.machine.stall(end - access.now);
        }
        self.update();
        result
    }

    /// An access at the current time, to which the bus is brought first.
    fn access(&mut self, address: u32, width: Width) -> Access {
        let now = self.machine.now();
        self.run_bus(now);
        // QEMU does not report the program counter to a device.
        Access { address, width, now, pc: 0 }
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

    /// Brings the bus up to date and reports the chip's outputs and its next event to QEMU.
    fn update(&mut self) {
        self.run_bus(self.machine.now());
        let irqs = self.chip.irqs();
        let changed = std::mem::replace(&mut self.irqs, irqs) ^ irqs;
        for number in (0..128).filter(|number| changed >> number & 1 == 1) {
            self.machine.set_irq(number, irqs >> number & 1 == 1);
        }
        self.machine.set_clock(self.chip.clocks().hclk.hz);
        let event = self.chip.next_event().min(self.bus.next_action());
        self.machine.set_timer(event.min(self.next_frame));
    }
}

/// Prints a line that a program can read: time in ms, direction as seen by the adapter, frame.
fn print(time: Time, direction: char, frame: Frame) {
    println!("{time} {direction} {frame}");
    // QEMU ends without Rust's clean-up.
    let _ = std::io::stdout().flush();
}
