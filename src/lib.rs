//! CANopen LSS slave.
