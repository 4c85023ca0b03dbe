//! The CAN controller, as a port offers it.

use crate::{BitRate, BusEvent, Frame, Numbers, Receives, Service, Services, indicator::BusState};

/// A CAN controller. No call may wait for the bus.
///
/// This is a whole one, over a driver with a single transmit buffer and without filters:
///
/// ```
/// use canopen_node::{
///     BitRate, Frame, Numbers, Receives, Service, Services, bit_rate::BitTiming,
///     indicator::BusState, runner::{BusError, Controller, Mode, Received},
/// };
/// # const CAN_HZ: u32 = 40_000_000;
/// # enum ReadError { Overrun, Empty }
/// # struct Driver;
/// # impl Driver {
/// #     fn with(_: BitTiming, _listens: bool) -> Self { Self }
/// #     fn read(&mut self) -> Result<Frame, ReadError> { Err(ReadError::Empty) }
/// #     fn write(&mut self, _: u16, _: &[u8]) {}
/// #     fn is_empty(&self) -> bool { true }
/// #     fn has_sent(&self) -> bool { true }
/// #     fn abort(&mut self) {}
/// #     fn last_error(&mut self) -> Option<BusError> { None }
/// #     fn counters(&self) -> (u8, u8) { (0, 0) }
/// #     fn is_bus_off(&self) -> bool { false }
/// # }
///
/// const TIMINGS: [Option<BitTiming>; 10] = BitTiming::table(CAN_HZ);
///
/// struct Can {
///     driver: Driver,
///     sending: Option<Service>,               // of the frame in the buffer
/// }
///
/// impl Controller for Can {
///     fn start<N: Numbers>(
///         &mut self, mode: Mode, bit_rate: BitRate, _receives: &Receives<N>,
///     ) -> bool {
///         let Some(timing) = TIMINGS[usize::from(bit_rate.index())] else { return false };
///         self.sending = None;
///         self.driver = Driver::with(timing, mode == Mode::Listen);
///         true
///     }
///
///     fn receive(&mut self) -> Option<Received> {
///         match self.driver.read() {
///             Ok(frame) => Some(Frame::received(&frame).into()),
///             Err(ReadError::Overrun) => Some(Received::Overrun),
///             Err(ReadError::Empty) => None,
///         }
///     }
///
///     fn send(&mut self, frame: &Frame, service: Service) -> bool {
///         let is_free = self.sending.is_none();
///         if is_free {
///             self.driver.write(frame.cob_id(), frame.data());
///             self.sending = Some(service);
///         }
///         is_free
///     }
///
///     fn take_sent(&mut self) -> Services {
///         let finished = self.sending.take_if(|_| self.driver.is_empty());
///         finished.filter(|_| self.driver.has_sent()).map_or(Services::NONE, Services::of)
///     }
///
///     fn is_idle(&mut self) -> bool { self.sending.is_none() }
///
///     fn drop_frames(&mut self, services: Services) {
///         if self.sending.is_some_and(|service| services.has(service)) {
///             self.driver.abort();
///         }
///     }
///
///     fn take_error(&mut self) -> Option<BusError> { self.driver.last_error() }
///
///     fn error_counters(&self) -> (u8, u8) { self.driver.counters() }
///
///     fn bus_state(&self) -> BusState {
///         match self.driver.counters() {
///             _ if self.driver.is_bus_off() => BusState::BusOff,
///             (..96, ..96) => BusState::Good,
///             _ => BusState::Warning,
///         }
///     }
/// }
/// ```
pub trait Controller {
    /// Runs at `bit_rate` from now on, drops what it was to send and what it has received, leaves bus-off and lets the
    /// frames `receives` pass. It must not wait for an idle bus, which may never come: the controller joins by itself.
    ///
    /// Returns whether it has started. If not, the runner tries again a few times a second.
    #[must_use]
    fn start<N: Numbers>(&mut self, mode: Mode, bit_rate: BitRate, receives: &Receives<N>) -> bool;

    /// Lets the frames `receives` pass from now on; those already received stay. A controller that lets every frame
    /// pass at all times need not do anything.
    fn set_receives<N: Numbers>(&mut self, _receives: &Receives<N>) {}

    /// The oldest received frame, or a loss of frames.
    fn receive(&mut self) -> Option<Received>;

    /// Passes `frame` of this service to the controller and returns whether it takes it. It must refuse a frame that would wait behind
    /// a less urgent one, or that might overtake one of the same COB-ID: the frame is offered again when another was
    /// sent. A controller with a single place refuses every frame until that is empty.
    fn send(&mut self, frame: &Frame, service: Service) -> bool;

    /// The services whose frames were sent and acknowledged since the last call, each once. Dropped frames do not count. A
    /// controller that forgets the outcome of a frame when it gets the next one collects it in [`send`](Self::send).
    fn take_sent(&mut self) -> Services;

    /// Puts right, a few times a second, what other code on the chip may have changed.
    fn supervise(&mut self) {}

    /// Whether it has no frame to send.
    fn is_idle(&mut self) -> bool;

    /// Drops the frames of these services; one on the bus now continues. It need not wait for that.
    fn drop_frames(&mut self, services: Services);

    /// The latest error since the last call.
    fn take_error(&mut self) -> Option<BusError>;

    /// TEC and REC (ISO 11898-1).
    fn error_counters(&self) -> (u8, u8);

    /// The fault confinement state. The controller must recover from bus-off by itself.
    fn bus_state(&self) -> BusState;

    /// What the bus is like at this moment. `None` if the controller cannot tell: then no search begins while it cannot
    /// join the bus, and a bus that is held dominant is not noticed.
    fn sample(&self) -> Option<Sample> {
        None
    }

    /// Called up to a thousand times a second while errors matter: a controller that reports only the first of many by
    /// an interrupt reports the next one too.
    fn report_errors(&mut self) {}
}

/// How a controller runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// It acknowledges, sends, and signals errors.
    TakePart,
    /// It receives silently: no dominant bit, not even an acknowledge.
    Listen,
}

/// A result of reading received frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Received {
    /// A frame.
    Frame(Frame),
    /// A frame of no use to any CANopen node: a remote frame, a 29-bit identifier, or a length code above 8.
    Other,
    /// A frame was lost because the controller was full.
    Overrun,
}

impl From<Option<Frame>> for Received {
    /// A frame that the port could convert, or one of no use.
    fn from(frame: Option<Frame>) -> Self {
        frame.map_or(Self::Other, Self::Frame)
    }
}

/// The bus at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sample {
    /// The level at the controller's receive pin.
    pub is_recessive: bool,
    /// Whether the controller is sending a frame.
    pub is_transmitting: bool,
}

/// An error that a controller has detected (ISO 11898-1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum BusError {
    /// Six equal bits within a frame.
    Stuff,
    /// A wrong bit at a place of fixed level.
    Form,
    /// A frame that no other node acknowledged.
    Acknowledge,
    /// The controller sent a recessive bit and read a dominant one.
    BitRecessive,
    /// The controller sent a dominant bit and read a recessive one.
    BitDominant,
    /// A received frame with a wrong checksum.
    Crc,
}

impl BusError {
    /// The error with this last error code, 1 to 6, as the registers of bxCAN, FDCAN and C_CAN have it; others are
    /// none.
    pub const fn from_code(code: u8) -> Option<Self> {
        match code {
            1 => Some(Self::Stuff),
            2 => Some(Self::Form),
            3 => Some(Self::Acknowledge),
            4 => Some(Self::BitRecessive),
            5 => Some(Self::BitDominant),
            6 => Some(Self::Crc),
            _ => None,
        }
    }

    /// The event for [`Node::handle_bus_event`](crate::Node::handle_bus_event), if the error says something about the bit rate.
    pub const fn event(self) -> Option<BusEvent> {
        match self {
            Self::Stuff | Self::BitRecessive | Self::Crc => Some(BusEvent::Error),
            Self::Form => Some(BusEvent::FormError),
            Self::Acknowledge | Self::BitDominant => None,
        }
    }
}
