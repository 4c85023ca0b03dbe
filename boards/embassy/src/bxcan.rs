//! The bxCAN as the runner drives it, by the driver of embassy-stm32. The registers are accessed for what that does not
//! offer: error counters, the level of the bus, and to abort a frame or to change the bit rate without a wait.
//!
//! What the driver of embassy-stm32 0.6.0 does, and the way round:
//!
//! - A change of the bit rate waits for the end of the traffic, and `enable` for an idle bus. So the port calls
//!   `rcc::enable_and_reset`, writes CAN_IER as it was, and polls `enable` once.
//! - `abort` waits while its frame is on the bus. The port sets the bit ABRQ in CAN_TSR.
//! - Its interrupt clears the flag that tells a sent frame from an aborted one. The port notes what it aborts.
//! - `try_write` takes a less urgent frame out of a full controller. A frame is offered only if a mailbox is empty and
//!   the others have less urgent ones.
//! - It has no error counters, no state and no level of the bus. They are in CAN_ESR and CAN_MSR.
//! - `BufferedCan` drops the errors of the bus. `CanRx::read` of the driver without buffers has them.
//! - `Frame::data` panics if the length code is above 8, which is legal on the wire. `header().len()` comes first.
//! - `set_automatic_retransmit` writes its argument to NART, which means the opposite (RM0090, 32.9.2).
//! - It does not report an overrun, so object 2000h does not count it.
//! - In silent mode and during a reset the transmit pin stays with the controller, which drives it dominant on some
//!   chips. The driver keeps the pin, so there is no way round.

use canopen_node::{
    BitRate, Frame, Numbers, Receives, Service, Services,
    bit_rate::BitTiming,
    indicator::BusState,
    runner::{BusError, Controller, Mode, Received, Sample},
};
use embassy_futures::{
    poll_once,
    select::{Either, select, select_array},
};
use embassy_stm32::{
    bind_interrupts,
    can::{
        Can, CanRx, CanTx, Fifo, Frame as CanFrame, Mailbox, Rx0InterruptHandler,
        Rx1InterruptHandler, SceInterruptHandler, StandardId, TxInterruptHandler,
        enums::{self, TryReadError},
        filter::{ListEntry16, Mask32},
        frame::Envelope,
        util::NominalBitTiming,
    },
    pac::{CAN1, can::regs::Ier},
    peripherals, rcc,
};

use crate::chip::CAN_HZ;

bind_interrupts!(pub struct Interrupts {
    CAN1_TX => TxInterruptHandler<peripherals::CAN1>;
    CAN1_RX0 => Rx0InterruptHandler<peripherals::CAN1>;
    CAN1_RX1 => Rx1InterruptHandler<peripherals::CAN1>;
    CAN1_SCE => SceInterruptHandler<peripherals::CAN1>;
});

const TIMINGS: [Option<BitTiming>; 10] = BitTiming::table(CAN_HZ);
const MAILBOXES: [Mailbox; 3] = [Mailbox::Mailbox0, Mailbox::Mailbox1, Mailbox::Mailbox2];

/// The CAN controller.
pub struct Bxcan {
    can: Can<'static>,
    sender: CanTx<'static>,
    receiver: CanRx<'static>,
    /// The interrupts as the driver has enabled them.
    interrupts: Ier,
    /// The COB-IDs and services in the mailboxes, but for aborted frames: the driver does not tell these from sent ones.
    sending: [Option<(u16, Service)>; 3],
    received: Option<Envelope>,
    error: Option<BusError>,
}

impl Bxcan {
    pub fn new(mut can: Can<'static>) -> Self {
        let (sender, receiver) = can.split();
        let interrupts = CAN1.ier().read();
        Self { can, sender, receiver, interrupts, sending: [None; 3], received: None, error: None }
    }

    /// Waits until a frame was received or sent, or an error was detected. Nothing is lost if the future is dropped.
    pub async fn changed(&mut self) {
        let (sender, sending) = (&self.sender, self.sending);
        let sent = MAILBOXES.map(async |mailbox| match sending[mailbox as usize] {
            Some(_) => sender.flush(mailbox).await,
            None => core::future::pending().await,
        });
        match select(self.receiver.read(), select_array(sent)).await {
            Either::First(Ok(envelope)) => self.received = Some(envelope),
            Either::First(Err(error)) => self.error = convert(error),
            Either::Second(_) => {}
        }
    }
}

impl Controller for Bxcan {
    /// Resets the controller, as the driver waits for the end of a frame before it changes the bit rate.
    fn start<N: Numbers>(&mut self, mode: Mode, bit_rate: BitRate, receives: &Receives<N>) -> bool {
        let Some(timing) = TIMINGS[usize::from(bit_rate.index())].and_then(to_driver) else {
            return false;
        };
        rcc::enable_and_reset::<peripherals::CAN1>();
        CAN1.ier().write_value(self.interrupts);
        (self.sending, self.received) = ([None; 3], None);
        self.can.modify_config().set_bit_timing(timing).set_silent(mode == Mode::Listen);
        self.set_receives(receives);
        // The first poll begins, and the controller joins the bus by itself.
        let _ = poll_once(self.can.enable());
        true
    }

    fn set_receives<N: Numbers>(&mut self, receives: &Receives<N>) {
        let entry =
            |id| ListEntry16::data_frames_with_id(StandardId::new(id).unwrap_or(StandardId::MAX));
        let mut filters = self.can.modify_filters();
        filters.clear();
        if receives.all {
            filters.enable_bank(0, Fifo::Fifo0, Mask32::accept_all());
            return;
        }
        for (bank, list) in (0..).zip(receives.lists::<4>()) {
            filters.enable_bank(bank, Fifo::Fifo0, list.map(entry));
        }
    }

    fn receive(&mut self) -> Option<Received> {
        loop {
            match self.received.take().map_or_else(|| self.receiver.try_read(), Ok) {
                Ok(Envelope { frame, .. }) => {
                    // The driver panics at the data of a frame with a length code above 8.
                    let is_valid = frame.header().len() <= 8;
                    return Some(is_valid.then(|| Frame::received(&frame)).flatten().into());
                }
                Err(TryReadError::BusError(error)) => self.error = convert(error),
                Err(TryReadError::Empty) => return None,
            }
        }
    }

    fn send(&mut self, frame: &Frame, service: Service) -> bool {
        // Otherwise the driver takes a less urgent frame out of its mailbox.
        let is_full = self.sending.iter().all(Option::is_some);
        if is_full || self.sending.iter().flatten().any(|(cob_id, _)| *cob_id <= frame.cob_id()) {
            return false;
        }
        let Ok(copy) = CanFrame::new_standard(frame.cob_id(), frame.data()) else { return false };
        let Ok(status) = self.sender.try_write(&copy) else { return false };
        self.sending[status.mailbox() as usize] = Some((frame.cob_id(), service));
        true
    }

    /// `send` writes no mailbox before its outcome is collected here.
    fn take_sent(&mut self) -> Services {
        let is_empty = |mailbox| poll_once(self.sender.flush(mailbox)).is_ready();
        let mailboxes = MAILBOXES.into_iter().zip(&mut self.sending);
        let sent =
            mailboxes.filter_map(|(mailbox, sending)| sending.take_if(|_| is_empty(mailbox)));
        sent.fold(Services::NONE, |services, (_, service)| services.and(Services::of(service)))
    }

    fn is_idle(&mut self) -> bool {
        self.sender.is_idle()
    }

    fn drop_frames(&mut self, services: Services) {
        for (mailbox, sending) in self.sending.iter_mut().enumerate() {
            if sending.take_if(|(_, service)| services.has(*service)).is_some() {
                CAN1.tsr().write(|w| w.set_abrq(mailbox, true));
            }
        }
    }

    fn take_error(&mut self) -> Option<BusError> {
        self.error.take()
    }

    fn error_counters(&self) -> (u8, u8) {
        let status = CAN1.esr().read();
        (status.tec(), status.rec())
    }

    fn bus_state(&self) -> BusState {
        let status = CAN1.esr().read();
        match (status.boff(), status.ewgf()) {
            (true, _) => BusState::BusOff,
            (_, true) => BusState::Warning,
            _ => BusState::Good,
        }
    }

    fn sample(&self) -> Option<Sample> {
        let status = CAN1.msr().read();
        Some(Sample { is_recessive: status.rx(), is_transmitting: status.txm() })
    }
}

/// The errors have the order of the last error code.
fn convert(error: enums::BusError) -> Option<BusError> {
    BusError::from_code(error as u8 + 1)
}

fn to_driver(timing: BitTiming) -> Option<NominalBitTiming> {
    Some(NominalBitTiming {
        prescaler: timing.prescaler.try_into().ok()?,
        seg1: timing.segment1.try_into().ok()?,
        seg2: timing.segment2.try_into().ok()?,
        sync_jump_width: timing.sync_jump_width.try_into().ok()?,
    })
}
