//! A bxCAN, an adapter and the bus between them, and the names of registers and bits.

use emulator::{
    Time,
    can::{
        Adapter, Bus, Bxcan, Clock, Frame, Id,
        bxcan::{CanVariant, Role},
    },
};

pub const MCR: u32 = 0x000;
pub const MSR: u32 = 0x004;
pub const TSR: u32 = 0x008;
pub const RF0R: u32 = 0x00C;
pub const RF1R: u32 = 0x010;
pub const IER: u32 = 0x014;
pub const ESR: u32 = 0x018;
pub const BTR: u32 = 0x01C;
pub const TI0R: u32 = 0x180;
pub const RI0R: u32 = 0x1B0;
pub const RI1R: u32 = 0x1C0;
pub const FMR: u32 = 0x200;
pub const FM1R: u32 = 0x204;
pub const FS1R: u32 = 0x20C;
pub const FFA1R: u32 = 0x214;
pub const FA1R: u32 = 0x21C;
pub const F0R1: u32 = 0x240;

pub const INRQ: u32 = 1;
pub const SLEEP: u32 = 2;
pub const TXFP: u32 = 4;
pub const RFLM: u32 = 8;
pub const NART: u32 = 16;
pub const AWUM: u32 = 32;
pub const ABOM: u32 = 64;
pub const MCR_RESET: u32 = 1 << 15;

pub const INAK: u32 = 1;
pub const SLAK: u32 = 2;

/// 1 Mbit/s and slower on APB1 of 32 MHz.
pub const MEGABIT: u32 = 0x001C_0001;
pub const HALF_MEGABIT: u32 = 0x001C_0003;

/// A bxCAN, an adapter and the bus between them.
pub struct CanRig {
    pub bus: Bus,
    pub can: Bxcan,
    pub adapter: Adapter,
}

impl CanRig {
    /// After reset, APB1 at 32 MHz.
    pub fn new() -> Self {
        let mut can = Bxcan::new(Role::Master);
        can.set_clock(Clock { hz: 32_000_000, ppm: 0 });
        Self { bus: Bus::new(), can, adapter: Adapter::new(1_000_000) }
    }

    /// In normal mode with these bits of MCR and a filter that accepts everything into FIFO 0.
    pub fn running(mcr: u32) -> Self {
        let mut rig = Self::new();
        rig.open_filter();
        rig.join(mcr, MEGABIT);
        rig
    }

    /// Like [`running`](Self::running), of another variant.
    pub fn of_variant(variant: CanVariant, mcr: u32) -> Self {
        let mut rig = Self::new();
        rig.can.set_variant(variant);
        rig.open_filter();
        rig.join(mcr, MEGABIT);
        rig
    }

    pub fn open_filter(&mut self) {
        for (register, value) in
            [(FMR, 0x2A1C_0E01), (FS1R, 1), (F0R1, 0), (F0R1 + 4, 0), (FA1R, 1), (FMR, 0x2A1C_0E00)]
        {
            assert!(self.write(register, value));
        }
    }

    pub fn join(&mut self, mcr: u32, btr: u32) {
        self.write(MCR, mcr | INRQ);
        assert_eq!(self.read(MSR) & (INAK | SLAK), INAK);
        self.write(BTR, btr);
        self.write(MCR, mcr);
        self.run_us(40);
        assert_eq!(self.read(MSR) & (INAK | SLAK), 0);
        self.can.take_notes();
    }

    pub fn read(&mut self, offset: u32) -> u32 {
        self.can.read(offset, self.bus.now()).expect("no such register")
    }

    pub fn write(&mut self, offset: u32, value: u32) -> bool {
        self.can.write(offset, value, self.bus.now())
    }

    pub fn run(&mut self, span: Time) {
        let until = self.bus.now() + span;
        while self.bus.advance(until, &mut [&mut self.can, &mut self.adapter], &mut |_, _, _| {})
            < until
        {}
        self.can.update_irq();
    }

    pub fn run_us(&mut self, us: u64) {
        self.run(Time::from_us(us));
    }

    pub fn step_until(&mut self, what: &str, mut done: impl FnMut(&mut Self) -> bool) {
        let limit = self.bus.now() + Time::from_ms(100);
        while !done(self) {
            self.run(Time::from_ns(500));
            assert!(self.bus.now() < limit, "{what} never came");
        }
    }

    pub fn mailbox(&mut self, mailbox: u32, frame: Frame) {
        let base = TI0R + 16 * mailbox;
        let data = u64::from_le_bytes(frame.data);
        self.write(base + 4, u32::from(frame.dlc));
        self.write(base + 8, data as u32);
        self.write(base + 12, (data >> 32) as u32);
        let id = match frame.id {
            Id::Standard(id) => u32::from(id) << 21,
            Id::Extended(id) => id << 3 | 4,
        };
        self.write(base, id | u32::from(frame.remote) << 1 | 1);
    }

    pub fn received(&mut self) -> Vec<Frame> {
        std::iter::from_fn(|| self.adapter.receive()).map(|(_, frame)| frame).collect()
    }

    /// Empties a FIFO: identifier word, DLC and filter match index, first data word of each message.
    pub fn fifo(&mut self, fifo: u32) -> Vec<[u32; 3]> {
        let mut messages = Vec::new();
        while self.read(RF0R + 4 * fifo) & 3 != 0 {
            let base = RI0R + 16 * fifo;
            messages.push([self.read(base), self.read(base + 4), self.read(base + 8)]);
            self.write(RF0R + 4 * fifo, 1 << 5);
        }
        messages
    }
}

pub fn standard(id: u16, payload: &[u8]) -> Frame {
    Frame::data(Id::Standard(id), payload)
}
