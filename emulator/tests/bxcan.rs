//! CAN1 as a program sees it: modes, mailboxes, FIFOs, filters, error and status bits.

use emulator::{
    Time,
    can::{Adapter, BitTiming, Bus, Bxcan, Clock, Event, Frame, Id, Level, Station, bxcan::Note},
};

const MCR: u32 = 0x000;
const MSR: u32 = 0x004;
const TSR: u32 = 0x008;
const RF0R: u32 = 0x00C;
const RF1R: u32 = 0x010;
const IER: u32 = 0x014;
const ESR: u32 = 0x018;
const BTR: u32 = 0x01C;
const TI0R: u32 = 0x180;
const RI0R: u32 = 0x1B0;
const RI1R: u32 = 0x1C0;
const FMR: u32 = 0x200;
const FM1R: u32 = 0x204;
const FS1R: u32 = 0x20C;
const FFA1R: u32 = 0x214;
const FA1R: u32 = 0x21C;
const F0R1: u32 = 0x240;

const INRQ: u32 = 1;
const SLEEP: u32 = 2;
const TXFP: u32 = 4;
const RFLM: u32 = 8;
const NART: u32 = 16;
const AWUM: u32 = 32;
const ABOM: u32 = 64;

const INAK: u32 = 1;
const SLAK: u32 = 2;

/// 1 Mbit/s and slower on APB1 of 32 MHz.
const MEGABIT: u32 = 0x001C_0001;
const HALF_MEGABIT: u32 = 0x001C_0003;

/// A bxCAN, an adapter and the bus between them.
struct Bench {
    bus: Bus,
    can: Bxcan,
    adapter: Adapter,
}

impl Bench {
    /// After reset, APB1 at 32 MHz.
    fn new() -> Self {
        let mut can = Bxcan::new();
        can.set_clock(Clock { hz: 32_000_000, ppm: 0 });
        Self { bus: Bus::new(), can, adapter: Adapter::new(1_000_000) }
    }

    /// In normal mode with these bits of MCR and a filter that lets everything into FIFO 0.
    fn running(mcr: u32) -> Self {
        let mut bench = Self::new();
        bench.open_filter();
        bench.join(mcr, MEGABIT);
        bench
    }

    fn open_filter(&mut self) {
        for (register, value) in
            [(FMR, 0x2A1C_0E01), (FS1R, 1), (F0R1, 0), (F0R1 + 4, 0), (FA1R, 1), (FMR, 0x2A1C_0E00)]
        {
            assert!(self.write(register, value));
        }
    }

    fn join(&mut self, mcr: u32, btr: u32) {
        self.write(MCR, mcr | INRQ);
        assert_eq!(self.read(MSR) & (INAK | SLAK), INAK);
        self.write(BTR, btr);
        self.write(MCR, mcr);
        self.run_us(40);
        assert_eq!(self.read(MSR) & (INAK | SLAK), 0);
        self.can.take_notes();
    }

    fn read(&mut self, offset: u32) -> u32 {
        self.can.read(offset, self.bus.now()).expect("no such register")
    }

    fn write(&mut self, offset: u32, value: u32) -> bool {
        self.can.write(offset, value, self.bus.now())
    }

    fn run(&mut self, span: Time) {
        let until = self.bus.now() + span;
        while self.bus.advance(until, &mut [&mut self.can, &mut self.adapter], |_, _, _| {}) < until
        {
        }
        self.can.update_irq();
    }

    fn run_us(&mut self, us: u64) {
        self.run(Time::from_us(us));
    }

    fn step_until(&mut self, what: &str, mut done: impl FnMut(&mut Self) -> bool) {
        let limit = self.bus.now() + Time::from_ms(100);
        while !done(self) {
            self.run(Time::from_ns(500));
            assert!(self.bus.now() < limit, "{what} never came");
        }
    }

    fn mailbox(&mut self, mailbox: u32, frame: Frame) {
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

    fn received(&mut self) -> Vec<Frame> {
        std::iter::from_fn(|| self.adapter.receive()).map(|(_, frame)| frame).collect()
    }

    /// Takes what is in a FIFO: identifier word, DLC and filter match index, first data word.
    fn fifo(&mut self, fifo: u32) -> Vec<[u32; 3]> {
        let mut messages = Vec::new();
        while self.read(RF0R + 4 * fifo) & 3 != 0 {
            let base = RI0R + 16 * fifo;
            messages.push([self.read(base), self.read(base + 4), self.read(base + 8)]);
            self.write(RF0R + 4 * fifo, 1 << 5);
        }
        messages
    }
}

fn standard(id: u16, payload: &[u8]) -> Frame {
    Frame::data(Id::Standard(id), payload)
}

#[test]
fn registers_have_their_reset_values() {
    let mut bench = Bench::new();
    let values = [
        (MCR, 0x0001_0002),
        (MSR, 0x0000_0C02),
        (TSR, 0x1C00_0000),
        (RF0R, 0),
        (RF1R, 0),
        (IER, 0),
        (ESR, 0),
        (BTR, 0x0123_0000),
        (FMR, 0x2A1C_0E01),
        (FM1R, 0),
        (FS1R, 0),
        (FFA1R, 0),
        (FA1R, 0),
    ];
    for (offset, value) in values {
        assert_eq!(bench.read(offset), value, "{offset:#x}");
    }
    for offset in [0x020, 0x17C, 0x1D0, 0x208, 0x210, 0x218, 0x220, 0x23C, 0x320, 0x3FC] {
        assert_eq!(bench.can.read(offset, Time::ZERO), None, "{offset:#x}");
        assert!(!bench.write(offset, 0), "{offset:#x}");
    }
    assert!(bench.can.read(0x31C, Time::ZERO).is_some());
}

#[test]
fn reserved_bits_and_time_triggered_mode_are_reported() {
    let mut bench = Bench::new();
    assert!(bench.write(MCR, INRQ));
    assert!(!bench.write(MCR, INRQ | 1 << 7));
    assert!(!bench.write(MCR, INRQ | 1 << 20));
    assert!(!bench.write(IER, 1 << 7));
    assert!(!bench.write(BTR, 1 << 10));
    assert!(!bench.write(FA1R, 1 << 28));
}

#[test]
fn initialisation_is_entered_while_sleep_is_still_set() {
    let mut bench = Bench::new();
    bench.write(MCR, 0x0001_0000 | SLEEP | INRQ);
    assert_eq!(bench.read(MSR) & 3, INAK);
    bench.write(MCR, SLEEP);
    assert_eq!(bench.read(MSR) & 3, SLAK);
    bench.write(MCR, INRQ);
    assert_eq!(bench.read(MSR) & 3, INAK);
}

#[test]
fn bit_timing_is_writable_only_in_initialisation() {
    let mut bench = Bench::new();
    bench.write(BTR, MEGABIT);
    assert_eq!(bench.read(BTR), 0x0123_0000);
    bench.write(MCR, INRQ);
    bench.write(BTR, MEGABIT);
    assert_eq!(bench.read(BTR), MEGABIT);
    bench.write(MCR, 0);
    bench.write(BTR, HALF_MEGABIT);
    assert_eq!(bench.read(BTR), MEGABIT);
    assert_eq!(bench.can.bit_rate(), 1_000_000);
}

#[test]
fn initialisation_is_left_after_eleven_recessive_bits() {
    let mut bench = Bench::new();
    bench.write(MCR, INRQ);
    bench.write(BTR, MEGABIT);
    bench.run_us(100);
    bench.write(MCR, 0);
    let asked = bench.bus.now();
    bench.run(Time::from_ns(10_800));
    assert_eq!(bench.read(MSR) & 3, INAK);
    bench.run(Time::from_ns(100));
    assert_eq!(bench.read(MSR) & 3, 0);
    let left = asked + Time::from_ns(10_875);
    assert_eq!(bench.can.take_notes().pop(), Some((left, Note::InitializationLeft)));
}

#[test]
fn initialisation_is_not_left_while_the_bus_is_busy_and_the_wish_can_be_taken_back() {
    let mut bench = Bench::running(0);
    let mut noise = Adapter::with_timing(
        Clock { hz: 16_000_000, ppm: 0 },
        BitTiming { prescaler: 1, segment_1: 13, segment_2: 2, jump_width: 2 },
    );
    // Alone with the noise at 1 Mbit/s, so that it is never acknowledged and never pauses for 11 bits of 10 kbit/s.
    bench.adapter.close();
    noise.send(standard(0, &[0; 8]));
    let mut run = |bench: &mut Bench, us| {
        let until = bench.bus.now() + Time::from_us(us);
        while bench.bus.advance(until, &mut [&mut bench.can, &mut noise], |_, _, _| {}) < until {}
    };
    bench.write(MCR, INRQ);
    bench.write(BTR, 0x001C_00C7);
    run(&mut bench, 200);
    bench.write(MCR, 0);
    run(&mut bench, 50_000);
    assert_eq!(bench.read(MSR) & 3, INAK);
    bench.write(MCR, INRQ);
    bench.write(BTR, MEGABIT);
    assert_eq!(bench.read(BTR), MEGABIT);
    bench.write(MCR, 0);
    run(&mut bench, 400);
    assert_eq!(bench.read(MSR) & 3, 0);
}

#[test]
fn initialisation_waits_for_the_own_frame_to_end() {
    let mut bench = Bench::running(0);
    bench.mailbox(0, standard(0x123, &[0; 8]));
    bench.mailbox(1, standard(0x124, &[0; 8]));
    bench.run_us(20);
    assert_eq!(bench.read(MSR) >> 8 & 3, 1, "TXM");
    bench.write(MCR, INRQ);
    assert_eq!(bench.read(MSR) & 3, 0);
    bench.run_us(300);
    assert_eq!(bench.read(MSR) & 3, INAK);
    assert_eq!(bench.received().len(), 1);
    assert_eq!(bench.read(TSR) >> 26 & 7, 0b101, "the second mailbox still waits");
    bench.write(MCR, 0);
    bench.run_us(300);
    assert_eq!(bench.received().len(), 1);
    assert_eq!(bench.read(TSR) >> 26 & 7, 0b111);
}

#[test]
fn a_transmission_sets_its_bits_at_the_end_of_the_frame_and_interrupts() {
    let mut bench = Bench::running(0);
    bench.write(IER, 1);
    bench.mailbox(0, standard(0x123, &[1, 2, 3]));
    assert_eq!(bench.read(TSR), 0x1900_0000, "mailbox 1 is the next free one");
    assert_eq!(bench.read(TI0R) & 1, 1);
    let asked = bench.bus.now();
    bench.step_until("RQCP0", |bench| bench.read(TSR) & 1 != 0);
    let bits = u64::from(standard(0x123, &[1, 2, 3]).wire_bits());
    let took = bench.bus.now() - asked;
    assert!((Time::from_us(bits - 1)..=Time::from_us(bits + 1)).contains(&took), "{took}");
    assert_eq!(bench.read(TSR), 0x1C00_0003);
    assert!(bench.can.irq().tx);
    bench.write(TSR, 1);
    assert_eq!(bench.read(TSR), 0x1C00_0000);
    assert!(!bench.can.irq().tx);
    assert_eq!(bench.received(), [standard(0x123, &[1, 2, 3])]);
    assert_eq!(bench.read(ESR), 0);
}

#[test]
fn mailboxes_go_by_identifier_then_by_number() {
    let mut bench = Bench::running(0);
    bench.write(MCR, INRQ);
    bench.mailbox(0, standard(0x300, &[0]));
    bench.mailbox(1, standard(0x100, &[1]));
    bench.mailbox(2, standard(0x300, &[2]));
    assert_eq!(bench.read(TSR) >> 24, 0b1000_0010, "mailbox 2 has the lowest priority");
    bench.write(MCR, 0);
    bench.run_us(500);
    let order: Vec<u8> = bench.received().iter().map(|frame| frame.data[0]).collect();
    assert_eq!(order, [1, 0, 2]);
}

#[test]
fn mailboxes_go_by_order_of_request_with_txfp() {
    let mut bench = Bench::running(TXFP);
    bench.write(MCR, TXFP | INRQ);
    bench.mailbox(1, standard(0x300, &[1]));
    bench.mailbox(2, standard(0x100, &[2]));
    bench.mailbox(0, standard(0x200, &[0]));
    assert_eq!(bench.read(TSR) >> 24, 0b0010_0000, "mailbox 0 was last");
    bench.write(MCR, TXFP);
    bench.run_us(500);
    let order: Vec<u8> = bench.received().iter().map(|frame| frame.data[0]).collect();
    assert_eq!(order, [1, 2, 0]);
}

#[test]
fn a_higher_priority_overtakes_what_waits_but_not_what_is_under_way() {
    let mut bench = Bench::running(0);
    bench.mailbox(0, standard(0x300, &[0]));
    bench.mailbox(1, standard(0x200, &[1]));
    bench.run_us(10);
    bench.mailbox(2, standard(0x100, &[2]));
    bench.run_us(500);
    let order: Vec<u8> = bench.received().iter().map(|frame| frame.data[0]).collect();
    assert_eq!(order, [1, 2, 0], "chosen when the bus became free");
}

#[test]
fn a_mailbox_that_waits_is_protected_and_aborted_at_once() {
    let mut bench = Bench::running(0);
    bench.adapter.send(standard(0, &[0; 8]));
    bench.run_us(10);
    bench.mailbox(0, standard(0x123, &[1]));
    bench.can.take_notes();
    bench.write(TI0R + 8, 0xFF);
    assert_eq!(bench.read(TI0R + 8), 1);
    bench.write(TSR, 1 << 7);
    assert_eq!(bench.read(TSR), 0x1C00_0001, "RQCP without TXOK");
    let now = bench.bus.now();
    assert_eq!(
        bench.can.take_notes(),
        [(now, Note::Aborted { mailbox: 0, frame: standard(0x123, &[1]) })]
    );
    bench.run_us(500);
    assert_eq!(bench.received(), []);
}

#[test]
fn an_abort_under_way_lets_a_good_frame_succeed() {
    let mut bench = Bench::running(0);
    bench.mailbox(0, standard(0x123, &[1]));
    bench.run_us(10);
    bench.write(TSR, 1 << 7);
    assert_eq!(bench.read(TSR) & 0xFF, 1 << 7);
    bench.run_us(100);
    assert_eq!(bench.read(TSR), 0x1C00_0003);
    assert_eq!(bench.received().len(), 1);
}

#[test]
fn an_abort_under_way_ends_the_repetition_of_a_failing_frame() {
    let mut bench = Bench::running(0);
    bench.adapter.close();
    bench.mailbox(0, standard(0x123, &[1]));
    bench.run_us(250);
    assert_eq!(bench.read(TSR) & 0xF, 1 << 3, "TERR without RQCP: it is repeated");
    bench.step_until("a transmission", |bench| bench.read(MSR) >> 8 & 1 == 1);
    bench.write(TSR, 1 << 7);
    assert_eq!(bench.read(TSR) >> 26 & 1, 0);
    bench.run_us(100);
    assert_eq!(bench.read(TSR), 0x1C00_0009, "RQCP and TERR");
    let tec = bench.read(ESR) >> 16 & 0xFF;
    bench.run_us(1000);
    assert_eq!(bench.read(ESR) >> 16 & 0xFF, tec);
}

#[test]
fn one_shot_gives_up_after_an_error_or_lost_arbitration() {
    let mut bench = Bench::running(NART);
    bench.write(MCR, NART | INRQ);
    bench.mailbox(0, standard(0x123, &[1]));
    bench.adapter.send(standard(0x100, &[]));
    bench.write(MCR, NART);
    // The adapter waits for its chance as long as the bxCAN does.
    bench.adapter.close();
    bench.adapter.open();
    bench.adapter.send(standard(0x100, &[]));
    bench.run_us(300);
    assert_eq!(bench.read(TSR), 0x1C00_0005, "RQCP and ALST");
    assert_eq!(bench.received(), []);

    bench.adapter.close();
    bench.mailbox(0, standard(0x123, &[1]));
    bench.run_us(1000);
    assert_eq!(bench.read(TSR), 0x1C00_0009, "RQCP and TERR");
    assert_eq!(bench.read(ESR), 0x0008_0030, "one acknowledgement error");
}

#[test]
fn a_frame_is_readable_from_the_last_but_one_bit_of_eof() {
    let mut bench = Bench::running(0);
    bench.write(IER, 2);
    let frame = Frame::data(Id::Extended(0x1234_5678), &[1, 2, 3, 4, 5]);
    bench.adapter.send(frame);
    let asked = bench.bus.now();
    bench.step_until("a message", |bench| bench.read(RF0R) & 3 == 1);
    let took = (bench.bus.now() - asked).as_ns();
    let valid = u64::from(frame.wire_bits()) * 1000 - 1_125;
    assert!((valid..valid + 1_600).contains(&took), "{took}");
    assert!(bench.can.irq().rx0);
    assert_eq!(bench.read(RI0R), 0x1234_5678 << 3 | 4);
    assert_eq!(bench.read(RI0R + 4), 5);
    assert_eq!(bench.read(RI0R + 8), 0x0403_0201);
    assert_eq!(bench.read(RI0R + 12), 5);
    bench.write(RF0R, 1 << 5);
    assert_eq!(bench.read(RF0R), 0);
    assert!(!bench.can.irq().rx0);
}

#[test]
fn a_data_length_code_above_eight_is_stored_and_sent_as_it_is() {
    let mut bench = Bench::running(0);
    bench.adapter.send(standard(0x123, &[7; 8]).with_dlc(12));
    bench.run_us(200);
    assert_eq!(bench.read(RI0R + 4), 12);
    assert_eq!(bench.read(RI0R + 12), 0x0707_0707);
    bench.mailbox(0, standard(0x124, &[9; 8]).with_dlc(15));
    bench.run_us(200);
    assert_eq!(bench.received(), [standard(0x124, &[9; 8]).with_dlc(15)]);
}

#[test]
fn the_fourth_message_replaces_the_third() {
    let mut bench = Bench::running(0);
    bench.write(IER, 1 << 3);
    (1..=3).for_each(|n| bench.adapter.send(standard(0x100, &[n])));
    bench.run_us(300);
    assert_eq!(bench.read(RF0R), 3 | 1 << 3, "FULL");
    assert!(!bench.can.irq().rx0);
    (4..=5).for_each(|n| bench.adapter.send(standard(0x100, &[n])));
    bench.run_us(300);
    assert_eq!(bench.read(RF0R), 3 | 1 << 3 | 1 << 4, "FOVR");
    assert!(bench.can.irq().rx0);
    bench.write(RF0R, 3 << 3);
    assert_eq!(bench.read(RF0R), 3);
    let data: Vec<u32> = bench.fifo(0).iter().map(|message| message[2]).collect();
    assert_eq!(data, [1, 2, 5]);
}

#[test]
fn a_locked_fifo_keeps_its_first_three() {
    let mut bench = Bench::running(RFLM);
    (1..=5).for_each(|n| bench.adapter.send(standard(0x100, &[n])));
    bench.run_us(500);
    assert_eq!(bench.read(RF0R), 3 | 1 << 3 | 1 << 4);
    let data: Vec<u32> = bench.fifo(0).iter().map(|message| message[2]).collect();
    assert_eq!(data, [1, 2, 3]);
}

/// Four banks, one of each kind, and the frames that they are asked about.
fn with_filters(fifo_1: u32, active: u32) -> Bench {
    let mut bench = Bench::new();
    let bank = |n: u32| F0R1 + 8 * n;
    for (register, value) in [
        (FMR, 0x2A1C_0E01),
        // Bank 0: 16-bit list of 7E5, 000, 601 and 602. Bank 1: 16-bit mask 180/780 and remote 000/000.
        // Bank 2: 32-bit list of extended 12345 and standard 7E5. Bank 3: 32-bit mask of any extended.
        (FM1R, 0b0101),
        (FS1R, 0b1100),
        (FFA1R, fifo_1),
        (bank(0), 0x7E5 << 5),
        (bank(0) + 4, 0x602 << 21 | 0x601 << 5),
        (bank(1), 0xF018 << 16 | 0x180 << 5),
        (bank(1) + 4, 0x0010 << 16 | 0x0010),
        (bank(2), 0x1_2345 << 3 | 4),
        (bank(2) + 4, 0x7E5 << 21),
        (bank(3), 4),
        (bank(3) + 4, 4),
        (FA1R, active),
        (FMR, 0x2A1C_0E00),
    ] {
        assert!(bench.write(register, value));
    }
    bench.join(0, MEGABIT);
    bench
}

fn match_indices(bench: &mut Bench, fifo: u32, frames: &[Frame]) -> Vec<Option<u32>> {
    let ask = |frame: &Frame| {
        bench.adapter.send(*frame);
        bench.run_us(300);
        bench.fifo(fifo).first().map(|message| message[1] >> 8)
    };
    frames.iter().map(ask).collect()
}

fn asked() -> [Frame; 9] {
    [
        standard(0x7E5, &[0; 8]),
        standard(0x000, &[0; 2]),
        standard(0x601, &[0; 8]),
        standard(0x602, &[0; 8]),
        standard(0x1FF, &[]),
        Frame::remote(Id::Standard(0x700), 0),
        Frame::data(Id::Extended(0x1_2345), &[]),
        Frame::data(Id::Extended(0x7E5), &[]),
        standard(0x603, &[]),
    ]
}

#[test]
fn each_kind_of_filter_takes_what_it_names() {
    // Alone in FIFO 0, with the numbers that inactive banks still take.
    let all = |bench: &mut Bench| match_indices(bench, 0, &asked());
    assert_eq!(
        all(&mut with_filters(0, 0b0001)),
        [Some(0), Some(1), Some(2), Some(3), None, None, None, None, None],
        "16-bit list"
    );
    assert_eq!(
        all(&mut with_filters(0, 0b0010)),
        [None, None, None, None, Some(4), Some(5), None, None, None],
        "16-bit mask"
    );
    assert_eq!(
        all(&mut with_filters(0, 0b0100)),
        [Some(7), None, None, None, None, None, Some(6), None, None],
        "32-bit list"
    );
    assert_eq!(
        all(&mut with_filters(0, 0b1000)),
        [None, None, None, None, None, None, Some(8), Some(8), None],
        "32-bit mask"
    );
}

#[test]
fn of_several_matches_the_wider_wins_and_then_the_list() {
    let all = with_filters(0, 0b1111);
    assert_eq!(
        match_indices(&mut { all }, 0, &asked()),
        [Some(7), Some(1), Some(2), Some(3), Some(4), Some(5), Some(6), Some(8), None]
    );
}

#[test]
fn each_fifo_numbers_its_own_filters() {
    let frames = asked();
    let mut bench = with_filters(0b0110, 0b1111);
    assert_eq!(
        match_indices(&mut bench, 1, &frames),
        [Some(3), None, None, None, Some(0), Some(1), Some(2), None, None]
    );
    assert!(bench.read(RI1R) != 0, "the output mailbox keeps what was released");
    let mut bench = with_filters(0b0110, 0b1111);
    assert_eq!(
        match_indices(&mut bench, 0, &frames),
        [None, Some(1), Some(2), Some(3), None, None, None, Some(4), None]
    );
}

#[test]
fn no_active_filter_no_frame_but_an_acknowledgement() {
    let mut bench = Bench::new();
    bench.write(FMR, 0x2A1C_0E00);
    bench.join(0, MEGABIT);
    bench.adapter.send(standard(0x7E5, &[]));
    bench.run_us(200);
    assert_eq!(bench.adapter.unsent(), 0);
    assert_eq!(bench.fifo(0), Vec::<[u32; 3]>::new());
}

#[test]
fn filter_initialisation_stops_reception_and_guards_the_banks() {
    let mut bench = Bench::running(0);
    bench.write(FMR, 0x2A1C_0E01);
    bench.adapter.send(standard(0x7E5, &[]));
    bench.run_us(200);
    assert_eq!(bench.read(RF0R), 0);
    bench.write(FMR, 0x2A1C_0E00);
    bench.write(F0R1, 0x1234);
    assert_eq!(bench.read(F0R1), 0, "the bank is active");
    bench.write(FM1R, 1);
    assert_eq!(bench.read(FM1R), 0);
    bench.write(FA1R, 0);
    bench.write(F0R1, 0x1234);
    assert_eq!(bench.read(F0R1), 0x1234);
}

#[test]
fn banks_from_can2sb_on_belong_to_the_other_peripheral() {
    let mut bench = Bench::new();
    let bank_14 = F0R1 + 8 * 14;
    for (register, value) in [(FS1R, 1 << 14), (bank_14, 0), (FA1R, 1 << 14), (FMR, 0x2A1C_0E00)] {
        bench.write(register, value);
    }
    bench.join(0, MEGABIT);
    bench.adapter.send(standard(1, &[]));
    bench.run_us(200);
    assert_eq!(bench.read(RF0R), 0);
    bench.write(FMR, 28 << 8);
    bench.adapter.send(standard(1, &[]));
    bench.run_us(200);
    assert_eq!(bench.read(RF0R), 1);
    assert_eq!(bench.read(RI0R + 4) >> 8, 28, "14 banks of two 16-bit filters come before");
}

#[test]
fn alone_the_warning_and_passive_flags_rise_at_96_and_128_and_interrupt_once() {
    let mut bench = Bench::running(0);
    bench.adapter.close();
    bench.write(IER, 1 << 15 | 1 << 8 | 1 << 9);
    bench.mailbox(0, standard(0x123, &[]));
    bench.step_until("EWGF", |bench| bench.read(ESR) & 1 == 1);
    assert_eq!(bench.read(ESR), 96 << 16 | 3 << 4 | 0b001);
    assert!(bench.can.irq().sce);
    assert_eq!(bench.read(MSR) >> 2 & 1, 1);
    bench.write(MSR, 1 << 2);
    assert!(!bench.can.irq().sce);
    bench.run_us(100);
    assert!(!bench.can.irq().sce);
    bench.step_until("EPVF", |bench| bench.read(ESR) & 2 == 2);
    assert_eq!(bench.read(ESR), 128 << 16 | 3 << 4 | 0b011);
    assert!(bench.can.irq().sce);
    bench.run(Time::from_ms(20));
    assert_eq!(bench.read(ESR), 128 << 16 | 3 << 4 | 0b011, "the counter stands");
}

#[test]
fn error_codes_interrupt_with_lecie_and_a_good_frame_clears_the_code() {
    let mut bench = Bench::running(0);
    bench.write(ESR, 7 << 4);
    assert_eq!(bench.read(ESR), 7 << 4);
    bench.write(IER, 1 << 15 | 1 << 11);
    bench.adapter.close();
    bench.mailbox(0, standard(0x123, &[]));
    bench.run_us(60);
    assert_eq!(bench.read(ESR) >> 4 & 7, 3);
    assert!(bench.can.irq().sce);
    bench.adapter.open();
    bench.run_us(1000);
    assert_eq!(bench.read(ESR) >> 4 & 7, 0);
}

/// Drives the transmit error counter over 255 by noise at half the rate.
fn bus_off(mcr: u32) -> Bench {
    let mut bench = Bench::running(mcr);
    bench.adapter.set_bit_rate(500_000);
    bench.mailbox(0, standard(0x7FF, &[0xFF; 8]));
    let limit = Time::from_s(1);
    while bench.read(ESR) & 4 == 0 {
        bench.adapter.send(standard(0, &[0; 8]));
        bench.run_us(100);
        assert!(bench.bus.now() < limit, "ESR {:#010x}", bench.read(ESR));
    }
    bench.adapter.close();
    bench
}

#[test]
fn bus_off_lasts_until_the_program_passes_through_initialisation() {
    let mut bench = bus_off(0);
    assert_eq!(bench.read(ESR) & 7, 7);
    bench.run(Time::from_ms(10));
    assert_eq!(bench.read(ESR) & 4, 4);
    bench.write(MCR, INRQ);
    assert_eq!(bench.read(MSR) & 3, INAK);
    bench.run(Time::from_ms(10));
    bench.write(MCR, 0);
    bench.run_us(11);
    assert_eq!(bench.read(MSR) & 3, 0, "INAK falls after the first 11 bits");
    assert_eq!(bench.read(ESR) & 4, 4);
    bench.run_us(128 * 11 - 12);
    assert_eq!(bench.read(ESR) & 4, 4);
    bench.run_us(2);
    assert_eq!(bench.read(ESR) & 0xFFFF_0007, 0);
}

#[test]
fn bus_off_ends_by_itself_with_abom_and_the_mailbox_is_sent_at_last() {
    let mut bench = bus_off(ABOM);
    bench.adapter.set_bit_rate(1_000_000);
    bench.adapter.open();
    bench.run_us(1_700);
    assert_eq!(bench.read(ESR) & 7, 0);
    assert_eq!(bench.received(), [standard(0x7FF, &[0xFF; 8])]);
}

#[test]
fn silent_mode_receives_without_driving_the_wire() {
    let mut bench = Bench::new();
    bench.open_filter();
    bench.join(0, 1 << 31 | MEGABIT);
    bench.mailbox(0, standard(1, &[]));
    bench.run_us(500);
    assert_eq!(bench.bus.level(), Level::Recessive);
    assert_eq!(bench.read(TSR) >> 26 & 1, 0, "it cannot start");
    bench.adapter.send(standard(0x7E5, &[5]));
    bench.run_us(300);
    assert!(bench.adapter.unsent() == 1 && bench.adapter.errors() > 1, "nobody acknowledges");
}

#[test]
fn loopback_reads_back_its_own_frame() {
    let mut bench = Bench::new();
    bench.open_filter();
    bench.adapter.close();
    bench.join(0, 3 << 30 | MEGABIT);
    bench.mailbox(2, standard(0x7E5, &[5]));
    bench.run_us(100);
    assert_eq!(bench.fifo(0), [[0x7E5 << 21, 1, 5]]);
    assert_eq!(bench.read(TSR), 0x1C03_0000);
}

#[test]
fn sleep_ends_on_bus_activity_with_awum() {
    let mut bench = Bench::running(AWUM);
    bench.write(IER, 1 << 16 | 1 << 17);
    bench.write(MCR, AWUM | SLEEP);
    assert_eq!(bench.read(MSR) & 0x1F, SLAK | 1 << 4, "SLAKI");
    assert!(bench.can.irq().sce);
    bench.write(MSR, 1 << 4);
    assert!(!bench.can.irq().sce);
    bench.adapter.send(standard(0x123, &[]));
    bench.run_us(5);
    assert_eq!(bench.read(MSR) & 0x1F, SLAK | 1 << 3, "WKUI");
    assert_eq!(bench.read(MCR) & SLEEP, 0);
    bench.run_us(300);
    assert_eq!(bench.read(MSR) & 3, 0);
}

#[test]
fn sleep_goes_on_without_awum() {
    let mut bench = Bench::running(0);
    bench.write(MCR, SLEEP);
    bench.adapter.send(standard(0x123, &[]));
    bench.run_us(300);
    assert_eq!(bench.read(MSR) & 3, SLAK);
    assert_eq!(bench.read(MSR) >> 3 & 1, 1);
    bench.write(MCR, 0);
    bench.run_us(300);
    assert_eq!(bench.read(MSR) & 3, 0);
}

#[test]
fn a_node_at_another_rate_counts_errors_and_destroys_frames() {
    let mut bench = Bench::new();
    bench.open_filter();
    bench.join(0, HALF_MEGABIT);
    let mut peer = Adapter::new(1_000_000);
    bench.adapter.send(standard(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]));
    let until = bench.bus.now() + Time::from_ms(5);
    let mut errors = 0;
    while bench.bus.now() < until {
        let stations: &mut [&mut dyn Station] =
            &mut [&mut bench.can, &mut bench.adapter, &mut peer];
        bench.bus.advance(until, stations, |station, _, event| {
            errors += u32::from(station == 0 && matches!(event, Event::Error { .. }));
        });
    }
    assert!(errors > 0);
    assert_eq!(bench.read(RF0R), 0);
    assert!(bench.read(ESR) >> 24 > 0 && bench.adapter.errors() > 0);
}

#[test]
fn a_master_reset_puts_it_to_sleep_and_empties_the_fifos() {
    let mut bench = Bench::running(RFLM);
    bench.adapter.send(standard(0x123, &[]));
    bench.run_us(200);
    assert_eq!(bench.read(RF0R), 1);
    bench.write(MCR, 1 << 15);
    assert_eq!((bench.read(MCR), bench.read(MSR) & 3, bench.read(RF0R)), (0x0001_0002, SLAK, 0));
}

#[test]
fn writes_are_noted_with_their_time() {
    let mut bench = Bench::new();
    bench.can.write(MCR, INRQ, Time::from_us(1));
    bench.can.write(BTR, MEGABIT, Time::from_us(2));
    bench.can.write(BTR, MEGABIT, Time::from_us(3));
    bench.can.write(TI0R, 0x7E4 << 21 | 1, Time::from_us(4));
    let notes = bench.can.take_notes();
    assert_eq!(
        notes,
        [
            (Time::from_us(1), Note::InitializationEntered),
            (Time::from_us(2), Note::BitTiming(MEGABIT)),
            (Time::from_us(4), Note::Requested { mailbox: 0, frame: standard(0x7E4, &[]) }),
        ]
    );
}
