//! The remote control's words in RAM: the program and the test that commands it share this file.

/// The control word of a program that waits for a command; any other value is a command that it carries out.
pub const READY: u32 = 0x5245_4459;
/// The number of argument words, which hold the answer afterwards.
pub const WORDS: usize = 7;

/// Bit 31 of an identifier word: the identifier has 29 bits.
pub const EXTENDED: u32 = 1 << 31;
/// Bit 30 of an identifier word: it is a remote frame.
pub const REMOTE: u32 = 1 << 30;

/// Modes of [`CONFIGURE`].
pub const LOOPBACK: u32 = 1 << 0;
pub const SILENT: u32 = 1 << 1;
pub const ONE_SHOT: u32 = 1 << 2;

/// Kinds of filter bank of [`FILTER`]: four or two identifiers, or two or one with a mask.
pub const LIST_16: u32 = 0;
pub const LIST_32: u32 = 1;
pub const MASK_16: u32 = 2;
pub const MASK_32: u32 = 3;

/// Answers of [`TRANSMIT`]. With `REPLACED`, the frame that was taken out of its mailbox follows.
pub const REFUSED: u32 = 0;
pub const QUEUED: u32 = 1;
pub const REPLACED: u32 = 2;

/// Answers of [`RECEIVE`]. With `FRAME`, the frame follows.
pub const EMPTY: u32 = 0;
pub const FRAME: u32 = 1;
pub const OVERRUN: u32 = 2;
pub const BUS_ERROR: u32 = 3;

/// Commands with their arguments. A frame is four words: identifier, DLC, and its data, little endian.
///
/// Sets the bit rate in bit/s and the modes, and leaves the controller disabled.
pub const CONFIGURE: u32 = 1;
/// Enables the controller; ready when it has joined the bus.
pub const ENABLE: u32 = 2;
/// Sets a filter bank: its number, FIFO and kind, and up to four words.
pub const FILTER: u32 = 3;
/// Disables all filter banks.
pub const CLEAR_FILTERS: u32 = 4;
/// Queues a frame. The answer is followed by the number of the mailbox and the replaced frame.
pub const TRANSMIT: u32 = 5;
/// Takes a frame out of the FIFOs, the first one first.
pub const RECEIVE: u32 = 6;
/// Aborts the frame in a mailbox; answers whether it was.
pub const ABORT: u32 = 7;
/// Answers whether all mailboxes are empty.
pub const IS_IDLE: u32 = 8;
/// Enters sleep mode.
pub const SLEEP: u32 = 9;
/// Leaves sleep mode; ready when the controller has joined the bus.
pub const WAKE_UP: u32 = 10;
/// Sets whether activity of the bus ends sleep mode.
pub const WAKE_UP_AUTOMATICALLY: u32 = 11;
/// Answers the numbers of interrupts so far: transmit, FIFO 0, FIFO 1, status change and error.
pub const INTERRUPTS: u32 = 12;
