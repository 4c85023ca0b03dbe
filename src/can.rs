//! The CAN controller: bit timing, filters, reception, transmission, and its place on the bus.

use bxcan::{
    Fifo, StandardId,
    filter::{BankConfig, ListEntry16, Mask16},
};
use cortex_m::peripheral::SCB;
use lss_slave::{BitRate, BusEvent, Frame, indicator::BusState};
use stm32f4xx_hal::{
    can::Can,
    gpio::{PinPull, Pull, alt::can1},
    pac::{self, CAN1, RCC},
    rcc::Reset,
};

use crate::{bit_timing::BTR, transmit_pin::TransmitPin, transmit_queue::TransmitQueue};

/// Reads of CAN_MSR after which the controller counts as not answering. Out of a reset it enters initialisation mode
/// within a few clock cycles, or 11 of the bits that CAN_BTR then makes: 88 cycles of APB1.
const INIT_READS: u32 = 1_000;

/// Resets after which a controller that does not enter initialisation mode is left alone for a while.
const RESETS: u32 = 4;

/// Reads of CAN_RF0R until a released FIFO shows its next frame: two APB1 cycles.
const RELEASE_READS: u32 = 16;

/// CAN1 as the node uses it.
pub struct Controller {
    can: bxcan::Can<Can<CAN1>>,
    transmit_pin: TransmitPin,
    bit_rate: BitRate,
    is_listening: bool,
    /// While listening: whether anything was heard since the last look.
    has_heard: bool,
    receives: [u16; 3],
    may_transmit: bool,
    traffic: Traffic,
    queue: TransmitQueue,
}

/// Traffic since the controller last understood something, as seen once a millisecond.
#[derive(Clone, Copy, Default)]
struct Traffic {
    ms: u16,
    is_recessive: bool,
    /// For how long the level has been the same.
    level_ms: u16,
}

/// What can be received or cannot.
pub enum Received {
    Frame(Frame),
    /// A frame that no CANopen node has a use for.
    Other,
    /// A frame was lost because three others waited.
    Overrun,
}

impl Controller {
    /// CAN1 on its pins, asleep until [`set_bit_rate`](Self::set_bit_rate) or [`listen`](Self::listen), and to receive the
    /// COB-IDs `receives`.
    ///
    /// A controller that does not enter initialisation mode has the chip reset. What `bxcan` waits for is there by then.
    pub fn new(
        can: CAN1,
        (transmit_pin, receive_pin): (TransmitPin, can1::Rx),
        rcc: &mut RCC,
        receives: [u16; 3],
    ) -> Self {
        let can = Can::rx(can, receive_pin.internal_resistor(Pull::Up), rcc);
        if !enter_initialization() {
            SCB::sys_reset();
        }
        Self {
            can: bxcan::Can::builder(can).leave_disabled(),
            transmit_pin,
            bit_rate: BitRate::Kbit10,
            is_listening: false,
            has_heard: false,
            receives,
            may_transmit: true,
            traffic: Traffic::default(),
            queue: TransmitQueue::new(),
        }
    }

    /// Runs at `bit_rate` from now on; whatever waited to be sent is lost.
    pub fn set_bit_rate(&mut self, bit_rate: BitRate) {
        self.queue.clear();
        self.bit_rate = bit_rate;
        self.is_listening = false;
        self.start();
    }

    /// Receives everything at `bit_rate`, but sends no dominant bit (silent mode, RM0090, 32.5.1). There are chips whose
    /// controller then drives the transmit line dominant all the same, so it is not given to it.
    pub fn listen(&mut self, bit_rate: BitRate) {
        self.stop_transmitting();
        self.bit_rate = bit_rate;
        self.is_listening = true;
        self.start();
    }

    /// Receives the COB-IDs `receives` from now on.
    pub fn set_receives(&mut self, receives: [u16; 3]) {
        self.receives = receives;
        self.set_filters();
    }

    /// Resets the controller and sets it up anew: of all ways to another bit rate the one that waits for nothing. It takes
    /// part in the bus by itself after 11 recessive bits, whenever they come (RM0090, 32.4.2).
    fn start(&mut self) {
        self.traffic = Traffic::default();
        if self.is_listening {
            self.transmit_pin.rest();
        }
        if !enter_initialization() {
            return;
        }
        let can = registers();
        // SAFETY: a value for the whole register.
        can.btr().write(|w| unsafe {
            w.bits(BTR[usize::from(self.bit_rate.index())]).silm().bit(self.is_listening)
        });
        self.set_filters();
        can.ier().write(|w| {
            w.fmpie0().set_bit().tmeie().set_bit();
            w.errie().set_bit().epvie().set_bit().bofie().set_bit().lecie().set_bit()
        });
        if !self.is_listening {
            self.transmit_pin.connect();
        }
        can.mcr().write(|w| w.sleep().clear_bit().inrq().clear_bit().abom().set_bit());
    }

    /// Tries again what [`start`](Self::start) could not do, and resets a listener that hears nothing of a dominant bus.
    /// To be called a few times a second.
    pub fn supervise(&mut self) {
        let can = registers();
        let is_bus_dominant = can.msr().read().rx().bit_is_clear();
        let is_deaf = self.is_listening && is_bus_dominant && !self.has_heard;
        self.has_heard = false;
        if is_deaf || can.mcr().read().inrq().bit_is_set() {
            self.start();
        }
    }

    /// FIFO 0 gets what the node wants. Into FIFO 1, which interrupts nobody, go the first three of all other frames, to
    /// show that there are any.
    fn set_filters(&mut self) {
        let everything = BankConfig::Mask16([Mask16::accept_all(); 2]);
        // A reset comes between listening and taking part: bank 1 is off while listening.
        let mut filters = self.can.modify_filters();
        if self.is_listening {
            filters.enable_bank(0, Fifo::Fifo0, everything);
            return;
        }
        let [first, second, third] = self.receives.map(|cob_id| {
            ListEntry16::data_frames_with_id(StandardId::new(cob_id).unwrap_or(StandardId::ZERO))
        });
        let wanted = BankConfig::List16([first, second, third, first]);
        filters.enable_bank(0, Fifo::Fifo0, wanted);
        filters.enable_bank(1, Fifo::Fifo1, everything);
    }

    /// Whether any valid frame that the node does not want has been received since the last call.
    pub fn has_heard_others(&mut self) -> bool {
        let frames = registers().rfr(1).read().fmp().bits();
        for _ in 0..frames {
            release(1);
        }
        if frames > 0 {
            self.traffic = Traffic::default();
        }
        frames > 0
    }

    /// Whether the controller only listens.
    pub fn is_listening(&self) -> bool {
        self.is_listening
    }

    /// The next frame from the receive FIFO, or that frames were lost.
    pub fn receive(&mut self) -> Option<Received> {
        let fifo = registers().rfr(0).read();
        if fifo.fmp().bits() == 0 {
            return None;
        }
        self.has_heard = true;
        self.traffic = Traffic::default();
        if fifo.fovr().bit_is_set() {
            registers().rfr(0).write(|w| w.fovr().set_bit());
            return Some(Received::Overrun);
        }
        let mailbox = registers().rx(0);
        let identifier = mailbox.rir().read();
        let len = mailbox.rdtr().read().dlc().bits().into();
        let (low, high) = (mailbox.rdlr().read().bits(), mailbox.rdhr().read().bits());
        release(0);
        if identifier.ide().bit_is_set() || identifier.rtr().bit_is_set() {
            return Some(Received::Other);
        }
        let cob_id = identifier.stid().bits();
        let data = (u64::from(high) << 32 | u64::from(low)).to_le_bytes();
        // A length code of 9..=15 is legal on the wire.
        let frame = Frame::from_padded(cob_id, len, data);
        Some(frame.map_or(Received::Other, Received::Frame))
    }

    /// Sends `frame` as soon as the bus allows it, unless transmitting is stopped.
    pub fn transmit(&mut self, frame: Frame) {
        if !self.may_transmit || self.queue.is_empty() && put_in_mailbox(&frame) {
            return;
        }
        if !self.queue.push(frame) {
            defmt::warn!("CAN: too many frames wait, {=u16:#x} is lost", frame.cob_id());
        }
        self.fill_mailboxes();
    }

    /// A mailbox has become empty; returns whether because its frame was sent and acknowledged.
    pub fn handle_transmitted(&mut self) -> bool {
        const COMPLETED: u32 = 1 << 0 | 1 << 8 | 1 << 16;
        const ANY_SENT: u32 = 1 << 1 | 1 << 9 | 1 << 17;
        let status = registers().tsr().read().bits();
        // Only what has been seen: what completes from now on interrupts again.
        // SAFETY: zeros have no effect in this register.
        registers().tsr().write(|w| unsafe { w.bits(status & COMPLETED) });
        self.fill_mailboxes();
        self.traffic = Traffic::default();
        status & ANY_SENT != 0
    }

    fn fill_mailboxes(&mut self) {
        while !self.queue.is_empty() && self.queue.pop_if(put_in_mailbox) {}
    }

    /// Sends nothing until [`resume_transmitting`](Self::resume_transmitting), except for a frame that is on the bus now.
    pub fn stop_transmitting(&mut self) {
        const ABORT_ALL: u32 = 1 << 7 | 1 << 15 | 1 << 23;
        self.may_transmit = false;
        self.queue.clear();
        // SAFETY: zeros have no effect in this register.
        registers().tsr().write(|w| unsafe { w.bits(ABORT_ALL) });
    }

    /// Forgets the frames that wait but those of `cob_id`; one that is on the bus now goes on.
    pub fn forget_all_but(&mut self, cob_id: u16) {
        const ABORT: u32 = 1 << 7;
        self.queue.retain(cob_id);
        let mut aborts = 0;
        for mailbox in 0..3 {
            if registers().tx(mailbox).tir().read().stid().bits() != cob_id {
                aborts |= ABORT << (8 * mailbox);
            }
        }
        // SAFETY: zeros, and the abort of an empty mailbox, have no effect in this register.
        registers().tsr().write(|w| unsafe { w.bits(aborts) });
    }

    /// Ends [`stop_transmitting`](Self::stop_transmitting).
    pub fn resume_transmitting(&mut self) {
        self.may_transmit = true;
    }

    /// Acknowledges a status interrupt; returns the latest error (last error code, RM0090, 32.9.2), if it concerns the
    /// supervision of the bit rate.
    pub fn handle_status(&mut self) -> Option<BusEvent> {
        const NO_ERROR: u8 = 0;
        const STUFF: u8 = 1;
        const FORM: u8 = 2;
        const BIT_RECESSIVE: u8 = 4;
        const CRC: u8 = 6;
        const SET_BY_SOFTWARE: u8 = 7;
        let can = registers();
        let status = can.esr().read();
        // SAFETY: the value that software sets, to see the next error.
        can.esr().write(|w| unsafe { w.lec().bits(SET_BY_SOFTWARE) });
        let last_error = status.lec().bits();
        if !matches!(last_error, NO_ERROR | SET_BY_SOFTWARE) {
            self.traffic = Traffic::default();
        }
        let error = match last_error {
            STUFF | BIT_RECESSIVE | CRC => Some(BusEvent::Error),
            FORM => Some(BusEvent::FormError),
            _ => None,
        };
        can.ier().modify(|_, w| {
            // Bus-off is told once, even if the interrupt stays for as long as it does.
            w.bofie().bit(status.boff().bit_is_clear());
            // There may be tens of thousands of errors a second. A search needs each of them.
            w.lecie().bit(self.is_listening)
        });
        can.msr().write(|w| w.erri().set_bit());
        self.has_heard |= error.is_some();
        error
    }

    /// Has the next error interrupt again, and reports what no interrupt does. To be called each millisecond.
    ///
    /// A bus that is dominant for longer than any frame has recessive bits apart. Else traffic for more than two frame times that the
    /// controller neither understands nor finds an error in: one that waits for so many equal bits, to join the bus
    /// or to end an error flag, may wait for ever at a wrong rate.
    pub fn watch(&mut self) -> Option<BusEvent> {
        /// After a frame at 10 kbit/s the bus is recessive for a millisecond at least.
        const LONGEST_FRAME_MS: u16 = 16;
        const FRAMES: u16 = 2 * 135;
        let can = registers();
        if can.ier().read().lecie().bit_is_clear() {
            can.ier().modify(|_, w| w.lecie().set_bit());
        }
        let status = can.msr().read();
        let traffic = &mut self.traffic;
        let level = status.rx().bit_is_set();
        if level != traffic.is_recessive {
            *traffic = Traffic { is_recessive: level, level_ms: 0, ..*traffic };
        }
        traffic.ms = traffic.ms.saturating_add(1);
        traffic.level_ms = traffic.level_ms.saturating_add(1);
        let lasts = traffic.ms > LONGEST_FRAME_MS + 2 + FRAMES / self.bit_rate.kbit_per_s();
        let is_held = traffic.level_ms >= LONGEST_FRAME_MS;
        let is_sending = status.txm().bit_is_set();
        if lasts || is_held || is_sending {
            traffic.ms = 0;
        }
        match (is_held, lasts && !is_sending) {
            (true, _) => (!level).then_some(BusEvent::HeldDominant),
            (false, true) => Some(BusEvent::Error),
            (false, false) => None,
        }
    }

    /// TEC and REC (RM0090, 32.7.6).
    pub fn error_counters(&self) -> (u8, u8) {
        let status = registers().esr().read();
        (status.tec().bits(), status.rec().bits())
    }

    /// Whether what is received has made the controller error passive.
    pub fn is_passive_by_reception(&self) -> bool {
        self.error_counters().1 > 127
    }

    /// The controller's place on the bus (RM0090, 32.7.6).
    pub fn bus_state(&self) -> BusState {
        let status = registers().esr().read();
        match (status.boff().bit_is_set(), status.ewgf().bit_is_set()) {
            (true, _) => BusState::BusOff,
            (_, true) => BusState::Warning,
            _ => BusState::Good,
        }
    }
}

/// Resets the controller, again if need be, and has it enter initialisation mode; returns whether it does.
fn enter_initialization() -> bool {
    let can = registers();
    let is_there = (0..RESETS).any(|_| {
        // SAFETY: the reset bit of CAN1 in RCC belongs to its owner.
        unsafe { CAN1::reset_unchecked() };
        can.mcr().write(|w| w.sleep().clear_bit().inrq().set_bit());
        (0..INIT_READS).any(|_| can.msr().read().inak().bit_is_set())
    });
    if !is_there {
        defmt::error!("CAN: the controller does not enter initialisation mode, will try again");
    }
    is_there
}

/// Hands a frame to the controller; `false`: it has to wait. Only a frame that is more urgent than all that are in mailboxes
/// is put beside them: of two with one COB-ID the controller would not send the older one first (RM0090, 32.7.1).
fn put_in_mailbox(frame: &Frame) -> bool {
    let can = registers();
    const EMPTY: u32 = 1 << 26;
    let status = can.tsr().read();
    let is_empty = |mailbox: usize| status.bits() & EMPTY.wrapping_shl(mailbox as u32) != 0;
    let cob_id_in = |mailbox| can.tx(mailbox).tir().read().stid().bits();
    let goes_before = |mailbox| is_empty(mailbox) || frame.cob_id() < cob_id_in(mailbox);
    if !(0..3).all(goes_before) || !(0..3).any(is_empty) {
        return false;
    }
    let data = u64::from_le_bytes(frame.padded_data());
    let mailbox = can.tx(usize::from(status.code().bits()) % 3);
    // SAFETY: values for the whole registers.
    unsafe {
        mailbox.tdtr().write(|w| w.dlc().bits(frame.data().len() as u8));
        mailbox.tdlr().write(|w| w.bits(data as u32));
        mailbox.tdhr().write(|w| w.bits((data >> 32) as u32));
        mailbox.tir().write(|w| w.stid().bits(frame.cob_id()).txrq().set_bit());
    }
    true
}

/// Gives up the oldest frame of a receive FIFO.
fn release(fifo: usize) {
    let fifo = registers().rfr(fifo);
    fifo.write(|w| w.rfom().set_bit());
    let _ = (0..RELEASE_READS).any(|_| fifo.read().rfom().bit_is_clear());
}

/// The registers themselves: `bxcan` sets the filters, but copies each frame twice on its way.
fn registers() -> &'static pac::can1::RegisterBlock {
    // SAFETY: all accesses to CAN1 come from its one owner, the `Controller`.
    unsafe { &*CAN1::ptr() }
}
