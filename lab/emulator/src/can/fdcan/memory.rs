//! The message RAM with its fixed places for filters, FIFOs and buffers (RM0440 44.3.3, 44.3.4).

use crate::can::{Frame, Id};

/// The places in words: 28 standard and 8 extended filters, two receive FIFOs, the transmit events and buffers.
const EXTENDED_FILTERS: usize = 28;
const RECEIVE: usize = EXTENDED_FILTERS + 2 * 8;
const EVENTS: usize = RECEIVE + 2 * DEPTH * ELEMENT;
const BUFFERS: usize = EVENTS + 2 * DEPTH;
const WORDS: usize = BUFFERS + DEPTH * ELEMENT;
/// The words of a message: two of header, and 64 bytes of data.
const ELEMENT: usize = 18;
/// The elements of each FIFO, and the transmit buffers.
pub const DEPTH: usize = 3;

/// The identifier word of a message: it has 29 bits, it is a remote frame.
const XTD: u32 = 1 << 30;
const RTR: u32 = 1 << 29;
const DLC_SHIFT: u32 = 16;
const FDF: u32 = 1 << 21;
/// A transmitted message leaves an event.
const EFC: u32 = 1 << 23;
/// The event is a transmission, without a request to cancel it or in spite of one.
const SENT: u32 = 1 << 22;
const SENT_IN_SPITE: u32 = 2 << 22;

/// A message to transmit.
pub struct Buffer {
    pub frame: Frame,
    pub wants_event: bool,
    /// It is a CAN FD frame, which is not modelled.
    pub is_fd: bool,
}

#[derive(Debug)]
pub struct Memory(Vec<u32>);

impl Memory {
    /// The memory after power-on, which the program has to initialise.
    pub fn new() -> Self {
        Self(vec![0xA5A5_A5A5; WORDS])
    }

    pub fn read(&self, distance: u32) -> Option<u32> {
        self.0.get(distance as usize / 4).copied()
    }

    /// Returns false past the end.
    pub fn write(&mut self, distance: u32, value: u32) -> bool {
        self.0.get_mut(distance as usize / 4).map(|word| *word = value).is_some()
    }

    pub fn standard_filter(&self, index: usize) -> u32 {
        self.0[index]
    }

    pub fn extended_filter(&self, index: usize) -> [u32; 2] {
        let place = EXTENDED_FILTERS + 2 * index;
        [self.0[place], self.0[place + 1]]
    }

    /// Stores a received frame, with the number of its filter if one matched.
    pub fn store(
        &mut self,
        fifo: usize,
        element: usize,
        frame: &Frame,
        filter: Option<u32>,
        stamp: u16,
    ) {
        let place = RECEIVE + (fifo * DEPTH + element) * ELEMENT;
        // A frame that no filter matched is marked.
        let filter = filter.unwrap_or(1 << 7);
        self.0[place] = identifier(frame);
        self.0[place + 1] = filter << 24 | u32::from(frame.dlc) << DLC_SHIFT | u32::from(stamp);
        let data = u64::from_le_bytes(frame.data);
        self.0[place + 2] = data as u32;
        self.0[place + 3] = (data >> 32) as u32;
    }

    pub fn buffer(&self, buffer: usize) -> Buffer {
        let place = BUFFERS + buffer * ELEMENT;
        let [head, control, low, high] = [0, 1, 2, 3].map(|word| self.0[place + word]);
        let id = if head & XTD == 0 {
            Id::Standard((head >> 18) as u16 & 0x7FF)
        } else {
            Id::Extended(head & 0x1FFF_FFFF)
        };
        let dlc = (control >> DLC_SHIFT & 0xF) as u8;
        let frame = if head & RTR != 0 {
            Frame::remote(id, dlc)
        } else {
            let bytes = (u64::from(high) << 32 | u64::from(low)).to_le_bytes();
            Frame::data(id, &bytes[..usize::from(dlc.min(8))]).with_dlc(dlc)
        };
        Buffer { frame, wants_event: control & EFC != 0, is_fd: control & FDF != 0 }
    }

    /// Stores the event of a transmitted message.
    pub fn store_event(&mut self, element: usize, buffer: usize, in_spite: bool, stamp: u16) {
        let from = BUFFERS + buffer * ELEMENT;
        let place = EVENTS + 2 * element;
        let kind = if in_spite { SENT_IN_SPITE } else { SENT };
        self.0[place] = self.0[from];
        self.0[place + 1] = self.0[from + 1] & 0xFF0F_0000 | kind | u32::from(stamp);
    }
}

fn identifier(frame: &Frame) -> u32 {
    let id = match frame.id {
        Id::Standard(id) => u32::from(id) << 18,
        Id::Extended(id) => id | XTD,
    };
    if frame.remote { id | RTR } else { id }
}

/// Get and put index of a FIFO of three elements.
#[derive(Clone, Copy, Debug, Default)]
pub struct Fifo {
    get: usize,
    level: usize,
}

impl Fifo {
    pub fn is_full(self) -> bool {
        self.level == DEPTH
    }

    /// The element to be filled, if the FIFO has room or gives up its oldest element for it.
    pub fn push(&mut self, overwrites: bool) -> Option<usize> {
        if self.is_full() {
            if !overwrites {
                return None;
            }
            self.pop();
        }
        let put = (self.get + self.level) % DEPTH;
        self.level += 1;
        Some(put)
    }

    /// Releases all elements up to the one of index `last`.
    pub fn acknowledge(&mut self, last: u32) {
        let last = last as usize % DEPTH;
        let released = (last + DEPTH - self.get) % DEPTH + 1;
        if released <= self.level {
            (0..released).for_each(|_| self.pop());
        }
    }

    fn pop(&mut self) {
        self.get = (self.get + 1) % DEPTH;
        self.level -= 1;
    }

    /// Its status register, without the bit for a lost message.
    pub fn status(self) -> u32 {
        let put = (self.get + self.level) % DEPTH;
        let [get, level, put] = [self.get, self.level, put].map(|index| index as u32);
        level | get << 8 | put << 16 | u32::from(self.is_full()) << 24
    }
}
