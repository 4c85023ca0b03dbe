//! The TWAI controller, by the driver of esp-hal. What the driver does not offer comes from the registers: whether a
//! frame was sent, aborts, the kind of an error, and recovery from bus-off.
//!
//! What the driver of esp-hal 1.2.2 does, and the way round:
//!
//! - A driver that runs cannot change the bit rate or the mode. It is dropped and made anew.
//! - It does not tell whether a frame was sent, and has no abort. TWAI_STATUS_REG and TWAI_CMD_REG do, by
//!   `TWAI0::regs()`.
//! - Its interrupt drops the kind of an error. The loop polls TWAI_ERR_CODE_CAP_REG in place of it.
//! - The remains of a lost frame stay, and each `receive` fails again. TWAI_CMD_REG releases the buffer.
//! - Bus-off lasts until `initiate_recovery`. Each look at the errors writes TWAI_MODE_REG.
//! - A bit error has no level. Its place in the frame tells most of it.

use canopen_node::{
    BitRate, Frame, Numbers, Receives, Service, Services,
    indicator::BusState,
    runner::{self, BusError, Mode, Received, Sample},
};
use esp_hal::{
    Blocking,
    gpio::{AnyPin, interconnect::InputSignal},
    peripherals::TWAI0,
    twai::{
        BaudRate, ErrorKind, EspTwaiError, EspTwaiFrame, TimingConfig, Twai, TwaiConfiguration,
        TwaiMode,
    },
};

/// The controller with its pins, and its driver once it has started.
pub struct Controller {
    twai: TWAI0<'static>,
    receive: InputSignal<'static>,
    transmit: AnyPin<'static>,
    driver: Option<Twai<'static, Blocking>>,
    is_listening: bool,
    /// The service of the frame in the only transmit buffer.
    sending: Option<Services>,
}

impl Controller {
    /// The controller on these pins of a transceiver.
    pub fn new(
        twai: TWAI0<'static>,
        receive: impl Into<InputSignal<'static>>,
        transmit: impl Into<AnyPin<'static>>,
    ) -> Self {
        let (receive, transmit) = (receive.into(), transmit.into());
        Self { twai, receive, transmit, driver: None, is_listening: false, sending: None }
    }
}

impl runner::Controller for Controller {
    /// A new driver is the only way to another bit rate or mode; the controller is reset meanwhile.
    fn start<N: Numbers>(
        &mut self,
        mode: Mode,
        bit_rate: BitRate,
        _receives: &Receives<N>,
    ) -> bool {
        let Some(timing) = port_esp32c3::timing(bit_rate) else {
            return false;
        };
        self.driver = None;
        self.sending = None;
        self.is_listening = mode == Mode::Listen;
        // SAFETY: the driver that had the controller and the pin is gone.
        let (twai, transmit) =
            unsafe { (self.twai.clone_unchecked(), self.transmit.clone_unchecked()) };
        let timing = TimingConfig {
            baud_rate_prescaler: timing.prescaler,
            sync_jump_width: timing.sync_jump_width,
            tseg_1: timing.segment1,
            tseg_2: timing.segment2,
            triple_sample: false,
        };
        let mode = if self.is_listening { TwaiMode::ListenOnly } else { TwaiMode::Normal };
        let receive = self.receive.clone();
        let rate = BaudRate::Custom(timing);
        self.driver = Some(TwaiConfiguration::new(twai, receive, transmit, rate, mode).start());
        // The controller notes an error only for an interrupt, although none reaches the processor.
        TWAI0::regs().int_ena().write(|w| w.bus_err_int_ena().set_bit());
        true
    }

    fn receive(&mut self) -> Option<Received> {
        match self.driver.as_mut()?.receive() {
            Ok(frame) => Some(port_esp32c3::received(&frame)),
            Err(nb::Error::Other(EspTwaiError::EmbeddedHAL(ErrorKind::Overrun))) => {
                // The driver leaves the remains of the lost frame in their place.
                TWAI0::regs().cmd().write(|w| w.release_buf().set_bit());
                Some(Received::Overrun)
            }
            Err(_) => None,
        }
    }

    fn send(&mut self, frame: &Frame, service: Service) -> bool {
        let converted = EspTwaiFrame::new(embedded_can::Frame::id(frame), frame.data());
        let is_taken = self.sending.is_none()
            && self
                .driver
                .as_mut()
                .zip(converted)
                .is_some_and(|(driver, frame)| driver.transmit(&frame).is_ok());
        if is_taken {
            self.sending = Some(Services::of(service));
        }
        is_taken
    }

    fn take_sent(&mut self) -> Services {
        let status = TWAI0::regs().status().read();
        let finished = self.sending.take_if(|_| status.tx_buf_st().bit_is_set());
        let sent = finished.filter(|_| status.tx_complete().bit_is_set());
        sent.unwrap_or(Services::NONE)
    }

    fn is_idle(&mut self) -> bool {
        self.sending.is_none()
    }

    fn drop_frames(&mut self, services: Services) {
        if self.sending.is_some_and(|service| service.has_any(services)) {
            TWAI0::regs().cmd().write(|w| w.abort_tx().set_bit());
        }
    }

    /// Also begins the recovery from bus-off: the controller waits in reset mode until then.
    fn take_error(&mut self) -> Option<BusError> {
        self.driver.as_mut()?;
        let registers = TWAI0::regs();
        if self.bus_state() == BusState::BusOff {
            registers.mode().modify(|_, w| w.reset_mode().clear_bit());
        }
        let has_error = registers.int_raw().read().bus_err_int_st().bit_is_set();
        has_error.then(|| port_esp32c3::error(registers.err_code_cap().read().bits() as u8))
    }

    /// The counters of a listener stand still: the driver has set one of them to 128, so that the controller cannot
    /// send an error flag.
    fn error_counters(&self) -> (u8, u8) {
        match &self.driver {
            Some(driver) if !self.is_listening => {
                (driver.transmit_error_count(), driver.receive_error_count())
            }
            _ => (0, 0),
        }
    }

    fn bus_state(&self) -> BusState {
        if self.driver.is_none() || self.is_listening {
            return BusState::Good;
        }
        let status = TWAI0::regs().status().read();
        match (status.bus_off_st().bit_is_set(), status.err_st().bit_is_set()) {
            (true, _) => BusState::BusOff,
            (_, true) => BusState::Warning,
            _ => BusState::Good,
        }
    }

    fn sample(&self) -> Option<Sample> {
        let is_transmitting =
            self.sending.is_some() && TWAI0::regs().status().read().tx_st().bit_is_set();
        Some(Sample { is_recessive: self.receive.is_input_high(), is_transmitting })
    }
}
