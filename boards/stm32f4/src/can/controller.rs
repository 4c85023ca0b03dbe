//! The CAN controller: bit timing, filters, reception, transmission and error state.
//!
//! `bxcan` is the driver: it takes the controller over and sets the bit timing and the modes. The registers are
//! accessed directly
//!
//! - for frames, which `bxcan` copies twice on the way of an answer. It also panics on access to the data of a frame
//!   with a length code of 9 to 15, and with three full mailboxes waits until one is aborted;
//! - for what it does not offer: error interrupts and error counters, the result of a transmission, mode changes
//!   without a wait, and the filters of CAN2 without its driver of CAN1.
//!
//! Changing its configuration and dropping it both wait for a mode: the first is called in that mode, the second never.

use core::{iter, mem};

use canopen_node::{
    BitRate, Frame, Numbers, Receives, Service, Services,
    indicator::BusState,
    lss,
    runner::{self, BusError, Mode, Received, Sample},
};
use cortex_m::peripheral::SCB;
use stm32f4xx_hal::{
    pac::can1::{RegisterBlock, rfr},
    rcc::Rcc,
};

use super::{
    bit_timing::BTR,
    peripheral::Peripheral,
    pins::{CanPins, TransmitPin},
};
use crate::task::Task;

/// The number of CAN_MSR reads after which the controller is considered unresponsive. After a reset it enters
/// initialisation mode within a few clock cycles, or 11 of the bits that CAN_BTR then defines: 88 cycles of APB1.
const INIT_READS: u32 = 1_000;

/// The number of resets after which a controller that does not enter initialisation mode is left alone for a while.
const RESETS: u32 = 4;

/// The number of CAN_RF0R reads until a released FIFO shows its next frame: two APB1 cycles.
const RELEASE_READS: u32 = 16;

/// The COB-IDs of a filter bank in list mode (RM0090, 32.7.4).
const IDS_PER_BANK: usize = 4;
/// The bits of CAN_TSR for empty mailboxes: the first, and all three.
const EMPTY: u32 = 26;
const ALL_EMPTY: u32 = 0b111 << EMPTY;
/// Those for completed requests: of the first mailbox, and of all three.
const FIRST_COMPLETED: u32 = 1 << 0;
const COMPLETED: u32 = FIRST_COMPLETED | FIRST_COMPLETED << 8 | FIRST_COMPLETED << 16;
/// That for a frame of the first mailbox that was acknowledged.
const FIRST_ACKNOWLEDGED: u32 = 1 << 1;

/// The CAN controller, as used by the node.
pub struct Controller<C: Peripheral> {
    can: bxcan::Can<C::Connected>,
    /// The same registers, for functions that `bxcan` does not offer.
    registers: C,
    filters: C::Filters,
    transmit_pin: TransmitPin,
    /// The service of the latest frame in each mailbox.
    mailboxes: [Services; 3],
    /// Those whose frames were acknowledged, until somebody asks.
    sent: Services,
    is_listening: bool,
    /// Whether all frames are received, since the bit rate is not proven.
    receives_all: bool,
}

impl<C: Peripheral> Controller<C> {
    /// The controller on its pins. It sleeps until it is [started](runner::Controller::start).
    ///
    /// The chip is reset if the controller does not enter initialisation mode. By then `bxcan` has nothing to wait for.
    pub fn new(can: C, pins: CanPins<C>, rcc: &mut Rcc) -> Self {
        let can = can.connect(pins.receive, rcc);
        // SAFETY: the new value owns all handles, and `bxcan` keeps no copy of the registers.
        let (registers, filters) = unsafe { C::steal() };
        if !enter_initialization(&registers) {
            SCB::sys_reset();
        }
        Self {
            can: C::driver(can),
            registers,
            filters,
            transmit_pin: pins.transmit,
            mailboxes: [Services::NONE; 3],
            sent: Services::NONE,
            is_listening: false,
            receives_all: true,
        }
    }
}

impl<C: Peripheral> runner::Controller for Controller<C> {
    /// Resets the controller and sets it up, the only way to another bit rate without a wait. The controller joins the
    /// bus by itself after 11 recessive bits (RM0090, 32.4.2).
    ///
    /// The controllers of some chips drive the transmit line dominant in silent mode (RM0090, 32.5.1), so a listener
    /// does not get the pin.
    fn start<N: Numbers>(&mut self, mode: Mode, bit_rate: BitRate, receives: &Receives<N>) -> bool {
        self.is_listening = mode == Mode::Listen;
        self.receives_all = receives.all;
        (self.mailboxes, self.sent) = ([Services::NONE; 3], Services::NONE);
        // A controller that is reset while it has the pin may leave it dominant.
        self.transmit_pin.rest();
        if !enter_initialization(&self.registers) {
            return false;
        }
        let btr = BTR[usize::from(bit_rate.index())];
        // Its `drop` would wait for sleep mode without limit.
        mem::forget(self.can.modify_config().set_silent(self.is_listening).set_bit_timing(btr));
        self.set_receives(receives);
        self.registers.ier().write(|w| {
            w.fmpie0().set_bit().tmeie().set_bit();
            w.errie().set_bit().epvie().set_bit().bofie().set_bit().lecie().set_bit()
        });
        if !self.is_listening {
            self.transmit_pin.connect();
        }
        self.registers.mcr().write(|w| w.sleep().clear_bit().inrq().clear_bit().abom().set_bit());
        true
    }

    /// Lets the frames that the node receives pass to FIFO 0.
    fn set_receives<N: Numbers>(&mut self, receives: &Receives<N>) {
        let Receives { all, services, rpdos, heartbeats } = receives;
        self.receives_all = *all;
        let (rpdos, heartbeats) = (rpdos.as_ref(), heartbeats.as_ref());
        let others = rpdos.chunks(IDS_PER_BANK).chain(heartbeats.chunks(IDS_PER_BANK));
        let lists = iter::once(services.as_slice()).chain(others);

        let filters = &self.filters;
        filters.fmr().modify(|_, w| w.finit().set_bit());
        // At most nine of the controller's 14 banks.
        let mut banks = filters.fb_iter().skip(C::FIRST_BANK);
        let mut next = 1_u32 << C::FIRST_BANK;
        if *all {
            // A mask of zeros.
            banks.next().into_iter().for_each(|bank| {
                bank.fr1().reset();
                bank.fr2().reset();
            });
            next = next.wrapping_shl(1);
        } else {
            for (ids, bank) in lists.zip(banks) {
                let entry =
                    |at| u32::from(ids.get(at).copied().unwrap_or(lss::REQUEST_COB_ID)) << 5;
                // SAFETY: the identifiers of data frames, two in each register.
                bank.fr1().write(|w| unsafe { w.bits(entry(1) << 16 | entry(0)) });
                // SAFETY: as above.
                bank.fr2().write(|w| unsafe { w.bits(entry(3) << 16 | entry(2)) });
                next = next.wrapping_shl(1);
            }
        }
        let used = next.wrapping_sub(1 << C::FIRST_BANK);
        // SAFETY: each register has a bit for each bank. All banks are this firmware's own.
        unsafe {
            filters.fm1r().write(|w| w.bits(if *all { 0 } else { used }));
            filters.ffa1r().write(|w| w.bits(0));
            filters.fa1r().write(|w| w.bits(used));
        }
        filters.fmr().modify(|_, w| w.finit().clear_bit());
    }

    /// The answer to the roll call of the task that receives.
    fn receive(&mut self) -> Option<Received> {
        Task::RECEIVED.answer();
        read_fifo(&self.registers)
    }

    #[inline(always)] // The way of an answer: 20 cycles.
    fn send(&mut self, frame: &Frame, service: Service) -> bool {
        let status = self.registers.tsr().read().bits();
        if status & (ALL_EMPTY | COMPLETED) == ALL_EMPTY {
            self.write_mailbox(0, frame, service);
            return true;
        }
        self.send_beside_others(frame, service, status)
    }

    fn take_sent(&mut self) -> Services {
        Task::TRANSMITTED.answer();
        self.collect_sent(self.registers.tsr().read().bits());
        mem::replace(&mut self.sent, Services::NONE)
    }

    fn supervise(&mut self) {
        self.transmit_pin.assert_mode();
    }

    fn is_idle(&mut self) -> bool {
        self.registers.tsr().read().bits() & ALL_EMPTY == ALL_EMPTY
    }

    fn drop_frames(&mut self, services: Services) {
        const ABORT: u32 = 1 << 7;
        let mut aborts = 0;
        for (at, mailbox) in self.mailboxes.iter().enumerate() {
            if mailbox.has_any(services) {
                aborts |= ABORT << (8 * at);
            }
        }
        // SAFETY: zeros, and the abort of an empty mailbox, have no effect in this register.
        self.registers.tsr().write(|w| unsafe { w.bits(aborts) });
    }

    /// Acknowledges a status interrupt; returns the last error code (RM0090, 32.9.2).
    fn take_error(&mut self) -> Option<BusError> {
        Task::STATUS.answer();
        const SET_BY_SOFTWARE: u8 = 7;
        let can = &self.registers;
        let status = can.esr().read();
        // SAFETY: the value that software sets to detect the next error.
        can.esr().write(|w| unsafe { w.lec().bits(SET_BY_SOFTWARE) });
        let error = BusError::from_code(status.lec().bits());
        can.ier().modify(|_, w| {
            // Bus-off is reported once, although the interrupt persists.
            w.bofie().bit(status.boff().bit_is_clear());
            // There may be tens of thousands of errors a second. Only a search needs each of them, and a proven rate
            // none.
            w.lecie().bit(self.is_listening || self.receives_all && error.is_none())
        });
        can.msr().write(|w| w.erri().set_bit());
        error
    }

    /// TEC and REC (RM0090, 32.7.6).
    fn error_counters(&self) -> (u8, u8) {
        let status = self.registers.esr().read();
        (status.tec().bits(), status.rec().bits())
    }

    /// The controller's fault confinement state (RM0090, 32.7.6).
    fn bus_state(&self) -> BusState {
        let status = self.registers.esr().read();
        match (status.boff().bit_is_set(), status.ewgf().bit_is_set()) {
            (true, _) => BusState::BusOff,
            (_, true) => BusState::Warning,
            _ => BusState::Good,
        }
    }

    fn sample(&self) -> Option<Sample> {
        let status = self.registers.msr().read();
        Some(Sample {
            is_recessive: status.rx().bit_is_set(),
            is_transmitting: status.txm().bit_is_set(),
        })
    }

    fn report_errors(&mut self) {
        self.registers.ier().modify(|_, w| w.lecie().set_bit());
    }
}

impl<C: Peripheral> Controller<C> {
    /// Notes the services of the frames that were acknowledged by this state of CAN_TSR. A request of transmission clears
    /// the flags of its mailbox (RM0090, 32.9.2), so that this comes before each that finds a flag set.
    fn collect_sent(&mut self, status: u32) {
        for (at, mailbox) in self.mailboxes.iter().enumerate() {
            let is_acknowledged = status & FIRST_ACKNOWLEDGED << (8 * at) != 0;
            self.sent = self.sent.and(if is_acknowledged { *mailbox } else { Services::NONE });
        }
        // Only the flags read above: a later completion interrupts again.
        // SAFETY: zeros have no effect in this register.
        self.registers.tsr().write(|w| unsafe { w.bits(status & COMPLETED) });
    }

    /// Passes a frame to the controller if it has two empty mailboxes, or one and only less urgent frames; returns whether it
    /// does. Of two frames with one COB-ID the controller might not send the older one first (RM0090, 32.7.1).
    ///
    /// The mailboxes are those of `status`, of CAN_TSR: one that becomes empty later has an acknowledge to collect.
    #[inline(never)] // A settled node is mostly idle.
    fn send_beside_others(&mut self, frame: &Frame, service: Service, status: u32) -> bool {
        if status & COMPLETED != 0 {
            self.collect_sent(status);
        }
        let pending = |at| self.registers.tx(at).tir().read().stid().bits();
        let is_before = |at, other| frame.cob_id() < pending(at) && frame.cob_id() < pending(other);
        // A bit for each empty mailbox, the first in bit 0. A match is quicker than a loop: docs/size-and-speed.md.
        let (mailbox, may_be_sent) = match status >> EMPTY & 0b111 {
            0b111 => (0, true),
            0b110 => (1, frame.cob_id() != pending(0)),
            0b101 => (0, frame.cob_id() != pending(1)),
            0b011 => (0, frame.cob_id() != pending(2)),
            0b100 => (2, is_before(0, 1)),
            0b010 => (1, is_before(0, 2)),
            0b001 => (0, is_before(1, 2)),
            _ => (0, false),
        };
        if may_be_sent {
            self.write_mailbox(mailbox, frame, service);
        }
        may_be_sent
    }

    /// Requests the transmission of a frame by an empty mailbox.
    #[inline(always)] // The way of an answer.
    fn write_mailbox(&mut self, at: usize, frame: &Frame, service: Service) {
        if let Some(mailbox) = self.mailboxes.get_mut(at) {
            *mailbox = Services::of(service);
        }
        let mailbox = self.registers.tx(at);
        let data = u64::from_le_bytes(frame.padded_data());
        // SAFETY: a `Frame` has at most eight bytes of data and an identifier of 11 bits; data may be anything.
        unsafe {
            mailbox.tdtr().write(|w| w.dlc().bits(frame.data().len() as u8));
            mailbox.tdlr().write(|w| w.bits(data as u32));
            mailbox.tdhr().write(|w| w.bits((data >> 32) as u32));
            mailbox.tir().write(|w| w.stid().bits(frame.cob_id()).txrq().set_bit());
        }
    }
}

/// Resets the controller, repeatedly if necessary; returns whether it enters initialisation mode.
fn enter_initialization<C: Peripheral>(can: &C) -> bool {
    let is_there = (0..RESETS).any(|_| {
        // SAFETY: the controller's reset bit in RCC belongs to its owner.
        unsafe { C::reset_unchecked() };
        can.mcr().write(|w| w.sleep().clear_bit().inrq().set_bit());
        (0..INIT_READS).any(|_| can.msr().read().inak().bit_is_set())
    });
    if !is_there {
        defmt::error!("CAN: the controller does not enter initialisation mode, trying again later");
    }
    is_there
}

/// Takes the oldest frame out of FIFO 0, or reports a loss of frames.
fn read_fifo(can: &RegisterBlock) -> Option<Received> {
    let status = await_release(can);
    if status.fmp().bits() == 0 {
        return None;
    }
    let fifo = can.rfr(0);
    if status.fovr().bit_is_set() {
        fifo.write(|w| w.fovr().set_bit());
        return Some(Received::Overrun);
    }
    let mailbox = can.rx(0);
    let id = mailbox.rir().read();
    let len = mailbox.rdtr().read().dlc().bits();
    let [low, high] = [mailbox.rdlr().read().bits(), mailbox.rdhr().read().bits()];
    fifo.write(|w| w.rfom().set_bit());
    if id.ide().bit_is_set() || id.rtr().bit_is_set() {
        return Some(Received::Other);
    }
    let data = u64::from(high) << 32 | u64::from(low);
    // Length codes 9 to 15 are legal on the wire.
    let frame = Frame::from_padded(id.stid().bits(), len.into(), data.to_le_bytes());
    Some(frame.into())
}

/// The state of FIFO 0 when it shows no released frame any more.
fn await_release(can: &RegisterBlock) -> rfr::R {
    let fifo = can.rfr(0);
    let mut status = fifo.read();
    for _ in 0..RELEASE_READS {
        if status.rfom().bit_is_clear() {
            break;
        }
        status = fifo.read();
    }
    status
}
