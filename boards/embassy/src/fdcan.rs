//! The FDCAN as the runner drives it, by the driver of embassy-stm32. The registers are accessed for what that does not
//! offer: which buffer takes a frame and whether it was sent, the level of the bus, and to abort a frame or to hear of
//! an error.
//!
//! What the driver of embassy-stm32 0.6.0 does, and the way round:
//!
//! - A driver that runs cannot change the bit rate. It is dropped and made anew.
//! - `write` takes a more urgent frame out of a full controller. A frame is offered only if a buffer is empty.
//! - It tells neither its buffer nor whether the frame was sent, and has no `abort`; `flush` looks at the wrong buffer.
//!   FDCAN_TXFQS, TXBRP, TXBTO and TXBCR tell.
//! - An error of the bus wakes nobody, and a look at the state clears it. The interrupt PEA has a handler beside the
//!   driver's, and FDCAN_PSR is read at one place, which keeps LEC.
//! - A frame with a length code above 8 is taken out and not returned. It counts as a frame of no use.
//! - Remote frames with a length are sent as data frames. A node sends none.
//! - `rcc.boost`, for more than 150 MHz, does not boost. The chips run at 150 MHz at most.

use core::{cell::Cell, future::poll_fn, task::Poll};

use canopen_node::{
    BitRate, Frame, Numbers, Receives, Service, Services,
    bit_rate::BitTiming,
    indicator::BusState,
    runner::{BusError, Controller, Mode, Received, Sample},
};
use embassy_futures::poll_once;
use embassy_stm32::{
    Peri, bind_interrupts,
    can::{
        Can, CanConfigurator, Frame as CanFrame, IT0InterruptHandler, IT1InterruptHandler,
        OperatingMode,
        config::{GlobalFilter, NominalBitTiming, NonMatchingFilter::Reject},
        filter::{Action, ExtendedFilter, FilterType, StandardFilter},
    },
    interrupt::typelevel::{Handler, Interrupt},
    pac::{
        FDCAN1 as REGISTERS,
        can::regs::{Psr, Txbcr},
    },
    peripherals::FDCAN1,
};
use embassy_sync::waitqueue::AtomicWaker;
use embedded_can::StandardId;

use crate::chip::{CAN_HZ, Receive, Transmit};

bind_interrupts!(pub struct Interrupts {
    FDCAN1_IT0 => IT0InterruptHandler<FDCAN1>, Waker;
    FDCAN1_IT1 => IT1InterruptHandler<FDCAN1>;
});

const TIMINGS: [Option<BitTiming>; 10] = BitTiming::table(CAN_HZ);
const BUFFERS: usize = 3;

/// Of PSR, where the values have no names on an STM32H7: the last error code, and the activity.
const LAST_ERROR: u32 = 0b111;
const ACTIVITY: u32 = 0b11 << 3;
const TRANSMITTER: u32 = 0b11 << 3;

static CHANGED: AtomicWaker = AtomicWaker::new();

/// Wakes the node after the driver's handler, which knows nothing of errors.
pub struct Waker;

impl<I: Interrupt> Handler<I> for Waker {
    // SAFETY: the driver uses neither the flag nor the waker.
    unsafe fn on_interrupt() {
        REGISTERS.ir().write(|w| w.set_pea(true));
        CHANGED.wake();
    }
}

/// The CAN controller.
pub struct Fdcan {
    can: Peri<'static, FDCAN1>,
    receive: Peri<'static, Receive>,
    transmit: Peri<'static, Transmit>,
    driver: Option<Can<'static>>,
    /// The COB-IDs and services in the transmit buffers.
    sending: [Option<(u16, Services)>; BUFFERS],
    /// The error that the latest read of PSR has cleared there.
    error: Cell<Option<BusError>>,
}

impl Fdcan {
    pub fn new(
        can: Peri<'static, FDCAN1>,
        receive: Peri<'static, Receive>,
        transmit: Peri<'static, Transmit>,
    ) -> Self {
        let (sending, error) = ([None; BUFFERS], Cell::new(None));
        Self { can, receive, transmit, driver: None, sending, error }
    }

    fn status(&self) -> Psr {
        let status = REGISTERS.psr().read();
        if let Some(error) = BusError::from_code((status.0 & LAST_ERROR) as u8) {
            self.error.set(Some(error));
        }
        status
    }

    /// Whether a frame was sent or aborted.
    fn has_finished(&self) -> bool {
        let pending = REGISTERS.txbrp().read();
        (0..BUFFERS).any(|buffer| self.sending[buffer].is_some() && !pending.trp(buffer))
    }

    /// Waits until a frame was received or sent, or an error was detected. Nothing is lost if the future is dropped.
    pub async fn changed(&mut self) {
        poll_fn(|context| {
            CHANGED.register(context.waker());
            self.status();
            let has_received = REGISTERS.rxfs(0).read().ffl() > 0;
            if has_received || self.has_finished() || self.error.get().is_some() {
                return Poll::Ready(());
            }
            Poll::Pending
        })
        .await;
    }
}

impl Controller for Fdcan {
    /// Makes a new driver, as one that runs cannot change the bit rate.
    fn start<N: Numbers>(&mut self, mode: Mode, bit_rate: BitRate, receives: &Receives<N>) -> bool {
        let Some(timing) = TIMINGS[usize::from(bit_rate.index())].and_then(to_driver) else {
            return false;
        };
        self.driver = None;
        // SAFETY: the driver that had them is no more.
        let (can, receive, transmit) = unsafe {
            let Self { can, receive, transmit, .. } = self;
            (can.clone_unchecked(), receive.clone_unchecked(), transmit.clone_unchecked())
        };
        let mut configurator = CanConfigurator::new(can, receive, transmit, Interrupts);
        let others = GlobalFilter::default()
            .set_handle_standard_frames(Reject)
            .set_handle_extended_frames(Reject);
        let config = configurator.config().set_nominal_bit_timing(timing);
        configurator.set_config(config.set_global_filter(others));
        let driver = configurator.start(match mode {
            Mode::TakePart => OperatingMode::NormalOperationMode,
            Mode::Listen => OperatingMode::BusMonitoringMode,
        });
        REGISTERS.ie().modify(|w| w.set_peae(true));
        (self.driver, self.sending) = (Some(driver), [None; BUFFERS]);
        self.set_receives(receives);
        true
    }

    fn set_receives<N: Numbers>(&mut self, receives: &Receives<N>) {
        let Some(driver) = &self.driver else { return };
        let id = |id| StandardId::new(id).unwrap_or(StandardId::MAX);
        let mut standard = [StandardFilter::disable(); 28];
        let mut extended = ExtendedFilter::disable();
        if receives.all {
            standard[0] = StandardFilter::accept_all_into_fifo0();
            extended = ExtendedFilter::accept_all_into_fifo0();
        } else {
            for (place, [first, second]) in standard.iter_mut().zip(receives.lists()) {
                let filter = FilterType::DedicatedDual(id(first), id(second));
                *place = StandardFilter { filter, action: Action::StoreInFifo0 };
            }
        }
        driver.properties().set_standard_filters(&standard);
        driver.properties().set_extended_filter(0.into(), extended);
    }

    fn receive(&mut self) -> Option<Received> {
        let driver = self.driver.as_mut()?;
        if REGISTERS.ir().read().rfl(0) {
            REGISTERS.ir().write(|w| w.set_rfl(0, true));
            return Some(Received::Overrun);
        }
        if REGISTERS.rxfs(0).read().ffl() == 0 {
            return None;
        }
        // The driver takes out a frame with a length code above 8, but does not return it.
        let Poll::Ready(Ok(envelope)) = poll_once(driver.read()) else {
            return Some(Received::Other);
        };
        Some(Frame::received(&envelope.frame).into())
    }

    fn send(&mut self, frame: &Frame, service: Service) -> bool {
        // Otherwise the driver takes a more urgent frame out of its buffer.
        let is_full = self.sending.iter().all(Option::is_some);
        if is_full || self.sending.iter().flatten().any(|(cob_id, _)| *cob_id <= frame.cob_id()) {
            return false;
        }
        let Some(driver) = &mut self.driver else { return false };
        let Ok(copy) = CanFrame::new_standard(frame.cob_id(), frame.data()) else { return false };
        let buffer = usize::from(REGISTERS.txfqs().read().tfqpi());
        let is_taken = poll_once(driver.write(&copy)).is_ready();
        if is_taken {
            self.sending[buffer] = Some((frame.cob_id(), Services::of(service)));
        }
        is_taken
    }

    /// `send` writes no buffer before its outcome is collected here.
    fn take_sent(&mut self) -> Services {
        let (pending, sent) = (REGISTERS.txbrp().read(), REGISTERS.txbto().read());
        let mut services = Services::NONE;
        for (buffer, sending) in self.sending.iter_mut().enumerate() {
            let finished = sending.take_if(|_| !pending.trp(buffer));
            if let Some((_, service)) = finished.filter(|_| sent.to(buffer)) {
                services = services.and(service);
            }
        }
        services
    }

    fn is_idle(&mut self) -> bool {
        REGISTERS.txbrp().read().0 == 0
    }

    fn drop_frames(&mut self, services: Services) {
        let mut aborted = Txbcr(0);
        for (buffer, sending) in self.sending.iter().enumerate() {
            aborted.set_cr(buffer, sending.is_some_and(|(_, service)| service.has_any(services)));
        }
        REGISTERS.txbcr().write_value(aborted);
    }

    fn take_error(&mut self) -> Option<BusError> {
        self.status();
        self.error.take()
    }

    fn error_counters(&self) -> (u8, u8) {
        let counters = REGISTERS.ecr().read();
        (counters.tec(), if counters.rp() { 128 } else { counters.rec() })
    }

    fn bus_state(&self) -> BusState {
        let status = self.status();
        match (status.bo(), status.ew()) {
            (true, _) => BusState::BusOff,
            (_, true) => BusState::Warning,
            _ => BusState::Good,
        }
    }

    fn sample(&self) -> Option<Sample> {
        // Before the first start it has no clock.
        let is_transmitting = self.driver.is_some() && self.status().0 & ACTIVITY == TRANSMITTER;
        let is_recessive = self.driver.is_none() || REGISTERS.test().read().rx();
        Some(Sample { is_recessive, is_transmitting })
    }
}

fn to_driver(timing: BitTiming) -> Option<NominalBitTiming> {
    Some(NominalBitTiming {
        prescaler: timing.prescaler.try_into().ok()?,
        seg1: timing.segment1.try_into().ok()?,
        seg2: timing.segment2.try_into().ok()?,
        sync_jump_width: timing.sync_jump_width.try_into().ok()?,
    })
}
