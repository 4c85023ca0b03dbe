//! CAN1 as seen by a program through its registers.

mod errors;
mod filters;
mod modes;
mod receive;
mod registers;
mod transmit;
