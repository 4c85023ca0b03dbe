//! The events of a CAN controller that concern the node, other than received frames.

/// An event of the CAN controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum BusEvent {
    /// A valid frame was received, whether the node wants it or not.
    Received,
    /// A frame that the node sent was acknowledged.
    Acknowledged,
    /// No frame of the node waits for the bus any more: all have been sent or dropped. Each node with a heartbeat, an event
    /// timer of a TPDO or SDO block uploads needs this event: it sends the first of these frames, and waits for the event
    /// before the next. An LSS slave alone does without.
    NonePending,
    /// A stuff, CRC or bit recessive error, or traffic that keeps the controller from joining the bus for two frame
    /// times. A missing acknowledge does not count, since no other node may be there. Nor does a bit dominant error,
    /// which indicates a broken wire or a short circuit.
    Error,
    /// A form error. A silent listener sees one when a frame is not acknowledged.
    FormError,
    /// The bus has been dominant for longer than any frame: a short circuit or a defective station.
    HeldDominant,
    /// The controller is bus-off.
    BusOff,
    /// The controller has recovered from bus-off.
    BusOffRecovered,
    /// The controller received frames faster than they were read. Each event is counted.
    Overrun,
    /// The controller's error counters (ISO 11898-1), for object 2000h and for the error passive emergency. The board
    /// reports them when the controller becomes error passive, and a few times a second.
    ErrorCounters {
        /// TEC.
        transmit: u8,
        /// REC.
        receive: u8,
    },
}
