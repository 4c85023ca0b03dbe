//! The events of a CAN controller that concern the node, beside the frames that it receives.

/// An event of the CAN controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum BusEvent {
    /// A valid frame was received, whether the node wants it or not.
    Received,
    /// A frame of the node was sent and acknowledged.
    Acknowledged,
    /// A stuff, CRC or bit recessive error. A missing acknowledge is none, since nobody may be there. Neither is a bit
    /// dominant error, which shows a broken wire or a short circuit. Also traffic that keeps the controller from joining the
    /// bus for two frame times.
    Error,
    /// A form error. To a silent listener, this is what a frame without an acknowledge looks like.
    FormError,
    /// The bus has been dominant for longer than any frame is: a short circuit, or a station that is broken.
    HeldDominant,
    /// The controller is error passive by what it receives: REC is above 127.
    ErrorPassive,
    /// The controller is bus-off.
    BusOff,
    /// The controller was bus-off and takes part in the bus again.
    BusOffRecovered,
    /// The controller received frames faster than they were taken; each event counts.
    Overrun,
    /// The controller's error counters (ISO 11898-1): for object 2000h, and for the emergency message that the controller is
    /// error passive. To be given when it has become so, and a few times a second.
    ErrorCounters {
        /// TEC.
        transmit: u8,
        /// REC.
        receive: u8,
    },
}
