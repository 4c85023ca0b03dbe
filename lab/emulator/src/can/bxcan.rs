//! The STM32F4's CAN1, CAN2 and CAN3 with their registers (RM0090 chapter 32, RM0430 chapter 32), on top of a protocol
//! controller.

mod filters;
mod mailbox;
mod receive;
mod registers;
mod station;
mod variant;

pub use variant::{Acknowledge, CanVariant, TransmitLock};

use super::{
    Clock, Controller, Event, Frame, Mode as BusMode, Note, Peripheral, Station, stream::Level,
};
use crate::Time;
use filters::Filters;
use mailbox::Mailboxes;
use receive::Fifo;
use registers::*;
use variant::Behaviour;

/// Interrupt lines (RM0090 32.8): a transmission request has completed; FIFO 0 has a message, is full or has overrun;
/// the same for FIFO 1; error, wake-up or entry to sleep mode.
pub const TX: u8 = 1 << 0;
pub const RX0: u8 = 1 << 1;
pub const RX1: u8 = 1 << 2;
pub const SCE: u8 = 1 << 3;

/// The mode shown by INAK and SLAK (RM0090 32.4).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    Sleep,
    Initialization,
    Normal,
}

/// The place of a controller among those of the chip, which decides on its filters (RM0090 32.2, RM0430 32.2).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// CAN1, which has the registers of the 28 filter banks.
    Master,
    /// CAN2, which uses those banks of CAN1 that CAN1's CAN2SB gives it, and has no filter registers.
    Slave,
    /// CAN3, with 14 banks of its own.
    Single,
}

#[derive(Debug)]
pub struct Bxcan {
    role: Role,
    controller: Controller,
    mode: Mode,
    /// The time at which INAK is set, in initialisation mode.
    inak_from: Time,
    /// Start of the counter of bit times.
    counts_from: Time,
    mcr: u32,
    /// ERRI, WKUI and SLAKI.
    latched: u32,
    ier: u32,
    lec: u32,
    /// EWGF, EPVF and BOFF at the previous check, to detect rising flags.
    error_flags: u32,
    btr: u32,
    mailboxes: Mailboxes,
    fifos: [Fifo; 2],
    filters: Filters,
    notes: Vec<(Time, Note)>,
    irq: u8,
    behaviour: Behaviour,
}

impl Bxcan {
    /// A peripheral after reset, in sleep mode, on a clock of 16 MHz.
    pub fn new(role: Role) -> Self {
        let clock = Clock { hz: 16_000_000, ppm: 0 };
        let mut bxcan = Self {
            role,
            controller: Controller::new(clock, bit_timing(BTR_RESET_VALUE)),
            mode: Mode::Sleep,
            inak_from: Time::ZERO,
            counts_from: Time::ZERO,
            mcr: MCR_RESET_VALUE,
            latched: 0,
            ier: 0,
            lec: 0,
            error_flags: 0,
            btr: BTR_RESET_VALUE,
            mailboxes: Mailboxes::default(),
            fifos: Default::default(),
            filters: Filters::new(role),
            notes: Vec::new(),
            irq: 0,
            behaviour: Behaviour::default(),
        };
        bxcan.controller.watch(true);
        bxcan
    }

    /// Takes the filters over that CAN1 has for CAN2.
    pub fn share_filters(&mut self, can1: &Self) {
        self.filters = can1.filters.used_as(self.role);
    }

    fn write_register(&mut self, offset: u32, value: u32, now: Time) -> bool {
        match offset {
            MCR => return self.write_mcr(value, now),
            MSR => {
                self.latched &= !value;
                self.latch_errors(false);
            }
            TSR => {
                let aborted = self.mailboxes.write_tsr(value, self.has_chosen());
                self.note_aborted(aborted, now);
                self.offer();
            }
            RF0R => self.fifos[0].write_rfr(value, self.release_at(now)),
            RF1R => self.fifos[1].write_rfr(value, self.release_at(now)),
            IER => {
                self.ier = value & IER_WRITABLE;
                return value & !IER_WRITABLE == 0;
            }
            ESR => self.lec = value & ESR_LEC,
            BTR => return self.write_btr(value, now),
            TRANSMIT_MAILBOXES..RECEIVE_MAILBOXES => {
                let (mailbox, word) = place(offset - TRANSMIT_MAILBOXES);
                if let Some(frame) = self.mailboxes.write(mailbox, word, value, now) {
                    self.notes.push((now, Note::Requested { mailbox, frame }));
                    self.offer();
                }
                return word != 1 || value & TDTR_TGT == 0;
            }
            FILTERS.. if self.role != Role::Slave => {
                return self.filters.write(offset - FILTERS, value);
            }
            _ => return false,
        }
        true
    }

    /// The time at which a frame that is released now leaves its FIFO.
    fn release_at(&self, now: Time) -> Time {
        let cycles = if self.behaviour.variant.late_release { 2 } else { 0 };
        now + Time::from_ps(cycles * 1_000_000_000_000 / u64::from(self.controller.clock().hz))
    }

    fn note_aborted(&mut self, frames: [Option<Frame>; 3], now: Time) {
        let frames = frames.into_iter().enumerate();
        let aborted = frames.filter_map(|(mailbox, frame)| Some((mailbox, frame?)));
        self.notes.extend(aborted.map(|(mailbox, frame)| (now, Note::Aborted { mailbox, frame })));
    }

    /// Whether INAK is set.
    fn is_initialized(&self, now: Time) -> bool {
        self.mode == Mode::Initialization && self.inak_from <= now
    }

    fn msr(&self, now: Time) -> u32 {
        u32::from(self.is_initialized(now))
            | u32::from(self.mode == Mode::Sleep) << 1
            | self.latched
            | u32::from(self.controller.is_transmitting()) << 8
            | u32::from(self.controller.is_receiving()) << 9
            | u32::from(self.controller.sampled_level() == Level::Recessive) << 10
            | u32::from(self.controller.wire_level() == Level::Recessive) << 11
    }

    fn esr(&self) -> u32 {
        let counters = self.controller.counters();
        // Captured from a chip in bus-off (confidence 0.8); the counter has nine bits.
        let in_bus_off = counters.bus_off() && !self.behaviour.variant.bus_off_tec_overflows;
        let tec = if in_bus_off { BUS_OFF_TEC } else { counters.transmit & 0xFF };
        self.flags() | self.lec | u32::from(tec) << 16 | u32::from(counters.receive) << 24
    }

    fn flags(&self) -> u32 {
        let counters = self.controller.counters();
        let flag = |bit, set: bool| if set { bit } else { 0 };
        flag(ESR_EWGF, counters.warning())
            | flag(ESR_EPVF, counters.passive())
            | flag(ESR_BOFF, counters.bus_off())
    }

    fn write_mcr(&mut self, value: u32, now: Time) -> bool {
        if value & MCR_RESET != 0 {
            // The error counters and the other registers keep their values (confidence 0.85).
            self.mcr = MCR_RESET_VALUE;
            self.fifos.iter_mut().for_each(Fifo::clear);
            self.follow_request(now);
            return true;
        }
        self.mcr = value & MCR_WRITABLE;
        if self.mcr & MCR_ABOM != 0 && self.mode == Mode::Normal {
            self.controller.recover(now);
        }
        self.follow_request(now);
        self.offer();
        value & !MCR_WRITABLE == 0
    }

    fn write_btr(&mut self, value: u32, now: Time) -> bool {
        if self.is_initialized(now) && self.controller.is_stopped() {
            let before = std::mem::replace(&mut self.btr, value & BTR_WRITABLE);
            let mode = BusMode { silent: value >> 31 == 1, loopback: value >> 30 & 1 == 1 };
            self.controller.configure(bit_timing(self.btr), mode);
            if self.btr != before {
                self.notes.push((now, Note::BitTiming(self.btr)));
            }
        }
        value & !BTR_WRITABLE == 0
    }

    /// Enters the mode that MCR requests, as far as the bus allows at this time.
    fn follow_request(&mut self, now: Time) {
        let requested = match self.mcr & (MCR_INRQ | MCR_SLEEP) {
            0 => Mode::Normal,
            MCR_SLEEP => Mode::Sleep,
            _ => Mode::Initialization,
        };
        if requested == Mode::Normal {
            if self.mode == Mode::Initialization {
                self.behaviour.start(self.controller.mode().silent);
            }
            self.controller.start(now);
        } else {
            self.controller.stop();
            self.controller.watch(requested == Mode::Sleep);
        }
        let reached = match requested {
            Mode::Normal => self.controller.is_joined(),
            Mode::Initialization | Mode::Sleep => self.controller.is_stopped(),
        };
        if !reached || requested == self.mode {
            return;
        }
        match (self.mode, requested) {
            (_, Mode::Initialization) => {
                self.inak_from = self.behaviour.initialize(now, self.controller.bit_time());
                if self.inak_from < Time::MAX {
                    self.notes.push((self.inak_from, Note::InitializationEntered));
                }
            }
            (Mode::Initialization, _) if self.is_initialized(now) => {
                self.notes.push((now, Note::InitializationLeft));
            }
            _ => {}
        }
        if requested == Mode::Normal {
            self.counts_from = now;
        }
        self.mode = requested;
        self.latched &= !MSR_SLAKI;
        if requested == Mode::Sleep && self.ier & IER_SLKIE != 0 {
            self.latched |= MSR_SLAKI;
        }
    }
}

impl Peripheral for Bxcan {
    fn set_variant(&mut self, variant: CanVariant) {
        self.behaviour = Behaviour::new(variant);
    }

    fn reset(&mut self) {
        let old = std::mem::replace(self, Self::new(self.role));
        self.controller = old.controller;
        self.controller.reset();
        self.controller.configure(bit_timing(BTR_RESET_VALUE), BusMode::default());
        self.controller.watch(true);
        if self.role == Role::Slave {
            self.filters = old.filters;
        }
        self.notes = old.notes;
        self.behaviour = old.behaviour;
        self.behaviour.reset();
    }

    fn set_clock(&mut self, clock: Clock) {
        self.controller.set_clock(clock);
    }

    fn irq(&self) -> u8 {
        self.irq
    }

    fn interrupts(&self) -> u8 {
        let enabled = |bit, flag| self.ier & bit != 0 && flag;
        let change = enabled(IER_ERRIE, self.latched & MSR_ERRI != 0)
            || enabled(IER_WKUIE, self.latched & MSR_WKUI != 0)
            || enabled(IER_SLKIE, self.latched & MSR_SLAKI != 0);
        [
            (TX, enabled(IER_TMEIE, self.mailboxes.any_completed())),
            (RX0, self.fifos[0].irq(self.ier >> IER_FIFO_0)),
            (RX1, self.fifos[1].irq(self.ier >> IER_FIFO_1)),
            (SCE, change),
        ]
        .into_iter()
        .fold(0, |lines, (line, is_high)| lines | if is_high { line } else { 0 })
    }

    fn update_irq(&mut self) {
        self.irq = self.interrupts();
    }

    /// Whether it is neither asleep nor about to be.
    fn is_in_use(&self) -> bool {
        self.mode != Mode::Sleep || self.mcr & (MCR_SLEEP | MCR_INRQ) != MCR_SLEEP
    }

    fn bit_rate(&self) -> u32 {
        self.controller.bit_rate()
    }

    fn is_silent(&self) -> bool {
        self.controller.mode().silent
    }

    fn is_start(&self, offset: u32, value: u32) -> bool {
        offset == MCR && value & (MCR_INRQ | MCR_SLEEP) == 0
    }

    fn read(&self, offset: u32, now: Time) -> Option<u32> {
        Some(match offset {
            MCR => self.mcr,
            MSR => self.msr(now),
            TSR => self.mailboxes.tsr(self.mcr & MCR_TXFP != 0),
            RF0R => self.fifos[0].rfr(now),
            RF1R => self.fifos[1].rfr(now),
            IER => self.ier,
            ESR => self.esr(),
            BTR => self.btr,
            TRANSMIT_MAILBOXES..RECEIVE_MAILBOXES => {
                let (mailbox, word) = place(offset - TRANSMIT_MAILBOXES);
                self.mailboxes.read(mailbox, word)
            }
            RECEIVE_MAILBOXES..0x1D0 => {
                let (fifo, word) = place(offset - RECEIVE_MAILBOXES);
                self.fifos[fifo].read(word, now)
            }
            FILTERS.. if self.role != Role::Slave => return self.filters.read(offset - FILTERS),
            _ => return None,
        })
    }

    /// Returns false also if a reserved bit is set, or if the frame is to carry a time stamp (TGT).
    fn write(&mut self, offset: u32, value: u32, now: Time) -> bool {
        let modelled = self.write_register(offset, value, now);
        self.update_irq();
        modelled
    }

    fn take_notes(&mut self) -> Vec<(Time, Note)> {
        std::mem::take(&mut self.notes)
    }
}
