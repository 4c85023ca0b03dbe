//! The STM32G4's FDCAN with its registers and message RAM (RM0440 chapter 44), on top of a protocol controller. CAN FD
//! frames, the restricted operation mode, the clock stop, and the time-out counter are not modelled.

mod filters;
mod memory;
mod registers;
mod station;

use super::{Clock, Controller, Frame, Level, Mode, Note, Peripheral, requests::Requests};
use crate::Time;
use memory::{DEPTH, Fifo, Memory};
pub(crate) use registers::RAM;
use registers::*;

/// Interrupt lines 0 and 1, between which ILS chooses.
pub const IT0: u8 = 1 << 0;
pub const IT1: u8 = 1 << 1;

#[derive(Debug)]
pub struct Fdcan {
    controller: Controller,
    /// The clock before its divider.
    kernel: Clock,
    /// The registers that are stored, by their offsets.
    regs: [u32; 0x104 / 4],
    memory: Memory,
    lec: u32,
    /// EP, EW and BO at the previous check, to detect changes.
    status: u32,
    errors_logged: u32,
    received: [Fifo; 2],
    events: Fifo,
    requests: Requests,
    /// The buffer after the one that was requested last, in FIFO mode.
    put: usize,
    /// The buffers whose cancellation waits for the end of their frame.
    cancelling: u32,
    /// Start of the counter of bit times.
    counts_from: Time,
    notes: Vec<(Time, Note)>,
    irq: u8,
}

impl Default for Fdcan {
    fn default() -> Self {
        Self::new()
    }
}

impl Fdcan {
    /// A peripheral after power-on, on a clock of 16 MHz.
    pub fn new() -> Self {
        let kernel = Clock { hz: 16_000_000, ppm: 0 };
        let mut regs = [0; _];
        for (offset, value) in RESET_VALUES {
            regs[offset as usize / 4] = value;
        }
        let bit_timing = bit_timing(regs[NBTP as usize / 4]);
        let mut controller = Controller::new(kernel, bit_timing);
        // The first 11 recessive bits count beside the 128 times of ISO 11898-1 (RM0440 44.4.7).
        controller.set_recovery(129);
        Self {
            controller,
            kernel,
            regs,
            memory: Memory::new(),
            lec: NO_CHANGE,
            status: 0,
            errors_logged: 0,
            received: Default::default(),
            events: Fifo::default(),
            requests: Requests::default(),
            put: 0,
            cancelling: 0,
            counts_from: Time::ZERO,
            notes: Vec::new(),
            irq: 0,
        }
    }

    fn reg(&self, offset: u32) -> u32 {
        self.regs[offset as usize / 4]
    }

    fn reg_mut(&mut self, offset: u32) -> &mut u32 {
        &mut self.regs[offset as usize / 4]
    }

    fn has(&self, bit: u32) -> bool {
        self.reg(CCCR) & bit != 0
    }

    fn is_configurable(&self) -> bool {
        self.has(CCCR_INIT) && self.has(CCCR_CCE)
    }

    fn is_fifo_mode(&self) -> bool {
        self.reg(TXBC) & TXBC_TFQM == 0
    }

    fn pending(&self) -> u32 {
        (0..DEPTH).map(|buffer| u32::from(self.requests.is_pending(buffer)) << buffer).sum()
    }

    /// EP, EW and BO.
    fn flags(&self) -> u32 {
        let counters = self.controller.counters();
        let flag = |bit, set: bool| if set { bit } else { 0 };
        flag(PSR_EP, counters.passive())
            | flag(PSR_EW, counters.warning())
            | flag(PSR_BO, counters.bus_off())
    }

    fn psr(&self) -> u32 {
        let activity = match &self.controller {
            controller if self.has(CCCR_INIT) || !controller.is_joined() => 0,
            controller if controller.recovered_sequences().is_some() => 0,
            controller if controller.is_transmitting() => 3,
            controller if controller.is_receiving() => 2,
            _ => 1,
        };
        self.lec | activity << 3 | self.flags() | DLEC_NO_CHANGE
    }

    /// During bus-off recovery REC counts the sequences of 11 recessive bits.
    fn ecr(&self) -> u32 {
        let counters = self.controller.counters();
        let received = match self.controller.recovered_sequences() {
            Some(sequences) => sequences.into(),
            None => counters.receive,
        };
        let passive = if received > 127 { ECR_RP } else { 0 };
        u32::from(counters.transmit.min(255))
            | u32::from(received.min(127)) << REC_SHIFT
            | passive
            | self.errors_logged << CEL_SHIFT
    }

    fn txfqs(&self) -> u32 {
        let free = self.requests.free();
        let full = if free.is_none() { TXFQS_TFQF } else { 0 };
        if !self.is_fifo_mode() {
            return (free.unwrap_or(0) as u32) << 16 | full;
        }
        let pending = self.pending().count_ones();
        let get = self.requests.order(true).first().copied().unwrap_or(self.put);
        (DEPTH as u32 - pending) | (get as u32) << 8 | (self.put as u32) << 16 | full
    }

    /// The number of periods of the time stamp counter from its start to `at`, if it counts bit times.
    fn stamp(&self, at: Time) -> u16 {
        let tscc = self.reg(TSCC);
        if tscc & 3 != 1 {
            return 0;
        }
        let period = self.controller.bit_time() * u64::from((tscc >> 16 & 0xF) + 1);
        (at.saturating_sub(self.counts_from).as_ps() / period.as_ps()) as u16
    }

    fn write_register(&mut self, offset: u32, value: u32, now: Time) -> bool {
        let value = if offset == TEST { value & !TEST_RX } else { value };
        if is_protected(offset) && !self.is_configurable() {
            return value == self.reg(offset);
        }
        match offset {
            CCCR => return self.write_cccr(value, now),
            NBTP => self.write_nbtp(value, now),
            // Without CCCR.TEST it keeps its reset value.
            TEST if !self.has(CCCR_TEST) => {}
            TSCV => self.counts_from = now,
            IR => *self.reg_mut(IR) &= !value,
            RXF0A => self.received[0].acknowledge(value),
            RXF1A => self.received[1].acknowledge(value),
            TXEFA => self.events.acknowledge(value),
            TXBAR => return self.request(value & 0b111, now),
            TXBCR => self.cancel(value & 0b111, now),
            CKDIV => {
                *self.reg_mut(CKDIV) = value & 0xF;
                self.set_clock(self.kernel);
            }
            DBTP | TEST | RWD | TSCC | TOCC | TDCR | IE | ILS | ILE | RXGFC | XIDAM | TXBC
            | TXBTIE | TXBCIE => *self.reg_mut(offset) = value,
            RAM.. => return self.memory.write(offset - RAM, value),
            _ => return false,
        }
        true
    }

    fn write_nbtp(&mut self, value: u32, now: Time) {
        if self.reg(NBTP) != value {
            self.notes.push((now, Note::BitTiming(value)));
        }
        *self.reg_mut(NBTP) = value;
    }

    fn write_cccr(&mut self, value: u32, now: Time) -> bool {
        let before = self.reg(CCCR);
        let mut new = value & (CCCR_INIT | CCCR_CCE | CCCR_PROTECTED);
        if !self.is_configurable() {
            // The program may clear these two at any time, and set none.
            let kept = before & !(!new & (CCCR_MON | CCCR_ASM));
            new = new & !CCCR_PROTECTED | kept & CCCR_PROTECTED;
        }
        if before & new & CCCR_INIT == 0 {
            new &= !CCCR_CCE;
        }
        *self.reg_mut(CCCR) = new;
        if new & !before & CCCR_INIT != 0 {
            // Whether a frame under way is cut off is not said (confidence 0.7).
            self.controller.halt();
            self.notes.push((now, Note::InitializationEntered));
        }
        if new & !before & CCCR_CCE != 0 {
            self.clear_status();
        }
        if before & !new & CCCR_INIT != 0 {
            self.start(now);
        }
        self.offer();
        value & (CCCR_ASM | CCCR_CSR | CCCR_FDOE) == 0
    }

    /// Takes part in the bus with the mode and the bit timing that the program has set.
    fn start(&mut self, now: Time) {
        let loopback = self.has(CCCR_TEST) && self.reg(TEST) & TEST_LBCK != 0;
        self.controller.halt();
        let mode = Mode { silent: self.has(CCCR_MON), loopback };
        self.controller.configure(bit_timing(self.reg(NBTP)), mode);
        self.controller.start(now);
        self.counts_from = now;
        self.notes.push((now, Note::InitializationLeft));
    }

    /// Resets the registers that CCE holds in reset (RM0440 44.3.2).
    fn clear_status(&mut self) {
        for offset in [HPMS, TXBTO, TXBCF] {
            *self.reg_mut(offset) = 0;
        }
        self.received = Default::default();
        self.events = Fifo::default();
        self.requests = Requests::default();
        (self.put, self.cancelling) = (0, 0);
    }

    /// Requests the transmission of these buffers. Returns false if one is a CAN FD frame.
    fn request(&mut self, buffers: u32, now: Time) -> bool {
        let mode = self.controller.mode();
        if self.has(CCCR_CCE) || (mode.silent && !mode.loopback) {
            return true;
        }
        for buffer in bits(buffers & !self.pending()) {
            let content = self.memory.buffer(buffer);
            if content.is_fd {
                return false;
            }
            *self.reg_mut(TXBTO) &= !(1 << buffer);
            *self.reg_mut(TXBCF) &= !(1 << buffer);
            self.requests.add(buffer, content.frame, now);
            self.put = (buffer + 1) % DEPTH;
            self.notes.push((now, Note::Requested { mailbox: buffer, frame: content.frame }));
        }
        self.offer();
        true
    }

    /// Empties these buffers; a frame that is under way or chosen next is finished first.
    fn cancel(&mut self, buffers: u32, now: Time) {
        let spared = self.requests.spared(self.controller.is_starting());
        for buffer in bits(buffers & self.pending()) {
            if spared == Some(buffer) {
                self.cancelling |= 1 << buffer;
            } else {
                self.withdraw(buffer, now);
            }
        }
        self.offer();
    }

    fn withdraw(&mut self, buffer: usize, now: Time) {
        if let Some(frame) = self.complete(buffer, false) {
            self.notes.push((now, Note::Aborted { mailbox: buffer, frame }));
        }
    }

    /// Frees a buffer whose frame was sent, or is not going to be.
    fn complete(&mut self, buffer: usize, was_sent: bool) -> Option<Frame> {
        let bit = 1 << buffer;
        let is_cancelled = self.cancelling & bit != 0;
        self.cancelling &= !bit;
        let frame = self.requests.remove(buffer);
        if was_sent {
            *self.reg_mut(TXBTO) |= bit;
            self.raise(if self.reg(TXBTIE) & bit == 0 { 0 } else { IR_TC });
        }
        if is_cancelled || !was_sent {
            *self.reg_mut(TXBCF) |= bit;
            self.raise(if self.reg(TXBCIE) & bit == 0 { 0 } else { IR_TCF });
        }
        if self.is_fifo_mode() && self.pending() == 0 {
            self.raise(IR_TFE);
        }
        frame
    }

    fn raise(&mut self, interrupts: u32) {
        *self.reg_mut(IR) |= interrupts;
    }
}

impl Peripheral for Fdcan {
    /// The message RAM keeps its content.
    fn reset(&mut self) {
        let old = std::mem::take(self);
        self.controller = old.controller;
        self.controller.reset();
        self.controller.configure(bit_timing(self.reg(NBTP)), Mode::default());
        self.memory = old.memory;
        self.notes = old.notes;
        self.set_clock(old.kernel);
    }

    fn set_clock(&mut self, clock: Clock) {
        self.kernel = clock;
        let divider = (2 * self.reg(CKDIV)).max(1);
        self.controller.set_clock(Clock { hz: clock.hz / divider, ..clock });
    }

    fn irq(&self) -> u8 {
        self.irq
    }

    fn interrupts(&self) -> u8 {
        let raised = self.reg(IR) & self.reg(IE);
        let groups = ILS_GROUPS.iter().enumerate();
        let second = groups.filter(|(group, _)| self.reg(ILS) >> group & 1 == 1);
        let second = second.fold(0, |all, (_, interrupts)| all | interrupts);
        let line_0 = if raised & !second == 0 { 0 } else { IT0 };
        let line_1 = if raised & second == 0 { 0 } else { IT1 };
        (line_0 | line_1) & self.reg(ILE) as u8
    }

    fn update_irq(&mut self) {
        self.irq = self.interrupts();
    }

    fn is_in_use(&self) -> bool {
        !self.has(CCCR_INIT) || self.controller.counters().bus_off()
    }

    fn bit_rate(&self) -> u32 {
        self.controller.bit_rate()
    }

    fn is_silent(&self) -> bool {
        self.has(CCCR_MON)
    }

    fn is_start(&self, offset: u32, value: u32) -> bool {
        offset == CCCR && value & CCCR_INIT == 0
    }

    fn read(&self, offset: u32, now: Time) -> Option<u32> {
        let lost = |fifo: usize| if self.reg(IR) & RFL << (3 * fifo) == 0 { 0 } else { 1 << 25 };
        Some(match offset {
            ECR => self.ecr(),
            PSR => self.psr(),
            TSCV => self.stamp(now).into(),
            RXF0S => self.received[0].status() | lost(0),
            RXF1S => self.received[1].status() | lost(1),
            TXFQS => self.txfqs(),
            TXBRP => self.pending(),
            TXBCR => self.cancelling,
            TXEFS if self.reg(IR) & IR_TEFL != 0 => self.events.status() | 1 << 25,
            TXEFS => self.events.status(),
            TEST if self.controller.wire_level() == Level::Recessive => self.reg(TEST) | TEST_RX,
            RXF0A | RXF1A | TXEFA | TXBAR => 0,
            CREL | ENDN | CCCR | NBTP | TOCV | IR | HPMS | TXBTO | TXBCF | CKDIV => {
                self.reg(offset)
            }
            DBTP | TEST | RWD | TSCC | TOCC | TDCR | IE | ILS | ILE | RXGFC | XIDAM | TXBC
            | TXBTIE | TXBCIE => self.reg(offset),
            RAM.. => return self.memory.read(offset - RAM),
            _ => return None,
        })
    }

    /// A read of PSR sets LEC to "no change", one of ECR clears CEL.
    fn load(&mut self, offset: u32, now: Time) -> Option<u32> {
        let value = self.read(offset, now);
        match offset {
            PSR => self.lec = NO_CHANGE,
            ECR => self.errors_logged = 0,
            _ => {}
        }
        value
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> bool {
        let modelled = self.write_register(offset, value, now);
        self.update_irq();
        modelled
    }

    fn take_notes(&mut self) -> Vec<(Time, Note)> {
        std::mem::take(&mut self.notes)
    }
}

/// The numbers of the bits that are set.
fn bits(mask: u32) -> impl Iterator<Item = usize> {
    (0..DEPTH).filter(move |bit| mask >> bit & 1 == 1)
}
