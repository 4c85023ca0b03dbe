//! CAN1 as a program sees it through its registers.

mod bench;
mod errors;
mod filters;
mod modes;
mod receive;
mod registers;
mod transmit;
