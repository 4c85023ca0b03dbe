//! The CAN controller: bit timing, filters, reception, transmission and error state.
//!
//! `bxcan` is the driver: it takes the controller over and sets the bit timing and the modes. The registers are accessed
//! directly
//!
//! - for frames, which `bxcan` copies twice on the way of an answer. It also panics on access to the data of a frame with
//!   a length code of 9 to 15, and with three full mailboxes waits until one is aborted;
//! - for what it does not offer: error interrupts and error counters, the result of a transmission, mode changes
//!   without a wait, and the filters of CAN2 without its driver of CAN1.
//!
//! Changing its configuration and dropping it both wait for a mode: the first is called in that mode, the second never.

use core::{iter, mem};

use canopen_node::{BitRate, BusEvent, Frame, Instant, Receives, indicator::BusState, lss};
use cortex_m::peripheral::SCB;
use stm32f4xx_hal::{
    pac::can1::{RegisterBlock, TX, rfr},
    rcc::Rcc,
};

use super::{
    bit_timing::BTR,
    peripheral::Peripheral,
    pins::{CanPins, TransmitPin},
    queue::TransmitQueue,
};
use crate::clock;

/// The number of CAN_MSR reads after which the controller is considered unresponsive. After a reset it enters
/// initialisation mode within a few clock cycles, or 11 of the bits that CAN_BTR then defines: 88 cycles of APB1.
const INIT_READS: u32 = 1_000;

/// The number of resets after which a controller that does not enter initialisation mode is left alone for a while.
const RESETS: u32 = 4;

/// The number of CAN_RF0R reads until a released FIFO shows its next frame: two APB1 cycles.
const RELEASE_READS: u32 = 16;

/// The time between samples of the bus level, and between an error and the next error interrupt.
const WATCH_MICROS: u32 = 1_000;

/// The COB-IDs of a filter bank in list mode (RM0090, 32.7.4).
const IDS_PER_BANK: usize = 4;
/// The bits of CAN_TSR for an empty mailbox: the first, and all three.
const FIRST_EMPTY: u32 = 1 << 26;
const ALL_EMPTY: u32 = 0b111 << 26;

/// The CAN controller, as used by the node.
pub struct Controller<C: Peripheral, const RPDOS: usize, const PRODUCERS: usize> {
    can: bxcan::Can<C::Connected>,
    /// The same registers, for functions that `bxcan` does not offer.
    registers: C,
    filters: C::Filters,
    transmit_pin: TransmitPin,
    bit_rate: BitRate,
    is_listening: bool,
    /// While listening: whether anything was heard since the last look.
    has_heard: bool,
    receives: Receives<RPDOS, PRODUCERS>,
    may_transmit: bool,
    /// Whether a frame was received, or sent and acknowledged, since the last [`look`](Self::look).
    has_understood: bool,
    /// The bus samples, while the controller may be out of sync with the bus.
    samples: Option<Samples>,
    watch_at: Option<Instant>,
    queue: TransmitQueue,
}

/// Samples of the bus level, one per millisecond, since the controller last received or sent a valid frame.
#[derive(Clone, Copy, Default)]
struct Samples {
    count: u16,
    is_recessive: bool,
    /// The number of consecutive samples with the latest level.
    equal: u16,
}

/// A result of reading the receive FIFO.
pub enum Received {
    Frame(Frame),
    /// A frame of no use to any CANopen node.
    Other,
    /// A frame was lost because the FIFO was full.
    Overrun,
}

impl<C: Peripheral, const RPDOS: usize, const PRODUCERS: usize> Controller<C, RPDOS, PRODUCERS> {
    /// The controller on its pins, set to receive the COB-IDs `receives`. It sleeps until
    /// [`set_bit_rate`](Self::set_bit_rate) or [`listen`](Self::listen).
    ///
    /// The chip is reset if the controller does not enter initialisation mode. By then `bxcan` has nothing to wait for.
    pub fn new(
        can: C,
        pins: CanPins<C>,
        rcc: &mut Rcc,
        receives: Receives<RPDOS, PRODUCERS>,
    ) -> Self {
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
            bit_rate: BitRate::Kbit10,
            is_listening: false,
            has_heard: false,
            receives,
            may_transmit: true,
            has_understood: false,
            samples: None,
            watch_at: None,
            queue: TransmitQueue::new(),
        }
    }

    /// Runs at `bit_rate` and receives these frames from now on; pending frames are lost.
    pub fn set_bit_rate(&mut self, bit_rate: BitRate, receives: Receives<RPDOS, PRODUCERS>) {
        self.queue.clear();
        self.receives = receives;
        self.bit_rate = bit_rate;
        self.is_listening = false;
        self.start();
    }

    /// Receives everything at `bit_rate`, but sends no dominant bit (silent mode, RM0090, 32.5.1). The controllers of
    /// some chips nevertheless drive the transmit line dominant in this mode, so the controller does not get the pin.
    pub fn listen(&mut self, bit_rate: BitRate, receives: Receives<RPDOS, PRODUCERS>) {
        self.stop_transmitting();
        self.receives = receives;
        self.bit_rate = bit_rate;
        self.is_listening = true;
        self.start();
    }

    /// Sets the frames to receive.
    pub fn set_receives(&mut self, receives: Receives<RPDOS, PRODUCERS>) {
        self.receives = receives;
        self.set_filters();
    }

    /// Resets the controller and sets it up, the only way to another bit rate without a wait. The controller joins the
    /// bus by itself after 11 recessive bits (RM0090, 32.4.2).
    fn start(&mut self) {
        self.sample();
        // A controller that is reset while it has the pin may leave it dominant.
        self.transmit_pin.rest();
        if !enter_initialization(&self.registers) {
            return;
        }
        let btr = BTR[usize::from(self.bit_rate.index())];
        // Its `drop` would wait for sleep mode without limit.
        mem::forget(self.can.modify_config().set_silent(self.is_listening).set_bit_timing(btr));
        self.set_filters();
        self.registers.ier().write(|w| {
            w.fmpie0().set_bit().tmeie().set_bit();
            w.errie().set_bit().epvie().set_bit().bofie().set_bit().lecie().set_bit()
        });
        if !self.is_listening {
            self.transmit_pin.connect();
        }
        self.registers.mcr().write(|w| w.sleep().clear_bit().inrq().clear_bit().abom().set_bit());
    }

    /// Retries a failed [`start`](Self::start), and resets a listener that receives nothing on a dominant bus. Must be
    /// called a few times a second.
    pub fn supervise(&mut self) {
        let can = &self.registers;
        let is_bus_dominant = can.msr().read().rx().bit_is_clear();
        let is_deaf = self.is_listening && is_bus_dominant && !self.has_heard;
        self.has_heard = false;
        if is_deaf || can.mcr().read().inrq().bit_is_set() {
            self.start();
        }
    }

    /// Lets the frames that the node receives pass to FIFO 0.
    fn set_filters(&mut self) {
        let Receives { all, services, rpdos, heartbeats } = &self.receives;
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

    /// Whether the controller only listens.
    pub fn is_listening(&self) -> bool {
        self.is_listening
    }

    /// The next frame from the receive FIFO, or a loss of frames.
    pub fn receive(&mut self) -> Option<Received> {
        let received = read_fifo(&self.registers)?;
        self.has_heard = true;
        self.has_understood = true;
        self.samples = None;
        Some(received)
    }

    /// Sends `frame` as soon as the bus allows it, unless transmitting is stopped.
    #[inline(always)] // The way of an answer: 20 cycles.
    pub fn transmit(&mut self, frame: Frame) {
        if !self.may_transmit {
            return;
        }
        if self.queue.is_empty() && are_mailboxes_empty(&self.registers) {
            write_mailbox(self.registers.tx(0), &frame);
        } else {
            self.transmit_beside_others(frame);
        }
    }

    /// Sends a frame while others are pending.
    fn transmit_beside_others(&mut self, frame: Frame) {
        if self.queue.is_behind(&frame) && put_in_mailbox(&self.registers, &frame) {
            return;
        }
        if !self.queue.push(frame) {
            defmt::warn!(
                "CAN: the transmit queue is full, frame {=u16:#x} was dropped",
                frame.cob_id()
            );
        }
    }

    /// Handles empty mailboxes; returns whether a frame was sent and acknowledged.
    pub fn handle_transmitted(&mut self) -> bool {
        const COMPLETED: u32 = 1 << 0 | 1 << 8 | 1 << 16;
        const ANY_SENT: u32 = 1 << 1 | 1 << 9 | 1 << 17;
        let status = self.registers.tsr().read().bits();
        // Only the flags read above: a later completion interrupts again.
        // SAFETY: zeros have no effect in this register.
        self.registers.tsr().write(|w| unsafe { w.bits(status & COMPLETED) });
        // The others are less urgent, and wait until it is sent.
        self.queue.pop_if(|frame| put_in_mailbox(&self.registers, frame));
        status & ANY_SENT != 0
    }

    /// Whether no frame waits for the bus.
    pub fn has_sent_all(&self) -> bool {
        self.queue.is_empty() && are_mailboxes_empty(&self.registers)
    }

    /// Sends nothing until [`resume_transmitting`](Self::resume_transmitting), except a frame that is on the bus now.
    pub fn stop_transmitting(&mut self) {
        const ABORT_ALL: u32 = 1 << 7 | 1 << 15 | 1 << 23;
        self.may_transmit = false;
        self.queue.clear();
        // SAFETY: zeros have no effect in this register.
        self.registers.tsr().write(|w| unsafe { w.bits(ABORT_ALL) });
    }

    /// Drops the pending frames with these COB-IDs; a frame on the bus now continues.
    pub fn drop_frames(&mut self, are_dropped: impl Fn(u16) -> bool) {
        const ABORT: u32 = 1 << 7;
        self.queue.drop_frames(&are_dropped);
        let mut aborts = 0;
        for mailbox in 0..3 {
            if are_dropped(self.registers.tx(mailbox).tir().read().stid().bits()) {
                aborts |= ABORT << (8 * mailbox);
            }
        }
        // SAFETY: zeros, and the abort of an empty mailbox, have no effect in this register.
        self.registers.tsr().write(|w| unsafe { w.bits(aborts) });
    }

    /// Ends [`stop_transmitting`](Self::stop_transmitting).
    pub fn resume_transmitting(&mut self) {
        self.may_transmit = true;
    }

    /// Acknowledges a status interrupt; returns the latest error (last error code, RM0090, 32.9.2) if it concerns the
    /// bit-rate supervision.
    pub fn handle_status(&mut self) -> Option<BusEvent> {
        const NO_ERROR: u8 = 0;
        const STUFF: u8 = 1;
        const FORM: u8 = 2;
        const BIT_RECESSIVE: u8 = 4;
        const CRC: u8 = 6;
        const SET_BY_SOFTWARE: u8 = 7;
        let can = &self.registers;
        let status = can.esr().read();
        // SAFETY: the value that software sets to detect the next error.
        can.esr().write(|w| unsafe { w.lec().bits(SET_BY_SOFTWARE) });
        let last_error = status.lec().bits();
        let is_error = !matches!(last_error, NO_ERROR | SET_BY_SOFTWARE);
        let error = match last_error {
            STUFF | BIT_RECESSIVE | CRC => Some(BusEvent::Error),
            FORM => Some(BusEvent::FormError),
            _ => None,
        };
        can.ier().modify(|_, w| {
            // Bus-off is reported once, although the interrupt persists.
            w.bofie().bit(status.boff().bit_is_clear());
            // There may be tens of thousands of errors a second. Only a search needs each of them, and a proven rate none.
            w.lecie().bit(self.is_listening || self.receives.all && !is_error)
        });
        can.msr().write(|w| w.erri().set_bit());
        if is_error {
            self.sample();
        }
        self.has_heard |= error.is_some();
        error
    }

    /// Starts sampling the bus, unless the bit rate is proven.
    #[inline(never)] // It has several callers: 36 bytes.
    fn sample(&mut self) {
        if !self.receives.all {
            return;
        }
        self.samples = Some(Samples::default());
        self.watch_at.get_or_insert(clock::now().plus_micros(WATCH_MICROS));
    }

    /// Starts sampling if the bus is dominant and no valid frame came since the last call. Must be called a few times a
    /// second.
    pub fn look(&mut self) {
        let has_understood = mem::take(&mut self.has_understood);
        let is_dominant = self.registers.msr().read().rx().bit_is_clear();
        if is_dominant && !has_understood && self.samples.is_none() {
            self.sample();
        }
    }

    /// The time at which [`watch`](Self::watch) has something to do.
    pub fn watch_at(&self) -> Option<Instant> {
        self.watch_at
    }

    /// Enables the next error interrupt, samples the bus and returns an event that no interrupt reports, if the time
    /// has come.
    ///
    /// Sampling lasts from a start, an error or a [`look`](Self::look) until a valid frame, or until the bus is idle.
    pub fn watch(&mut self, now: Instant) -> Option<BusEvent> {
        self.watch_at.take_if(|end| end.has_come(now))?;
        self.registers.ier().modify(|_, w| w.lecie().set_bit());
        let event = self.take_sample();
        self.watch_at = self.samples.is_some().then(|| now.plus_micros(WATCH_MICROS));
        event
    }

    /// Reports a bus that is dominant for longer than the recessive bits of any frame are apart. Also reports traffic
    /// for more than two frame times in which the controller finds neither a frame nor an error. A controller that
    /// waits for a number of equal bits, to join the bus or to end an error flag, may wait for ever at a wrong rate.
    fn take_sample(&mut self) -> Option<BusEvent> {
        /// After a frame at 10 kbit/s the bus is recessive for at least a millisecond.
        const LONGEST_FRAME: u16 = 16;
        const TWO_FRAMES_BITS: u16 = 2 * 135;
        let samples = self.samples.as_mut()?;
        let status = self.registers.msr().read();
        let is_recessive = status.rx().bit_is_set();
        if samples.is_recessive != is_recessive {
            (samples.is_recessive, samples.equal) = (is_recessive, 0);
        }
        samples.equal = samples.equal.saturating_add(1);
        samples.count = samples.count.saturating_add(1);
        if samples.equal >= LONGEST_FRAME {
            samples.count = 0;
            if !is_recessive {
                return Some(BusEvent::HeldDominant);
            }
            self.samples = None;
            return None;
        }
        if status.txm().bit_is_set() {
            samples.count = 0;
        }
        let most = LONGEST_FRAME + 2 + TWO_FRAMES_BITS / self.bit_rate.kbit_per_s();
        if samples.count <= most {
            return None;
        }
        samples.count = 0;
        Some(BusEvent::Error)
    }

    /// TEC and REC (RM0090, 32.7.6).
    pub fn error_counters(&self) -> (u8, u8) {
        let status = self.registers.esr().read();
        (status.tec().bits(), status.rec().bits())
    }

    /// The controller's fault confinement state (RM0090, 32.7.6).
    pub fn bus_state(&self) -> BusState {
        let status = self.registers.esr().read();
        match (status.boff().bit_is_set(), status.ewgf().bit_is_set()) {
            (true, _) => BusState::BusOff,
            (_, true) => BusState::Warning,
            _ => BusState::Good,
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
    Some(frame.map_or(Received::Other, Received::Frame))
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

/// Passes a frame to the controller if there is an empty mailbox and all others have less urgent frames; returns
/// whether it does. Of two frames with one COB-ID the controller might not send the older one first (RM0090, 32.7.1).
fn put_in_mailbox(can: &RegisterBlock, frame: &Frame) -> bool {
    let status = can.tsr().read().bits();
    if status & ALL_EMPTY == ALL_EMPTY {
        write_mailbox(can.tx(0), frame);
        return true;
    }
    let mut empty = None;
    for (at, mailbox) in can.tx_iter().enumerate() {
        if status & FIRST_EMPTY << at != 0 {
            empty = Some(mailbox);
        } else if mailbox.tir().read().stid().bits() <= frame.cob_id() {
            return false;
        }
    }
    if let Some(mailbox) = empty {
        write_mailbox(mailbox, frame);
    }
    empty.is_some()
}

fn are_mailboxes_empty(can: &RegisterBlock) -> bool {
    can.tsr().read().bits() & ALL_EMPTY == ALL_EMPTY
}

/// Requests the transmission of a frame by an empty mailbox.
fn write_mailbox(mailbox: &TX, frame: &Frame) {
    let data = u64::from_le_bytes(frame.padded_data());
    // SAFETY: a `Frame` has at most eight bytes of data and an identifier of 11 bits; data may be anything.
    unsafe {
        mailbox.tdtr().write(|w| w.dlc().bits(frame.data().len() as u8));
        mailbox.tdlr().write(|w| w.bits(data as u32));
        mailbox.tdhr().write(|w| w.bits((data >> 32) as u32));
        mailbox.tir().write(|w| w.stid().bits(frame.cob_id()).txrq().set_bit());
    }
}
